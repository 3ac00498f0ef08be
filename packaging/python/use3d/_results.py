"""Reads the output of a run: results folders and scene folders."""

from __future__ import annotations

import csv
import html
import json
import math
import os
import tempfile
from pathlib import Path, PurePath
from typing import Any, Union
from urllib.parse import quote

from ._command import run
from ._files import FormatError, np, read_ply, read_safetensors
from ._pictures import read_exr, read_png, small

# A camera as in `cameras.json`, or the name of one of these.
Camera = Union[str, "dict[str, Any]"]

# Looks of which a notebook shows a picture, each with its caption.
_LOOKS = {"captured": "photograph", "enhanced": "enhanced", "clear": "clear"}
# Scenes of which a notebook shows pictures.
_SHOWN = 4


def _kind(value):
    """The JSON name of a value's type."""
    kinds = {dict: "an object", list: "a list", str: "text", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")


def _json(path):
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not JSON: {error}") from error


class Scene:
    """A scene folder: its `description`, and as arrays `gaussians`, `medium` and `enhancement`, each read at
    its first use.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        path = self.folder / "scene.json"
        if not path.is_file():
            raise FormatError(f"{self.folder}: no scene folder, there is no scene.json in it")
        self.description = _json(path)
        if not isinstance(self.description, dict):
            raise FormatError(f"{path}: it holds {_kind(self.description)}; a description of a scene is expected")
        if self.description.get("format") != "3d-use scene":
            raise FormatError(f"{path}: format {self.description.get('format')!r}; '3d-use scene' is expected")
        self._read: dict[str, Any] = {}
        self._gaussians = self._file("gaussians", self.description.get("gaussians", "gaussians.ply"))
        self._medium, self._enhancement = self._part("medium"), self._part("enhancement")

    def _part(self, part):
        """The file that a part's entry names, if there is one."""
        entry = self.description.get(part)
        if entry is None:
            return None
        if not isinstance(entry, dict):
            raise FormatError(f"{self.folder / 'scene.json'}: `{part}` is {_kind(entry)}; an object with `file` is expected")
        return None if entry.get("file") is None else self._file(f"{part}.file", entry["file"])

    def _file(self, field, name):
        plain = isinstance(name, str) and name not in ("", ".", "..") and PurePath(name).name == name
        if not plain or "\\" in name or "\0" in name:
            shown = repr(name) if isinstance(name, str) else _kind(name)
            raise FormatError(
                f"{self.folder / 'scene.json'}: `{field}` is {shown}; the plain name of a file in the scene folder is expected"
            )
        return self.folder / name

    def _once(self, name, read):
        if name not in self._read:
            self._read[name] = read()
        return self._read[name]

    @property
    def gaussians(self) -> np.ndarray:
        """The Gaussians as a structured array: x, y, z, f_dc_0 …, opacity, scale_0 …, rot_0 … as in 3DGS
        files.
        """
        return self._once("gaussians", lambda: read_ply(self._gaussians))

    @property
    def medium(self) -> dict[str, np.ndarray]:
        """The water's tensors by name; empty if there is no water."""
        return self._once("medium", lambda: read_safetensors(self._medium)) if self._medium else {}

    @property
    def enhancement(self) -> dict[str, np.ndarray]:
        """The enhancement's tensors by name; empty for a scene of stage 1."""
        return self._once("enhancement", lambda: read_safetensors(self._enhancement)) if self._enhancement else {}

    @property
    def cameras(self) -> list[dict[str, Any]]:
        """The cameras that the scene was trained with: `name`, `width`, `height`, the lens in pixels, and
        `rotation` (row by row) and `translation` from the frame of the capture's model to the camera.
        """
        return self._once("cameras", lambda: _json(self.folder / "cameras.json")["cameras"])

    def render(self, camera: Camera | None = None, mode: str | None = None, **options: Any) -> np.ndarray:
        """A picture of the scene from one camera: 32-bit numbers of height × width × 3 that are not clamped,
        where 1 is white; one number per pixel for `depth` and `alpha`.

        `camera` is the name of one of `cameras`, or a dict like those; the default is the one in the middle.
        `mode` is `enhanced`, or `reconstruction` for a scene of stage 1, unless you name another.
        `options` are those of `use3d render`, such as `size="640x360"` or `water=0.5`.
        """
        with tempfile.TemporaryDirectory() as folder:
            camera, mode = {**self._camera(camera), "name": "view"}, mode or self._look()
            (Path(folder) / "camera.json").write_text(json.dumps([camera]), encoding="utf-8")
            words = ["--cameras", Path(folder) / "camera.json", "--out", folder, "--modes", mode, "--format", "exr"]
            run("--quiet", "render", self.folder, *words, *_words(options))
            channels = read_exr(Path(folder) / mode / "view.exr")
        return np.stack([channels[name] for name in "RGB"], 2) if "R" in channels else next(iter(channels.values()))

    def depth(self, camera: Camera | None = None, **options: Any) -> np.ndarray:
        """The depth along the optical axis from one camera, in units of the scene, as height × width; 0 where
        nothing is. Divided by `description["frame"]["scale"]` it has the units of the capture's model.
        """
        return self.render(camera, "depth", **options)

    def _camera(self, camera):
        if isinstance(camera, dict):
            return camera
        if camera is None:
            return self.cameras[len(self.cameras) // 2]
        for one in self.cameras:
            if camera in (one["name"], _stem(one["name"])):
                return one
        raise KeyError(f"no camera {camera!r} in {self.folder / 'cameras.json'}; its names are in Scene.cameras")

    def show(self, height: int = 600, embed: bool = False, **options: Any) -> _Page:
        """The scene for a notebook: a picture, and a link to the page on which one walks through the scene.
        With `embed=True` the whole page is in the notebook, which grows by its megabytes. `options` are those
        of `use3d export`, such as `cameras="my-reef/"`; they make a new page, so they need `embed=True`.
        """
        if embed:
            page = html.escape(self._page(options), quote=True)
            return _Page(
                f'<iframe srcdoc="{page}" width="100%" height="{int(height)}" style="border:0" sandbox="allow-scripts"></iframe>'
            )
        if options:
            raise TypeError(f"{', '.join(options)}: an option makes a new page; pass embed=True as well")
        path = _middle(self._renders(self._look()))
        picture = small(read_png(path) if path else self.render(), 640)
        page = self.folder.parent / "view.html"
        if page.is_file():
            try:
                place = Path(os.path.relpath(page)).as_posix()
            except ValueError:  # On another drive.
                place = page.as_posix()
            link = f'<a href="{html.escape(quote(place, safe="/:"))}" target="_blank">Walk through the scene</a>'
        else:
            link = f"<code>use3d view {html.escape(str(self.folder))}</code> opens the scene to walk through"
        return _Page(f"<p>{picture}<br>{link}</p>")

    def _page(self, options):
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "scene.html"
            run("export", self.folder, "--web", page, *_words(options))
            return page.read_text(encoding="utf-8")

    def _look(self):
        return "enhanced" if self.description.get("enhancement") else "reconstruction"

    def _renders(self, look):
        return sorted((self.folder.parent / "renders" / look).glob("*.png"))

    def _repr_html_(self):
        return _row(repr(self), {look: _middle(self._renders(look)) for look in _LOOKS}, 320)

    def __repr__(self):
        kind = (self.description.get("medium") or {}).get("kind", "none")
        more = ", enhanced" if self.description.get("enhancement") else ""
        return f"Scene({str(self.folder)!r}, medium {kind}{more})"


class _Page:
    """HTML that a notebook shows."""

    def __init__(self, page):
        self.page = page

    def _repr_html_(self):
        return self.page


def _words(options):
    """Keyword arguments as options of the command."""
    words = []
    for name, value in options.items():
        if value is not None and value is not False:
            words += [f"--{name.replace('_', '-')}"] + ([] if value is True else [value])
    return words


def _stem(name):
    """A view's name without the extension of its photograph."""
    return os.path.splitext(name)[0]


def _middle(paths):
    return paths[len(paths) // 2] if paths else None


def _row(title, paths, side):
    """A line of small pictures; nothing if there is none, so that a notebook shows the text alone."""
    cells = []
    for look, path in paths.items():
        try:
            cells += [f"<td>{small(read_png(path), side)}<br>{_LOOKS[look]}</td>"] if path else []
        except (FormatError, ImportError):
            continue
    return f"<p>{html.escape(title)}</p><table><tr>{''.join(cells)}</tr></table>" if cells else None


def _value(column, text):
    """A cell of a table: text where a column has names, else a number, NaN where there is none."""
    if column in ("scene", "method", "made by"):
        return text
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text or "nan")
    except ValueError:
        return text


class Results:
    """A folder that `use3d run` has filled."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{self.folder}: there is no such folder of results")

    @property
    def scenes(self) -> list[str]:
        """The names of its scenes, with variants as `scene@variant`."""
        found = {p.parent.parent for name in ("scene", "enhanced-scene") for p in self.folder.glob(f"**/{name}/scene.json")}
        return sorted(str(path.relative_to(self.folder)) for path in found)

    def scene(self, name: str) -> Scene:
        """The scene with this name; the enhanced one if there is one."""
        for part in ("enhanced-scene", "scene"):
            if (self.folder / name / part / "scene.json").is_file():
                return Scene(self.folder / name / part)
        raise self._unknown(name)

    def scores(self, name: str) -> dict[str, Any]:
        """`scores.json` of a scene."""
        path = self.folder / name / "scores" / "scores.json"
        if path.is_file():
            return _json(path)
        if name not in self.scenes:
            raise self._unknown(name)
        raise FileNotFoundError(f"{path}: there is no such file; `use3d run` writes it when the stage `evaluate` is done")

    def pictures(self, name: str) -> dict[str, dict[str, Path]]:
        """The rendered pictures of a scene: a dict from mode (`clear`, `enhanced-clear`, `depth`, …) to a
        dict from view to path.
        """
        folder = self.folder / name / "renders"
        if not folder.is_dir() and name not in self.scenes:
            raise self._unknown(name)
        found: dict[str, dict[str, Path]] = {}
        for path in sorted(folder.glob("*/**/*.png")):
            mode, *view = path.relative_to(folder).parts
            found.setdefault(mode, {})["/".join(view)[:-4]] = path
        return found

    def table(self, name: str | None = None) -> list[dict[str, Any]]:
        """A flat table as a list of rows, each a dict from column to value, for `pandas.DataFrame`.

        Without a name: all scores of all scenes. A row is a view in one look (`method`), or a pair of
        neighbouring views (`next_view` is not empty); a score that it does not have is NaN. With a name: that
        table of the report (`tables/NAME.csv`); its numbers are rounded as in the report.
        """
        if name is None:
            return self._all_scores()
        path = self.folder / "tables" / f"{name}.csv"
        if not path.is_file():
            raise KeyError(f"no table {name!r} in {self.folder}; there are: {', '.join(self.tables) or 'none'}")
        with open(path, encoding="utf-8", newline="") as file:
            return [{column: _value(column, text) for column, text in row.items()} for row in csv.DictReader(file)]

    def _all_scores(self):
        rows = []
        for scene in self.scenes:
            if not (self.folder / scene / "scores" / "scores.json").is_file():
                continue
            for method in self.scores(scene)["methods"]:
                for one in [*method["views"], *method["neighbours"], *method["path"]]:
                    places = {"view": _stem(one.get("view") or one["first"]), "next_view": _stem(one.get("second", ""))}
                    scores = {score: value.get("value", math.nan) for score, value in one["scores"].items()}
                    rows.append({"scene": scene, "method": method["method"], **places, **scores})
        columns = dict.fromkeys(column for row in rows for column in row)
        return [{column: row.get(column, math.nan) for column in columns} for row in rows]

    @property
    def tables(self) -> list[str]:
        """The names of the report's tables."""
        return sorted(path.stem for path in (self.folder / "tables").glob("*.csv"))

    def _unknown(self, name):
        return KeyError(f"no scene {name!r} in {self.folder}; there are: {', '.join(self.scenes) or 'none'}")

    def _repr_html_(self):
        names = self.scenes
        rows = []
        for name in names[:_SHOWN]:
            pictures = self.pictures(name)
            views = sorted(pictures.get("captured", {}))
            shown = {look: pictures.get(look, {}).get(_middle(views)) for look in _LOOKS}
            rows.append(_row(name, shown, 320 if len(names) == 1 else 160) or f"<p>{html.escape(name)}</p>")
        if len(names) > _SHOWN:
            rows.append(f"<p>and {len(names) - _SHOWN} more</p>")
        return f"<p>{html.escape(repr(self))}</p>{''.join(rows)}"

    def __repr__(self):
        return f"Results({str(self.folder)!r}, {len(self.scenes)} scenes)"
