"""Tests that a wheel holds everything that pip needs."""

import base64
import hashlib
import importlib.util
import os
import stat
import subprocess
import tempfile
import unittest
import venv
import zipfile
from pathlib import Path

PACKAGING = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("wheel", PACKAGING / "wheel.py")
wheel = importlib.util.module_from_spec(spec)
spec.loader.exec_module(wheel)


def elf(*kinds):
    """The head of a program for aarch64 with program headers of these kinds; kind 3 names an interpreter."""
    head = bytearray(64)
    head[:5] = b"\x7fELF\x02"
    head[18:20] = (183).to_bytes(2, "little")
    head[32:40] = (64).to_bytes(8, "little")
    head[54:56], head[56:58] = (56).to_bytes(2, "little"), len(kinds).to_bytes(2, "little")
    return bytes(head) + b"".join(kind.to_bytes(4, "little") + bytes(52) for kind in kinds)


class Wheel(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.binary = self.folder / "use3d"

    def test_it_carries_the_program_and_the_module_and_lists_every_file(self):
        self.binary.write_bytes(b"a program")
        notices = self.folder / "THIRDPARTY.txt"
        notices.write_bytes(b"notices of others")
        made = wheel.wheel(self.folder / "dist", self.binary, notices, "linux_x86_64")
        self.assertEqual(made.name, f"use3d-{wheel.version()}-py3-none-linux_x86_64.whl")
        with zipfile.ZipFile(made) as archive:
            names = {entry.filename: entry for entry in archive.infolist()}
            (program,) = (name for name in names if name.endswith("/scripts/use3d"))
            # pip makes a file executable only if the archive marks it as a regular file.
            mode = names[program].external_attr >> 16
            self.assertTrue(stat.S_ISREG(mode) and mode & 0o111)
            self.assertIn("use3d/__init__.py", names)
            # Without this file, type checkers ignore the module's types.
            self.assertIn("use3d/py.typed", names)
            (about,) = (archive.read(name).decode() for name in names if name.endswith("/METADATA"))
            for field in ("Project-URL: ", "Author: ", "Classifier: ", "License-File: THIRDPARTY.txt"):
                self.assertIn(f"\n{field}", about)
            (beside,) = (name for name in names if name.endswith(".dist-info/THIRDPARTY.txt"))
            self.assertEqual(archive.read(beside), notices.read_bytes())
            (record,) = (name for name in names if name.endswith("/RECORD"))
            listed = [line.split(",") for line in archive.read(record).decode().splitlines()]
            self.assertEqual(sorted(path for path, _, _ in listed), sorted(names))
            for path, digest, size in listed:
                if path != record:
                    data = archive.read(path)
                    found = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
                    self.assertEqual((digest, size), (f"sha256={found}", str(len(data))), path)
        again = wheel.wheel(self.folder / "again", self.binary, notices, "linux_x86_64")
        self.assertEqual(made.read_bytes(), again.read_bytes())

    def test_only_what_needs_nothing_of_the_system_counts_as_static(self):
        for data, tags in [(elf(1, 2), wheel.STATIC[183]), (elf(1, 3), None), (b"#!/bin/sh\n", None), (b"", None)]:
            self.binary.write_bytes(data)
            self.assertEqual(wheel.static_platform(self.binary), tags, data[:5])

    def test_pip_installs_the_module_from_the_source_into_a_bare_environment_without_a_network(self):
        place = self.folder / "venv"
        try:
            venv.create(place, with_pip=True)
        except (ImportError, subprocess.CalledProcessError):
            self.skipTest("this Python makes no environments with pip")
        python = place / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

        def say(*words):
            done = subprocess.run([python, *words], cwd=self.folder, capture_output=True, encoding="utf-8")
            self.assertEqual(done.returncode, 0, done.stderr)
            return done.stdout

        say("-m", "pip", "install", "--no-index", "--disable-pip-version-check", PACKAGING / "python")
        said = say("-c", "import use3d; print(use3d.__version__, use3d.Results('.').table(), use3d.__file__)")
        self.assertTrue(said.startswith(f"{wheel.version()} [] {place}"), said)
        # Arrays need NumPy, and the message says so.
        head = "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n"
        (self.folder / "none.ply").write_text(head, newline="\n")
        said = say("-c", "import use3d\ntry: use3d.read_ply('none.ply')\nexcept ImportError as e: print(e)")
        self.assertIn("pip install numpy", said)


if __name__ == "__main__":
    unittest.main()
