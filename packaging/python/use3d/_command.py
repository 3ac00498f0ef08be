"""Finding and starting the command."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig


class CommandFailed(RuntimeError):
    """The command ended with another exit code than 0; `code` is that, `said` what it wrote to stderr."""

    def __init__(self, words, code, said):
        super().__init__(f"{' '.join(words)}: exit code {code}\n{said.strip()}")
        self.code = code
        self.said = said


def command():
    """The path of the `use3d` program: `USE3D_COMMAND`, the one beside this Python, or the one on the path."""
    named = os.environ.get("USE3D_COMMAND")
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
    found = shutil.which("use3d")
    if found is None:
        raise FileNotFoundError(
            "no `use3d` program beside this Python or on PATH: pip install use3d, or set USE3D_COMMAND to its path"
        )
    return found


def run(*words, parse=None, **options):
    """Runs `use3d WORDS…` and gives back what it wrote to stdout, parsed where `--json` is among the words.

    `parse` says so otherwise; `options` go to `subprocess.run` (such as `cwd`, `env`, `timeout`). Progress goes to
    stderr as always. Raises `CommandFailed` with the command's own message where it fails.
    """
    words = [command(), *map(os.fspath, words)]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
    if done.returncode != 0:
        raise CommandFailed(words, done.returncode, done.stderr)
    if parse if parse is not None else "--json" in words:
        return json.loads(done.stdout)
    return done.stdout
