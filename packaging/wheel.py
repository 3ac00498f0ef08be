#!/usr/bin/env python3
"""Writes a wheel with the `use3d` program and the Python module beside this file.

    packaging/wheel.py BINARY --licences THIRDPARTY.txt --out dist/ [--platform TAG[.TAG…]]

THIRDPARTY.txt holds the notices of others; `packaging/licences.py` writes it for the binary's target and
features. The wheel of a static Linux binary (the default tags) installs on every Linux with that processor.
For any other binary name its platform, e.g. `--platform linux_x86_64` for this machine, `macosx_11_0_arm64`,
`win_amd64`. The same inputs give the same bytes. Only the standard library is needed. `pip install
packaging/python` uses this file for a wheel of the module alone.
"""

import argparse
import base64
import hashlib
import re
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
# Tags of static programs, by the number of the processor in an ELF file.
STATIC = {
    62: "manylinux_2_5_x86_64.manylinux1_x86_64.musllinux_1_1_x86_64",
    183: "manylinux_2_17_aarch64.manylinux2014_aarch64.musllinux_1_1_aarch64",
}


def version():
    text = (HERE.parent / "Cargo.toml").read_text(encoding="utf-8")
    return re.search(r'\[workspace\.package\]\nversion = "([^"]+)"', text).group(1)


def repository():
    text = (HERE.parent / "Cargo.toml").read_text(encoding="utf-8")
    return re.search(r'repository = "([^"]+)"', text).group(1)


def static_platform(binary):
    """The tags of a static Linux program (an ELF file that names no interpreter, so that it needs no C library of
    the system); `None` for any other file.
    """
    data = binary.read_bytes()
    if data[:5] != b"\x7fELF\x02":
        return None
    offset = int.from_bytes(data[32:40], "little")
    size, count = int.from_bytes(data[54:56], "little"), int.from_bytes(data[56:58], "little")
    kinds = [int.from_bytes(data[offset + i * size :][:4], "little") for i in range(count)]
    return None if 3 in kinds else STATIC.get(int.from_bytes(data[18:20], "little"))


def wheel(out, binary=None, licences=None, platform="any"):
    """Writes a wheel into the folder `out`; without a program it holds the module alone."""
    number = version()
    name = f"use3d-{number}"
    tags = [f"py3-none-{tag}" for tag in platform.split(".")]
    readme = (HERE / "python" / "README.md").read_text(encoding="utf-8")
    texts = ["LICENSE-MIT", "LICENSE-APACHE"] + (["THIRDPARTY.txt"] if licences else [])
    metadata = (
        f"Metadata-Version: 2.1\nName: use3d\nVersion: {number}\n"
        "Summary: Underwater 3D scenes that look clear, from any viewpoint, reproducibly\n"
        f"License: MIT OR Apache-2.0\n{''.join(f'License-File: {text}' + chr(10) for text in texts)}"
        f"Author: the 3D-USE authors\nProject-URL: Source, {repository()}\n"
        "Classifier: Programming Language :: Rust\nClassifier: Topic :: Scientific/Engineering :: Image Processing\n"
        "Classifier: Typing :: Typed\nRequires-Python: >=3.9\n"
        "Provides-Extra: arrays\nRequires-Dist: numpy; extra == \"arrays\"\n"
        f"Description-Content-Type: text/markdown\n\n{readme}"
    )
    tags_text = "".join(f"Tag: {tag}\n" for tag in tags)
    files = {}
    for path in sorted((HERE / "python" / "use3d").glob("*")):
        if path.suffix == ".py" or path.name == "py.typed":
            files[f"use3d/{path.name}"] = path.read_bytes()
    if binary:
        files[f"{name}.data/scripts/use3d{'.exe' if binary.suffix == '.exe' else ''}"] = binary.read_bytes()
    for text in texts:
        path = licences if text == "THIRDPARTY.txt" else HERE.parent / text
        files[f"{name}.dist-info/{text}"] = path.read_bytes()
    files[f"{name}.dist-info/METADATA"] = metadata.encode()
    files[f"{name}.dist-info/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: packaging/wheel.py\nRoot-Is-Purelib: {str(binary is None).lower()}\n{tags_text}".encode()
    )
    record = f"{name}.dist-info/RECORD"
    lines = []
    for path, data in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        lines.append(f"{path},sha256={digest},{len(data)}")
    files[record] = ("\n".join([*lines, f"{record},,"]) + "\n").encode()
    out.mkdir(parents=True, exist_ok=True)
    target = out / f"{name}-py3-none-{platform}.whl"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path, data in files.items():
            entry = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            # Marks a regular file: pip checks the kind of file before it checks the right to run it.
            entry.external_attr = (0o100755 if "/scripts/" in path else 0o100644) << 16
            archive.writestr(entry, data)
    return target


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("--licences", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("dist"))
    parser.add_argument("--platform")
    words = parser.parse_args()
    if not words.binary.is_file():
        sys.exit(f"{words.binary}: there is no such program; build it first")
    if not words.licences.is_file():
        sys.exit(f"{words.licences}: there are no such notices; write them with packaging/licences.py first")
    platform = words.platform or static_platform(words.binary)
    if platform is None:
        sys.exit(f"{words.binary}: not a static Linux binary; say with --platform where it runs")
    print(wheel(words.out, words.binary, words.licences, platform))


if __name__ == "__main__":
    main()
