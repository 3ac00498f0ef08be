#!/usr/bin/env python3
"""A bill of materials (CycloneDX 1.5, JSON) of the `use3d` program, from Cargo.lock: every crate that is built into it, with version,
licence and checksum.

    packaging/sbom.py [--target TRIPLE] [--no-default-features] [--features LIST] > use3d.cdx.json

Needs cargo and the standard library. The same lock file gives the same bytes.
"""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def checksums():
    text = (ROOT / "Cargo.lock").read_text(encoding="utf-8")
    found = re.findall(r'name = "([^"]+)"\nversion = "([^"]+)"\n(?:source = "[^"]+"\n)?(?:checksum = "([^"]+)")?', text)
    return {(name, version): checksum for name, version, checksum in found}


def built_into(metadata):
    """The packages that the program is made of: those it reaches by normal dependencies and by build dependencies of these."""
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    root = next(p["id"] for p in metadata["packages"] if p["name"] == "use3d")
    reached, open_ = set(), [root]
    while open_:
        package = open_.pop()
        if package in reached:
            continue
        reached.add(package)
        for dependency in nodes[package]["deps"]:
            if any(kind["kind"] in (None, "build") for kind in dependency["dep_kinds"]):
                open_.append(dependency["pkg"])
    return root, reached, nodes


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", default="x86_64-unknown-linux-musl")
    parser.add_argument("--no-default-features", action="store_true")
    parser.add_argument("--features", default="")
    words = parser.parse_args()
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--filter-platform", words.target]
    if words.no_default_features:
        command.append("--no-default-features")
    if words.features:
        command += ["--features", ",".join(f"use3d/{name}" for name in words.features.split(","))]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}")
    metadata = json.loads(done.stdout)
    packages = {package["id"]: package for package in metadata["packages"]}
    root, reached, nodes = built_into(metadata)
    sums = checksums()

    def reference(package):
        return f"pkg:cargo/{package['name']}@{package['version']}"

    def component(package):
        entry = {
            "type": "application" if package["id"] == root else "library",
            "bom-ref": reference(package),
            "name": package["name"],
            "version": package["version"],
            "purl": reference(package),
        }
        if package["license"]:
            # Older crates write `/` where SPDX has OR.
            entry["licenses"] = [{"expression": package["license"].replace("/", " OR ")}]
        checksum = sums.get((package["name"], package["version"]))
        if checksum:
            entry["hashes"] = [{"alg": "SHA-256", "content": checksum}]
        return entry

    ids = sorted(reached, key=lambda i: (packages[i]["name"], packages[i]["version"]))
    document = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": component(packages[root])},
        "components": [component(packages[i]) for i in ids if i != root],
        "dependencies": [
            {
                "ref": reference(packages[i]),
                "dependsOn": sorted({reference(packages[d]) for d in nodes[i]["dependencies"] if d in reached}),
            }
            for i in ids
        ],
    }
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
