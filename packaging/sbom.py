#!/usr/bin/env python3
"""Writes a bill of materials (CycloneDX 1.5, JSON) of the `use3d` program: every crate that is built into it,
with version, licence and checksum. Crates that only build others have the scope `excluded`.

    packaging/sbom.py [--target TRIPLE] [--no-default-features] [--features LIST] > use3d.cdx.json

Needs cargo and the standard library. The same lock file gives the same bytes.
"""

import argparse
import json
import re

import crates


def checksums():
    text = (crates.ROOT / "Cargo.lock").read_text(encoding="utf-8")
    found = re.findall(r'name = "([^"]+)"\nversion = "([^"]+)"\n(?:source = "[^"]+"\n)?(?:checksum = "([^"]+)")?', text)
    return {(name, version): checksum for name, version, checksum in found}


def bill(program):
    sums = checksums()

    def reference(key):
        return f"pkg:cargo/{key[0]}@{key[1]}"

    def component(key):
        package = program.crates[key]
        entry = {
            "type": "application" if key == program.root else "library",
            "bom-ref": reference(key),
            "name": package["name"],
            "version": package["version"],
            "purl": reference(key),
        }
        if key not in program.linked:
            entry["scope"] = "excluded"
        if package["license"]:
            # Older crates write `/` instead of SPDX's OR.
            entry["licenses"] = [{"expression": package["license"].replace("/", " OR ")}]
        if sums.get(key):
            entry["hashes"] = [{"alg": "SHA-256", "content": sums[key]}]
        return entry

    keys = sorted(program.needs)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": component(program.root)},
        "components": [component(key) for key in keys if key != program.root],
        "dependencies": [
            {"ref": reference(key), "dependsOn": sorted(reference(needed) for needed in program.needs[key])} for key in keys
        ],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    crates.add_arguments(parser)
    print(json.dumps(bill(crates.Program(**vars(parser.parse_args()))), indent=1))


if __name__ == "__main__":
    main()
