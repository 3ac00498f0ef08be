"""Reads the output of a run: results folders and scene folders."""

from __future__ import annotations

import csv
import html
import json
import os
import tempfile
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from ._command import run
from ._files import FormatError, read_ply, read_safetensors


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

    def show(self, height: int = 600, **options: Any) -> _Page:
        """An interactive view of the scene for a notebook. `options` are those of `use3d export`, such as
        `cameras="my-reef/"`. An option without a value is `True`; `None` or `False` leaves an option out.
        """
        return _Page(self._page(options), height)

    def _page(self, options):
        words = []
        for name, value in options.items():
            if value is not None and value is not False:
                words += [f"--{name.replace('_', '-')}"] + ([] if value is True else [value])
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "scene.html"
            run("export", self.folder, "--web", page, *words)
            return page.read_text(encoding="utf-8")

    def __repr__(self):
        kind = (self.description.get("medium") or {}).get("kind", "none")
        more = ", enhanced" if self.description.get("enhancement") else ""
        return f"Scene({str(self.folder)!r}, medium {kind}{more})"


class _Page:
    """A page that a notebook shows in its own frame."""

    def __init__(self, page, height):
        self.page, self.height = page, int(height)

    def _repr_html_(self):
        return (
            f'<iframe srcdoc="{html.escape(self.page, quote=True)}" width="100%" height="{self.height}" '
            'style="border:0" sandbox="allow-scripts"></iframe>'
        )


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
        for path in sorted(folder.glob("*/*.png")):
            found.setdefault(path.parent.name, {})[path.stem] = path
        return found

    def table(self, name: str) -> list[dict[str, str]]:
        """A table of the report (`tables/NAME.csv`) as a list of rows, each a dict from column to text."""
        path = self.folder / "tables" / f"{name}.csv"
        if not path.is_file():
            raise KeyError(f"no table {name!r} in {self.folder}; there are: {', '.join(self.tables) or 'none'}")
        with open(path, encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    @property
    def tables(self) -> list[str]:
        """The names of the report's tables."""
        return sorted(path.stem for path in (self.folder / "tables").glob("*.csv"))

    def _unknown(self, name):
        return KeyError(f"no scene {name!r} in {self.folder}; there are: {', '.join(self.scenes) or 'none'}")

    def __repr__(self):
        return f"Results({str(self.folder)!r}, {len(self.scenes)} scenes)"
