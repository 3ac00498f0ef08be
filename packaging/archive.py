#!/usr/bin/env python3
"""Packs a folder into a .tar.xz archive, or writes the SHA-256 sums of a folder.

    packaging/archive.py FOLDER ARCHIVE.tar.xz
    packaging/archive.py --sums FOLDER

The same files give the same bytes: entries are sorted, belong to root, and have the time SOURCE_DATE_EPOCH
(seconds, 0 if it is not set). Programs keep their right to be executed. `--sums` writes FOLDER/SHA256SUMS, which
`sha256sum --check` reads. Only the standard library is needed, so it works on Linux, macOS and Windows.
"""

import hashlib
import os
import sys
import tarfile
from pathlib import Path

SUMS = "SHA256SUMS"


def pack(folder, archive):
    time = int(os.environ.get("SOURCE_DATE_EPOCH", "0"))

    def entry(info):
        executable = info.isdir() or info.mode & 0o100 or info.name.endswith(".exe")
        info.mode = 0o755 if executable else 0o644
        info.uid = info.gid = 0
        info.uname = info.gname = "root"
        info.mtime = time
        return info

    paths = sorted([folder, *folder.rglob("*")], key=lambda path: path.as_posix())
    with tarfile.open(archive, "w:xz", preset=9, format=tarfile.GNU_FORMAT) as tar:
        for path in paths:
            name = Path(folder.name) / path.relative_to(folder)
            tar.add(path, arcname=name.as_posix(), recursive=False, filter=entry)


def sums(folder):
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name != SUMS)
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8", newline="\n")


def main():
    match sys.argv[1:]:
        case ["--sums", folder]:
            sums(Path(folder))
        case [folder, archive] if archive.endswith(".tar.xz"):
            pack(Path(folder), Path(archive))
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
