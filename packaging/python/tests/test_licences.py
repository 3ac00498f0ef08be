"""Tests that the notices of others and the bill of materials name the crates of the program."""

import json
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

PACKAGING = Path(__file__).parents[2]
sys.path.insert(0, str(PACKAGING))

import crates  # noqa: E402
import licences  # noqa: E402
import sbom  # noqa: E402


@unittest.skipUnless(shutil.which("cargo"), "needs cargo, with the crates of this machine's program")
class Program(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.program = crates.Program()

    def test_the_bill_lists_the_program_and_nothing_beside_it(self):
        command = ["cargo", "tree", "--locked", "-p", "use3d", "-e", "normal,build", "--prefix", "none", "--no-dedupe"]
        told = subprocess.run(command, cwd=PACKAGING.parent, stdout=subprocess.PIPE, check=True, text=True).stdout
        # If cargo unifies features, the workspace's other members follow after an empty line.
        tree = {tuple(line.split()[:2]) for line in told.split("\n\n")[0].splitlines()}
        bill = sbom.bill(self.program)
        listed = [(part["name"], f"v{part['version']}") for part in [bill["metadata"]["component"], *bill["components"]]]
        self.assertEqual(sorted(listed), sorted(tree))
        # Only tests or other programs of the workspace use these.
        self.assertFalse({"proptest", "criterion"} & {name for name, _ in listed})
        self.assertEqual([p["scope"] for p in bill["components"] if p["name"] == "cc"], ["excluded"])
        references = {part["bom-ref"] for part in bill["components"]} | {bill["metadata"]["component"]["bom-ref"]}
        for entry in bill["dependencies"]:
            self.assertLessEqual({entry["ref"], *entry["dependsOn"]}, references)
        json.dumps(bill)

    def test_no_crate_is_without_its_licence(self):
        text = licences.document(self.program)
        flat = " ".join(text.split())
        self.assertGreater(len(self.program.others()), 100)
        for key in self.program.others():
            self.assertIn(f"\n{key[0]} {key[1]} (", text, f"{key} is under no text")
            of = licences.of_crate(self.program.crates[key])
            self.assertTrue(any(len(notice) > 200 for _, notice in of), f"{key}: {of}")
            for path, notice in of:
                self.assertIn(" ".join(notice.split()), flat, f"{key}: {path}")
        self.assertIn(licences.IJG, text)
        self.assertIn("The Rust Project Developers", text)


class Crate(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def crate(self, licence, authors=()):
        manifest = str(self.folder / "Cargo.toml")
        return {
            "name": "reef", "version": "1.2.3", "license": licence, "license_file": None, "authors": list(authors),
            "manifest_path": manifest,
        }  # fmt: skip

    def test_a_crate_without_text_has_the_standard_one_with_its_authors(self):
        ((_, text),) = licences.of_crate(self.crate("Apache-2.0/MIT", ["Ann <a@b.c>", "Bo"]))
        self.assertIn("Copyright (c) Ann <a@b.c>, Bo\n\nPermission is hereby granted", text)
        ((_, text),) = licences.of_crate(self.crate("Apache-2.0"))
        self.assertIn("Apache License", text)
        # A notice is not a licence.
        (self.folder / "NOTICE").write_text("with thanks to all\n")
        self.assertEqual([path for path, _ in licences.of_crate(self.crate("MIT"))][0], "NOTICE")
        self.assertEqual(len(licences.of_crate(self.crate("MIT"))), 2)
        for licence in ("BSD-3-Clause", "(MIT OR Apache-2.0) AND IJG", None):
            with self.assertRaisesRegex(ValueError, "reef 1.2.3"):
                licences.of_crate(self.crate(licence))

    def test_notices_are_found_in_folders_too_but_not_those_of_tests(self):
        for path in ("LICENSE-MIT", "src/tables/LICENSE-UNICODE", "tests/COPYRIGHT", "src/license.rs", "README.md", "LICENSES/ISC.txt"):
            (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / path).write_text("x" * 300)
        found = [path for path, _ in licences.of_crate(self.crate("MIT"))]
        self.assertEqual(found, ["LICENSE-MIT", "LICENSES/ISC.txt", "src/tables/LICENSE-UNICODE"])


if __name__ == "__main__":
    unittest.main()
