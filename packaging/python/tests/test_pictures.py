"""Tests of pictures: files by other hands are read, small ones are written, and notebooks show them."""

import base64
import io
import json
import math
import os
import re
import struct
import sys
import tempfile
import unittest
import zlib
from contextlib import redirect_stderr
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np  # noqa: E402
import use3d  # noqa: E402
from use3d import _pictures  # noqa: E402


def png(pixels, filters, colour, depth=8):
    """A PNG by the text of the standard, one byte after the other; row `i` has the filter `filters[i]`."""
    height, width, channels = pixels.shape
    flat = pixels.reshape(height, -1).tolist()
    rows = b""
    for y, row in enumerate(flat):
        rows += bytes([filters[y]])
        for x, value in enumerate(row):
            a = row[x - channels] if x >= channels else 0
            b = flat[y - 1][x] if y else 0
            c = flat[y - 1][x - channels] if y and x >= channels else 0
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            rows += bytes([(value - [0, a, b, (a + b) // 2, nearest][filters[y]]) % 256])
    data = b"\x89PNG\r\n\x1a\n"
    packed = zlib.compress(rows)
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    for kind, chunk in [(b"IHDR", head), (b"IDAT", packed[:9]), (b"IDAT", packed[9:]), (b"IEND", b"")]:
        data += struct.pack(">I", len(chunk)) + kind + chunk + struct.pack(">I", zlib.crc32(kind + chunk))
    return data


def exr(planes, compression):
    """An EXR of lines (0: plain, 3: ZIP) by the text of the standard."""

    def field(name, kind, value):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    names = sorted(planes)
    height, width = planes[names[0]].shape
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iIii", 2, 0, 1, 1) for name in names) + b"\0"
    head = field(b"channels", b"chlist", channels) + field(b"compression", b"compression", bytes([compression]))
    head += field(b"dataWindow", b"box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)) + b"\0"
    lines = 16 if compression else 1
    blocks = []
    for y in range(0, height, lines):
        data = b"".join(planes[n][r].astype("<f4").tobytes() for r in range(y, min(y + lines, height)) for n in names)
        if compression:
            split = data[0::2] + data[1::2]
            steps = bytes([split[0]] + [(split[i] - split[i - 1] + 128) % 256 for i in range(1, len(split))])
            data = min(zlib.compress(steps), data, key=len)
        blocks.append(struct.pack("<iI", y, len(data)) + data)
    return struct.pack("<ii", 20000630, 2) + head + bytes(8 * len(blocks)) + b"".join(blocks)


class Pictures(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.numbers = np.random.default_rng(7)

    def test_a_png_with_every_filter_is_read_and_one_of_ours_too(self):
        for shape, colour in [((11, 7, 3), 2), ((6, 13, 1), 0), ((5, 1, 4), 6), ((1, 9, 2), 4)]:
            pixels = self.numbers.integers(0, 256, shape, "u1")
            (self.folder / "a.png").write_bytes(png(pixels, [y % 5 for y in range(shape[0])], colour))
            np.testing.assert_array_equal(_pictures.read_png(self.folder / "a.png"), pixels)
        pixels = self.numbers.integers(0, 256, (9, 8, 3), "u1")
        (self.folder / "b.png").write_bytes(_pictures._as_png(pixels))
        np.testing.assert_array_equal(_pictures.read_png(self.folder / "b.png"), pixels)

    def test_an_exr_is_read_with_and_without_compression(self):
        # 37 lines are two full blocks and a part; random bits do not shrink, so they are stored as they are.
        smooth = np.add.outer(np.arange(37), np.arange(5)).astype("f4") / 3
        noise = self.numbers.integers(0, 2**32, (37, 5), "u4").view("f4")
        for planes in ({"R": smooth, "G": -smooth, "B": smooth**2}, {"Z": noise}):
            for compression in (0, 3):
                (self.folder / "a.exr").write_bytes(exr(planes, compression))
                read = use3d.read_exr(self.folder / "a.exr")
                self.assertEqual(sorted(read), sorted(planes))
                for name, plane in planes.items():
                    np.testing.assert_array_equal(read[name].view("u4"), plane.view("u4"))

    def test_what_is_no_picture_is_said(self):
        good = exr({"Z": np.ones((20, 3), "f4")}, 3)
        large = good.replace(struct.pack("<4i", 0, 0, 2, 19), struct.pack("<4i", 0, 0, 2**15, 2**12))
        for data in [b"", good[:8], good[:60], good[:-9], large, good.replace(b"Z\0\x02", b"Z\0\x01"), b"\0" * 99]:
            (self.folder / "a.exr").write_bytes(data)
            with self.assertRaisesRegex(use3d.FormatError, "a.exr: no EXR"):
                use3d.read_exr(self.folder / "a.exr")
        pixels = np.zeros((4, 3, 3), "u1")
        good = png(pixels, [0] * 4, 2)
        for data in [b"", good[:20], good[:-30], png(pixels, [0] * 4, 3), png(pixels, [0] * 4, 2, 16)]:
            (self.folder / "a.png").write_bytes(data)
            with self.assertRaisesRegex(use3d.FormatError, "a.png: no PNG"):
                _pictures.read_png(self.folder / "a.png")

    def test_small_pictures_have_means_of_squares(self):
        def shown(pixels, side):
            text = re.search("base64,([^\"]+)\" width=\"(\\d+)\" height=\"(\\d+)\"", _pictures.small(pixels, side))
            (self.folder / "s.png").write_bytes(base64.b64decode(text[1]))
            read = _pictures.read_png(self.folder / "s.png")
            self.assertEqual(read.shape[:2], (int(text[3]), int(text[2])))
            return read

        pixels = self.numbers.integers(0, 256, (10, 17, 3), "u1")
        np.testing.assert_array_equal(shown(pixels, 17), pixels)
        half = np.round(pixels[:, :16].reshape(5, 2, 8, 2, 3).mean((1, 3)))
        np.testing.assert_array_equal(shown(pixels, 9), half)
        np.testing.assert_array_equal(shown(np.array([[[0.5], [2.0], [np.nan]]], "f4"), 9)[0, :, 1], [128, 255, 0])
        self.assertEqual(shown(np.zeros((2, 99, 3), "u1"), 9).shape, (1, 9, 3))

    def results(self, views=("a", "b", "c")):
        scene = self.folder / "reef" / "enhanced-scene"
        scene.mkdir(parents=True)
        (scene / "scene.json").write_text('{"format": "3d-use scene", "enhancement": {"file": "ubaf.safetensors"}}')
        for look in ("captured", "enhanced", "clear"):
            for view in views:
                path = self.folder / "reef" / "renders" / look / f"{view}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(_pictures._as_png(np.full((90, 160, 3), ord(view), "u1")))
        return use3d.Results(self.folder)

    def test_a_notebook_shows_three_looks_of_the_view_in_the_middle(self):
        results = self.results()
        middle = _pictures.small(np.full((90, 160, 3), ord("b"), "u1"), 320)
        for shown in (results, results.scene("reef")):
            text = shown._repr_html_()
            self.assertEqual((text.count("<img"), text.count(middle)), (3, 3))
        (self.folder / "reef" / "renders" / "clear" / "b.png").write_bytes(b"no picture")
        self.assertEqual(results.scene("reef")._repr_html_().count("<img"), 2)
        # Without pictures a notebook takes the text.
        for look in ("captured", "enhanced", "clear"):
            for path in (self.folder / "reef" / "renders" / look).iterdir():
                path.unlink()
        self.assertIsNone(results.scene("reef")._repr_html_())
        self.assertIn("reef", results._repr_html_())

    def test_show_is_a_picture_and_a_link(self):
        scene = self.results().scene("reef")
        text = scene.show()._repr_html_()
        self.assertIn("<code>use3d view ", text)
        (self.folder / "reef" / "view.html").write_text("a page")
        with mock.patch("os.getcwd", return_value=str(self.folder)):
            text = scene.show()._repr_html_()
        self.assertIn('<img src="data:image/png;base64,', text)
        self.assertIn('href="reef/view.html"', text)
        with self.assertRaisesRegex(TypeError, "embed=True"):
            scene.show(cameras="reef")

    def test_all_scores_are_one_flat_table_of_numbers(self):
        results = self.results()
        views = [{"view": "left/f.jpg", "scores": {"psnr": {"value": 30.5}, "lpips": {"not-available": "no weights"}}}]
        pairs = [{"first": "f.jpg", "second": "g.jpg", "scores": {"w_delta_e": {"value": 2}}}]
        method = {"method": "enhanced", "views": views, "neighbours": pairs, "path": []}
        (self.folder / "reef" / "scores").mkdir()
        (self.folder / "reef" / "scores" / "scores.json").write_text(json.dumps({"methods": [method]}))
        view, pair = results.table()
        self.assertEqual([list(view), list(pair)], [["scene", "method", "view", "next_view", "psnr", "lpips", "w_delta_e"]] * 2)
        self.assertEqual((view["view"], view["next_view"], view["psnr"]), ("left/f", "", 30.5))
        self.assertEqual((pair["view"], pair["next_view"], pair["w_delta_e"]), ("f", "g", 2))
        self.assertTrue(all(math.isnan(value) for value in (view["lpips"], view["w_delta_e"], pair["psnr"])))

    def test_a_camera_is_named_or_given(self):
        scene = self.results().scene("reef")
        cameras = [{"name": name} for name in ("a.jpg", "b.jpg", "c.jpg")]
        (scene.folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
        for camera, name in [(None, "b.jpg"), ("a", "a.jpg"), ("c.jpg", "c.jpg"), ({"name": "own"}, "own")]:
            self.assertEqual(scene._camera(camera)["name"], name)
        with self.assertRaisesRegex(KeyError, "cameras.json"):
            scene._camera("d")


@unittest.skipUnless(os.environ.get("USE3D_PROGRAM"), "SKIPPED: set USE3D_PROGRAM to a `use3d` to test with it")
class Documented(unittest.TestCase):
    def test_the_page_of_the_guide_works_line_by_line(self):
        page = (Path(__file__).parents[3] / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
        lines = re.search("```python\n(.+?)```", page, re.DOTALL)[1]
        sets = ["--set", "reconstruct.iterations=12", "--set", "enhance.iterations=6", "--cache", "cache"]
        real = use3d.run

        def quick(*words, **options):
            return real(*words, *(sets if words[0] == "run" else []), **options)

        before = os.getcwd()
        with tempfile.TemporaryDirectory() as folder, mock.patch.object(use3d, "run", quick), redirect_stderr(io.StringIO()):
            os.chdir(folder)
            try:
                real("synth", "capture", "--out", "my-reef", "--views", "9", "--size", "64x48")
                names, values = {}, {}
                for line in lines.splitlines():
                    code = line.split("  #")[0].strip()
                    if re.match("import|[a-z]+ = |$", code):
                        exec(code, names)
                    else:
                        values[code] = eval(code, names)
                # The same cameras as pictures of 8 bits.
                scene = names["scene"]
                real("render", scene.folder, "--cameras", scene.folder / "cameras.json", "--out", "png", "--modes", "enhanced,depth")
                name = Path(scene.cameras[0]["name"]).stem
                written = _pictures.read_png(f"png/enhanced/{name}.png")
            finally:
                os.chdir(before)
        kinds = {code: type(value).__name__ for code, value in values.items()}
        self.assertEqual(list(kinds.values())[:3], ["str", "dict", "list"])
        picture, clear, depth, x, coefficients = (v for v in values.values() if isinstance(v, np.ndarray))
        np.testing.assert_array_equal((255 * np.clip(picture, 0, 1) + 0.5).astype("u1"), written)
        self.assertEqual((clear.shape, depth.shape), ((240, 320, 3), (48, 64)))
        self.assertTrue((depth >= 0).all() and depth.max() > 0 and len(x) and coefficients.ndim == 4)
        table = values["results.table()"]
        self.assertEqual({type(value) for row in table for key, value in row.items() if key == "psnr"}, {float})
        try:
            import pandas
        except ImportError:
            pandas = None
        if pandas:
            frame = pandas.DataFrame(table)
            self.assertEqual({str(frame[name].dtype) for name in ("psnr", "ssim", "w_delta_e")}, {"float64"})
        self.assertIn("<a href=", values["scene.show()"]._repr_html_())
        self.assertLess(len(values["scene.show()"].page), 400_000)


if __name__ == "__main__":
    unittest.main()
