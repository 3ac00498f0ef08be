#!/usr/bin/env python3
"""Writes the notices of everybody whose code is in the `use3d` program, as their licences require: of the
linked crates, of the Rust standard library and, in a static program, of musl.

    packaging/licences.py [--target TRIPLE] [--no-default-features] [--features LIST] > THIRDPARTY.txt

Needs cargo, rustc and the standard library. The same lock file and toolchain give the same bytes.
"""

import argparse
import html
import re
import sys
from pathlib import Path

import crates

# Files with these names are notices, anywhere in a crate, except in folders for tests and timings.
NOTICE = re.compile(r"(licen[cs]e|copying|unlicen[cs]e|copyright|notice|patents|authors)([-_. ].*)?", re.IGNORECASE)
LICENCE = re.compile(r"(licen[cs]e|copying|unlicen[cs]e)([-_. ].*)?", re.IGNORECASE)
ELSEWHERE = {"tests", "benches", "examples", "fuzz"}
RULE = "=" * 78
# The sentence that the licence of the Independent JPEG Group requires in a program's documents.
IJG = "This software is based in part on the work of the Independent JPEG Group."


def notices(folder, named=None):
    """The notices in a crate, as (path in it, text); `named` is its `license-file`."""
    found = []
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        named_so = NOTICE.fullmatch(path.name) or path.parent.name.upper() == "LICENSES"
        fits = named_so and path.suffix not in (".rs", ".py", ".toml") and not ELSEWHERE & set(inside.parts)
        if path.is_file() and (fits or named and inside == Path(named)):
            found.append((inside.as_posix(), path.read_text(encoding="utf-8", errors="replace").strip()))
    return found


def standard(package):
    """The standard text of the licence of a crate that ships no text."""
    expression = package["license"] or ""
    # For several licences that hold at once, one text is not enough.
    allowed = [] if " AND " in expression else re.split(r"\s+OR\s+|/", expression)
    if "MIT" in allowed:
        authors = ", ".join(package["authors"]) or f"the authors of {package['name']}"
        return mit(authors)
    if "Apache-2.0" in allowed:
        return (crates.ROOT / "LICENSE-APACHE").read_text(encoding="utf-8").strip()
    raise ValueError(
        f"{package['name']} {package['version']}: ships no text of its licence ({package['license']}), and packaging/licences.py "
        "knows the standard texts of MIT and Apache-2.0 only; add that licence's to `standard`"
    )


def mit(holder):
    ours = (crates.ROOT / "LICENSE-MIT").read_text(encoding="utf-8")
    return f"MIT License\n\nCopyright (c) {holder}\n\n{ours[ours.index('Permission is hereby granted') :].strip()}"


def of_crate(package):
    """The notices that must accompany a crate: its own, and the standard text of its licence if none of them
    is a licence.
    """
    found = notices(Path(package["manifest_path"]).parent, package["license_file"])

    def whole(path, text):
        path = Path(path)
        # A text of a few lines only names the place of the licence.
        named_so = LICENCE.fullmatch(path.name) or path.parent.name.upper() == "LICENSES" or path == Path(package["license_file"] or "")
        return named_so and len(text) > 200

    if not any(whole(*notice) for notice in found):
        found.append(("the standard text, as the crate ships none", standard(package)))
    return found


def of_standard_library():
    """The notices that come with the toolchain, without their markup."""
    path = Path(crates.asked(["rustc", "--print", "sysroot"]).strip()) / "share/doc/rust/COPYRIGHT-library.html"
    if not path.is_file():
        sys.exit(f"{path}: the notices of the Rust standard library are expected there; install Rust with rustup, which brings them")
    page = path.read_text(encoding="utf-8")
    text = html.unescape(re.sub(r"<[^>]+>", "", page[page.index("<body") :]))
    return re.sub(r"\n\s*\n\s*\n", "\n\n", "\n".join(line.rstrip() for line in text.splitlines())).strip()


def document(program):
    keys = program.others()
    lines = [
        "Software by others in use3d",
        "",
        f"The program `use3d` for {program.target} contains code of the {len(keys)} crates below, of the Rust standard library"
        f"{' and of musl' if program.target.endswith('-musl') else ''}.",
        "Their notices follow, each text once. What is 3D-USE's own is under LICENSE-MIT or LICENSE-APACHE.",
        "",
    ]
    if any("IJG" in (program.crates[key]["license"] or "") for key in keys):
        lines += [IJG, ""]
    texts = {}
    for key in keys:
        package = program.crates[key]
        where = package["repository"] or f"https://crates.io/crates/{package['name']}"
        lines.append(f"{package['name']} {package['version']}: {(package['license'] or 'see below').replace('/', ' OR ')}; {where}")
        for path, text in of_crate(package):
            # Texts that differ only in their line breaks count as the same text.
            texts.setdefault(" ".join(text.split()), (text, []))[1].append(f"{package['name']} {package['version']} ({path})")
    for text, of in texts.values():
        lines += ["", RULE, *of, RULE, "", text]
    if program.target.endswith("-musl"):
        lines += ["", RULE, "musl, the C library of the static program (https://musl.libc.org)", RULE, "", mit("2005-2020 Rich Felker, et al.")]
    lines += ["", RULE, "The Rust standard library", RULE, "", of_standard_library()]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    crates.add_arguments(parser)
    words = parser.parse_args()
    try:
        text = document(crates.Program(**vars(words)))
    except ValueError as error:
        sys.exit(str(error))
    sys.stdout.buffer.write(f"{text}\n".encode())


if __name__ == "__main__":
    main()
