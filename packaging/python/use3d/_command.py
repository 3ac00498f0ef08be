"""Finds and starts the command."""

from __future__ import annotations

import collections
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
from pathlib import Path
from typing import Any, Union

# A word of a command line.
Word = Union[str, "os.PathLike[str]", int, float]

# Number of lines of stderr that `CommandFailed` holds.
_REMEMBERED = 200
# Seconds that a command has for its checkpoint after its time is over.
_PATIENCE = 60


class CommandFailed(RuntimeError):
    """The command ended with an exit code other than 0: `code`. `said` holds its last lines on stderr."""

    def __init__(self, words: list[str], code: int, said: str) -> None:
        super().__init__(f"{' '.join(words)}: exit code {code}\n{said.strip()}")
        self.words = words
        self.code = code
        self.said = said

    def __reduce__(self):
        # Needed to pass the error between processes (multiprocessing, concurrent.futures, joblib, dask).
        return type(self), (self.words, self.code, self.said)


def version() -> str:
    """The version of the source that the module lies in, or of the installed package."""
    from importlib import metadata

    source = Path(__file__).resolve().parents[3] / "Cargo.toml"
    if source.is_file() and source.parent.joinpath("packaging", "python").is_dir():
        return re.search(r'\[workspace\.package\]\nversion = "([^"]+)"', source.read_text(encoding="utf-8"))[1]
    try:
        return metadata.version("use3d")
    except metadata.PackageNotFoundError:
        return "unknown"


def command() -> str:
    """The path of the `use3d` program: `USE3D_PROGRAM`, the one beside this Python, the one on the path, or the
    one that `cargo install` made.
    """
    named = os.environ.get("USE3D_PROGRAM")
    if named:
        return named
    name = "use3d.exe" if sys.platform == "win32" else "use3d"
    folders = [sysconfig.get_path("scripts")]
    for scheme in ("posix_user", "nt_user"):
        if scheme in sysconfig.get_scheme_names():
            folders.append(sysconfig.get_path("scripts", scheme))
    for folder in folders:
        path = os.path.join(folder, name)
        if os.path.isfile(path):
            return path
    cargo = os.path.join(os.environ.get("CARGO_HOME") or os.path.expanduser("~/.cargo"), "bin")
    found = shutil.which("use3d") or shutil.which("use3d", path=cargo)
    if found is None:
        raise FileNotFoundError(
            "no `use3d` program beside this Python, on PATH or in ~/.cargo/bin: install it (docs/guide/install.md), "
            "or set USE3D_PROGRAM to its path"
        )
    return found


def run(*words: Word, parse: bool | None = None, timeout: float | None = None, **options: Any) -> Any:
    """Runs `use3d WORDS…` and returns its output on stdout, parsed as JSON if `--json` is among the words.

    `parse` (true or false) overrides that. The command writes its progress to stderr; each line is copied to
    `sys.stderr` while the command runs. With `stderr=None` the command writes there directly, so that a
    terminal shows its bars. `timeout` is in seconds; other `options` are passed to `subprocess.Popen` (such
    as `cwd`, `env`).

    Raises `CommandFailed` with the command's own message if the command fails. On `KeyboardInterrupt`, and
    after the timeout (`subprocess.TimeoutExpired`), the command gets a signal to write a checkpoint and end,
    and `run` waits for that. A second interrupt ends it at once.
    """
    line = [command(), *map(_word, words)]
    if os.name == "posix":
        # Ctrl-C in a terminal would reach the command a second time and end it without a checkpoint.
        options.setdefault("start_new_session", True)
    options.setdefault("stderr", subprocess.PIPE)
    process: Any = subprocess.Popen(line, stdout=subprocess.PIPE, encoding="utf-8", errors="replace", **options)
    written: list[str] = []
    said: collections.deque[str] = collections.deque(maxlen=_REMEMBERED)
    readers = [threading.Thread(target=lambda: written.append(process.stdout.read()), daemon=True)]
    if process.stderr is not None:
        readers.append(threading.Thread(target=_pass_on, args=(process.stderr, said), daemon=True))
    for reader in readers:
        reader.start()
    try:
        process.wait(timeout)
    except KeyboardInterrupt:
        _leave(process, None)
        raise
    except subprocess.TimeoutExpired:
        _leave(process, _PATIENCE)
        raise
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        for reader in readers:
            reader.join()
        for pipe in filter(None, (process.stdout, process.stderr)):
            pipe.close()
    if process.returncode != 0:
        raise CommandFailed(line, process.returncode, "".join(said))
    if parse if parse is not None else "--json" in words:
        return json.loads(written[0])
    return written[0]


def _word(value):
    """A word of the command line: text, a path or a number."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return str(value)
    return os.fspath(value)


def _pass_on(lines, said):
    for line in lines:
        said.append(line)
        try:
            sys.stderr.write(line)
            sys.stderr.flush()
        except (AttributeError, OSError, ValueError):
            # Nobody reads this output (any more); the command must not wait because of that.
            pass


def _leave(process, patience):
    """Signals the command to write a checkpoint and end, and waits for that."""
    try:
        if os.name == "posix":
            # On Windows Ctrl-C has reached the command already.
            process.send_signal(signal.SIGINT)
        process.wait(patience)
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)
        process.wait()
    except subprocess.TimeoutExpired:
        process.kill()
