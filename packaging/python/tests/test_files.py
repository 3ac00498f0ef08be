"""The module's own tests: python3 -m unittest discover packaging/python/tests (needs NumPy).

With USE3D_PROGRAM set to a `use3d`, the whole pipeline runs on a tiny capture, and its output is read.
"""

import json
import os
import struct
import sys
import tempfile
import unittest
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np  # noqa: E402
import use3d  # noqa: E402


def safetensors(header, data=b""):
    text = (header if isinstance(header, str) else json.dumps(header)).encode()
    return struct.pack("<Q", len(text)) + text + data


class Files(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.path = Path(folder.name) / "file"

    def test_tensors_come_back_as_they_were(self):
        a = np.arange(6, dtype="<f4").reshape(2, 3)
        header = {
            "a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]},
            "none": {"dtype": "U8", "shape": [0, 4], "data_offsets": [24, 24]},
            "one": {"dtype": "I64", "shape": [], "data_offsets": [24, 32]},
            "__metadata__": {"by": "test"},
        }
        self.path.write_bytes(safetensors(header, a.tobytes() + struct.pack("<q", -7)))
        read = use3d.read_safetensors(self.path)
        self.assertEqual(sorted(read), ["a", "none", "one"])
        np.testing.assert_array_equal(read["a"], a)
        self.assertEqual((read["none"].shape, int(read["one"])), ((0, 4), -7))

    def test_what_is_no_safetensors_file_is_said(self):
        good = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
        wrong = [
            b"",
            b"\xff" * 20,
            struct.pack("<Q", 2) + b"xx",
            struct.pack("<Q", 2) + b"[]",
            safetensors({"a": good}),
            safetensors({"a": {**good, "shape": [3]}}, bytes(8)),
            safetensors({"a": {**good, "shape": [-1, -2]}}, bytes(8)),
            safetensors({"a": {**good, "dtype": "F31"}}, bytes(8)),
            safetensors({"a": {**good, "data_offsets": [4, 12]}}, bytes(8)),
            safetensors({"a": {**good, "data_offsets": [-8, 0]}}, bytes(8)),
            safetensors({"a": 1}, bytes(8)),
            # Counts that do not fit into 64 bits or are not counts; descriptions nested too deeply.
            safetensors({"a": {**good, "shape": [2**40, 2**40], "data_offsets": [0, 0]}}),
            safetensors({"a": {**good, "shape": [2**32, 2**32], "data_offsets": [0, 0]}}),
            safetensors({"a": {**good, "shape": [0, 2**70], "data_offsets": [0, 0]}}),
            safetensors({"a": {**good, "shape": [1] * 65, "data_offsets": [0, 4]}}, bytes(8)),
            safetensors({"a": {**good, "shape": [2.0]}}, bytes(8)),
            safetensors({"a": {**good, "shape": "2"}}, bytes(8)),
            safetensors({"a": {**good, "dtype": ["F32"]}}, bytes(8)),
            safetensors('{"a": {"dtype": "F32", "shape": [1e999], "data_offsets": [0, 8]}}', bytes(8)),
            safetensors('{"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 1e999]}}', bytes(8)),
            safetensors('{"a": {"dtype": "F32", "shape": [NaN], "data_offsets": [0, 8]}}', bytes(8)),
            safetensors("[" * 100_000),
            safetensors('{"a":' * 100_000),
        ]
        for data in wrong:
            self.path.write_bytes(data)
            with self.assertRaises(use3d.FormatError, msg=repr(data)) as caught:
                use3d.read_safetensors(self.path)
            self.assertIn(str(self.path), str(caught.exception))

    def test_gaussians_come_back_as_they_were(self):
        head = b"ply\nformat binary_little_endian 1.0\ncomment by\nelement vertex 2\nproperty float x\nproperty uchar r\nend_header\n"
        self.path.write_bytes(head + struct.pack("<fBfB", 1.5, 2, -3.0, 4))
        read = use3d.read_ply(self.path)
        np.testing.assert_array_equal(read["x"], np.array([1.5, -3.0], "f4"))
        np.testing.assert_array_equal(read["r"], [2, 4])
        for old, new in [
            (b"ply", b"PLY"),
            (b"binary_little_endian", b"ascii"),
            (b"vertex 2", b"vertex 3"),
            (b"element vertex", b"element face"),
            (b"property float x", b"property list uchar int x"),
            (b"end_header\n", b""),
            (b"format binary_little_endian 1.0\n", b""),
            (b"vertex 2", b"vertex"),
            (b"vertex 2", b"vertex two"),
            (b"vertex 2", b"vertex -1"),
            (b"vertex 2", b"vertex 2 3"),
            (b"vertex 2", b"vertex 4611686018427387904"),
            (b"vertex 2", b"vertex " + b"9" * 1000),
            (b"vertex 2\n", b"vertex 2\nelement vertex 1\n"),
            (b"property uchar r", b"property uchar x"),
            (b"property uchar r", b"property uchar"),
            (b"comment by\n", b"comment " + b"y" * (1 << 13) + b"\n"),
            (b"comment by\n", b"comment by\n" * 100_000),
        ]:
            self.path.write_bytes((head + struct.pack("<fBfB", 1.5, 2, -3.0, 4)).replace(old, new))
            with self.assertRaises(use3d.FormatError, msg=repr(new)[:80]) as caught:
                use3d.read_ply(self.path)
            self.assertIn(str(self.path), str(caught.exception))

    def test_folders_that_are_none_are_said(self):
        with self.assertRaises(use3d.FormatError):
            use3d.Scene(self.path.parent)
        (self.path.parent / "scene.json").write_text('{"format": "other"}')
        with self.assertRaises(use3d.FormatError):
            use3d.Scene(self.path.parent)
        with self.assertRaises(FileNotFoundError):
            use3d.Results(self.path)

    def test_scores_that_are_not_there_are_told_from_a_scene_that_is_not(self):
        with tempfile.TemporaryDirectory() as folder:
            scene = Path(folder) / "reef" / "scene"
            scene.mkdir(parents=True)
            (scene / "scene.json").write_text('{"format": "3d-use scene"}')
            results = use3d.Results(folder)
            with self.assertRaisesRegex(KeyError, "there are: reef"):
                results.scores("wreck")
            with self.assertRaisesRegex(FileNotFoundError, "evaluate"):
                results.scores("reef")

    def test_pictures_and_tables_are_found_by_name(self):
        with tempfile.TemporaryDirectory() as folder:
            scene = Path(folder) / "reef" / "scene"
            scene.mkdir(parents=True)
            (scene / "scene.json").write_text('{"format": "3d-use scene"}')
            results = use3d.Results(folder)
            self.assertEqual((results.pictures("reef"), results.tables), ({}, []))
            for mode, view in [("clear", "b"), ("clear", "a"), ("depth", "a")]:
                path = Path(folder) / "reef" / "renders" / mode / f"{view}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(b"")
            (Path(folder) / "tables").mkdir()
            (Path(folder) / "tables" / "water.csv").write_bytes(b'scene,psnr,published,lpips\r\n"reef, north",28.5,false,\r\n')
            pictures = results.pictures("reef")
            self.assertEqual({mode: list(views) for mode, views in pictures.items()}, {"clear": ["a", "b"], "depth": ["a"]})
            self.assertTrue(pictures["clear"]["a"].is_file())
            self.assertEqual(results.tables, ["water"])
            (row,) = results.table("water")
            self.assertTrue(np.isnan(row.pop("lpips")))
            self.assertEqual(row, {"scene": "reef, north", "psnr": 28.5, "published": False})
            with self.assertRaisesRegex(KeyError, "there are: water"):
                results.table("air")
            with self.assertRaisesRegex(KeyError, "there are: reef"):
                results.pictures("wreck")

    def test_the_module_names_its_version_and_has_types(self):
        source = (Path(use3d.__file__).parents[3] / "Cargo.toml").read_text(encoding="utf-8")
        self.assertIn(f'\nversion = "{use3d.__version__}"\n', source)
        self.assertTrue((Path(use3d.__file__).parent / "py.typed").is_file())

    def test_a_description_that_is_none_is_said_with_its_field(self):
        scene = {"format": "3d-use scene", "medium": {"kind": "rbf", "file": "medium.safetensors"}, "enhancement": None}
        path = self.path.parent / "scene.json"
        for text, field in [
            ("[]", "a list"),
            ("3", "a number"),
            ("[" * 100_000, "not JSON"),
            ({"medium": "none"}, "`medium`"),
            ({"medium": [1]}, "`medium`"),
            ({"enhancement": True}, "`enhancement`"),
            ({"enhancement": {"file": 3}}, "`enhancement.file`"),
            ({"medium": {"file": "/etc/passwd"}}, "`medium.file`"),
            ({"medium": {"file": "../medium.safetensors"}}, "`medium.file`"),
            ({"medium": {"file": ".."}}, "`medium.file`"),
            ({"medium": {"file": ""}}, "`medium.file`"),
            ({"medium": {"file": "a\0b"}}, "`medium.file`"),
            ({"gaussians": "/dev/zero"}, "`gaussians`"),
            ({"gaussians": None}, "`gaussians`"),
        ]:
            path.write_text(text if isinstance(text, str) else json.dumps({**scene, **text}))
            with self.assertRaises(use3d.FormatError, msg=str(text)[:80]) as caught:
                use3d.Scene(path.parent)
            self.assertIn(str(path), str(caught.exception))
            self.assertIn(field, str(caught.exception))
        path.write_text(json.dumps({**scene, "medium": {"kind": "none"}}))
        self.assertEqual(use3d.Scene(path.parent).medium, {})
        path.write_text(json.dumps({**scene, "medium": {"kind": "none", "file": None}}))
        self.assertEqual(use3d.Scene(path.parent).enhancement, {})


@unittest.skipUnless(os.environ.get("USE3D_PROGRAM"), "SKIPPED: set USE3D_PROGRAM to a `use3d` to test with it")
class Command(unittest.TestCase):
    def test_a_capture_goes_through_and_is_read_back(self):
        with tempfile.TemporaryDirectory() as folder:
            folder = Path(folder)
            use3d.run("synth", "capture", "--out", folder / "reef", "--views", "9", "--size", "64x48")
            sets = ["reconstruct.iterations=12", "enhance.iterations=6"]
            words = [word for one in sets for word in ("--set", one)]
            use3d.run("run", folder / "reef", "--cache", folder / "cache", "--out", folder / "out", *words)
            results = use3d.Results(folder / "out")
            self.assertEqual(results.scenes, ["reef"])
            scene = results.scene("reef")
            self.assertTrue(len(scene.gaussians) > 0 and np.isfinite(scene.gaussians["x"]).all())
            self.assertEqual(scene.medium["coefficients"].shape[1:], (3, 16, 3))
            self.assertEqual(scene.enhancement["factors"].shape[:2], (4, 16))
            self.assertEqual(results.scores("reef")["format"], "3d-use scores")
            pictures = results.pictures("reef")
            self.assertTrue({"clear", "depth"} <= set(pictures), sorted(pictures))
            self.assertTrue(all(path.is_file() for views in pictures.values() for path in views.values()))
            self.assertTrue(results.tables and all(results.table(name) for name in results.tables), results.tables)
            self.assertIn("<iframe srcdoc=", scene.show(embed=True, force=True, metres_per_unit=2.5)._repr_html_())
            plan = use3d.run("plan", folder / "reef", "--cache", folder / "cache", "--json", *words)
            self.assertTrue(all(node["state"] == "cached" for node in plan["nodes"]))
            with self.assertRaises(use3d.CommandFailed) as caught:
                use3d.run("run", folder / "nothing")
            self.assertEqual(caught.exception.code, 2)
            with self.assertRaises(KeyError):
                results.scene("wreck")


if __name__ == "__main__":
    unittest.main()
