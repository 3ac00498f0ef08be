"""The crates that the `use3d` program is made of, read from `cargo tree` for its own features and target.
`cargo metadata` alone has the features of the whole workspace, tests included, and would name crates that are
not in the program.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
NAME = "use3d"


def add_arguments(parser):
    """Adds the arguments that choose the program; they are those of the cargo command that builds it."""
    parser.add_argument("--target", help="a target triple; this machine's where none is given")
    parser.add_argument("--no-default-features", action="store_true")
    parser.add_argument("--features", default="", help="with commas between them")


def asked(command):
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}")
    return done.stdout.decode()


def host():
    """The target triple of this machine."""
    return re.search(r"^host: (\S+)$", asked(["rustc", "-vV"]), re.MULTILINE).group(1)


class Program:
    """Crates by (name, version). `crates` holds their description by `cargo metadata`. `linked` holds the
    crates whose code may be in the program, procedural macros included. `needs` leads from a crate to the
    crates that its build needs. `root` is the program itself.
    """

    def __init__(self, target=None, no_default_features=False, features=""):
        self.target = target or host()
        self.features = [name for name in features.split(",") if name]
        self.default_features = not no_default_features
        self.needs = self._tree("normal,build")
        self.linked = set(self._tree("normal"))
        self.root = next(key for key in self.needs if key[0] == NAME)
        # Procedural macros and build programs of other crates run on this machine, whatever the program's
        # target is.
        platforms = [word for triple in sorted({self.target, host()}) for word in ("--filter-platform", triple)]
        features = ["--features", ",".join(f"{NAME}/{name}" for name in self.features)] if self.features else []
        metadata = json.loads(asked(["cargo", "metadata", "--format-version", "1", "--locked", *platforms, *features]))
        described = {(package["name"], package["version"]): package for package in metadata["packages"]}
        self.crates = {key: described[key] for key in self.needs}

    def _tree(self, edges):
        command = ["cargo", "tree", "--locked", "--package", NAME, "--target", self.target, "--edges", edges]
        command += [] if self.default_features else ["--no-default-features"]
        command += ["--features", ",".join(self.features)] if self.features else []
        # `cargo tree` lists a crate's own dependencies where the crate comes first; later it prints a star.
        needs, path = {}, []
        for line in filter(None, asked([*command, "--prefix", "depth", "--format", " {p}"]).splitlines()):
            depth, name, version = line.split()[:3]
            key = (name, version.removeprefix("v"))
            del path[int(depth) :]
            needs.setdefault(key, set())
            if path:
                needs[path[-1]].add(key)
            path.append(key)
        # If cargo is set to unify the features of a workspace, it also lists the workspace's other members.
        root = next(key for key in needs if key[0] == NAME)
        reached, open_ = set(), {root}
        while open_:
            reached |= open_
            open_ = set().union(*(needs[key] for key in open_)) - reached
        return {key: needs[key] for key in needs if key in reached}

    def others(self):
        """The linked crates of others."""
        return sorted(key for key in self.linked if self.crates[key]["source"] is not None)
