"""What a run has left: results folders and scene folders."""

import html
import json
import os
import tempfile
from pathlib import Path

from ._command import run
from ._files import FormatError, read_ply, read_safetensors


def _json(path):
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)
    except ValueError as error:
        raise FormatError(f"{path}: not JSON: {error}") from error


class Scene:
    """A scene folder: `description`, and as arrays its `gaussians`, `medium` and `enhancement`, read when first asked for."""

    def __init__(self, folder):
        self.folder = Path(folder)
        path = self.folder / "scene.json"
        if not path.is_file():
            raise FormatError(f"{self.folder}: no scene folder, there is no scene.json in it")
        self.description = _json(path)
        if self.description.get("format") != "3d-use scene":
            raise FormatError(f"{path}: format {self.description.get('format')!r}; '3d-use scene' is expected")
        self._read = {}

    def _once(self, name, read):
        if name not in self._read:
            self._read[name] = read()
        return self._read[name]

    @property
    def gaussians(self):
        """The Gaussians, a structured array: x, y, z, f_dc_0 …, opacity, scale_0 …, rot_0 … as 3DGS files have them."""
        return self._once("gaussians", lambda: read_ply(self.folder / "gaussians.ply"))

    def _tensors(self, part):
        named = self.description.get(part) or {}
        file = named.get("file")
        return self._once(part, lambda: read_safetensors(self.folder / file)) if file else {}

    @property
    def medium(self):
        """The water's tensors by name; none where there is no water."""
        return self._tensors("medium")

    @property
    def enhancement(self):
        """The enhancement's tensors by name; none in a scene of stage 1."""
        return self._tensors("enhancement")

    def show(self, height=600, **options):
        """The scene to walk through, in a notebook. `options` are those of `use3d export`, such as `cameras="my-reef/"`."""
        return _Page(self._page(options), height)

    def _page(self, options):
        words = [word for name, value in options.items() for word in (f"--{name.replace('_', '-')}", os.fspath(value))]
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "scene.html"
            run("export", self.folder, "--web", page, *words)
            return page.read_text(encoding="utf-8")

    def __repr__(self):
        kind = (self.description.get("medium") or {}).get("kind", "none")
        more = ", enhanced" if self.description.get("enhancement") else ""
        return f"Scene({str(self.folder)!r}, medium {kind}{more})"


class _Page:
    """A page that a notebook shows in a frame of its own."""

    def __init__(self, page, height):
        self.page, self.height = page, int(height)

    def _repr_html_(self):
        return (
            f'<iframe srcdoc="{html.escape(self.page, quote=True)}" width="100%" height="{self.height}" '
            'style="border:0" sandbox="allow-scripts"></iframe>'
        )


class Results:
    """A folder that `use3d run` has filled."""

    def __init__(self, folder):
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{self.folder}: there is no such folder of results")

    @property
    def scenes(self):
        """The names of its scenes, with variants as `scene/variant`."""
        found = {p.parent.parent for name in ("scene", "enhanced-scene") for p in self.folder.glob(f"**/{name}/scene.json")}
        return sorted(str(path.relative_to(self.folder)) for path in found)

    def scene(self, name):
        """The scene of that name, enhanced where it was."""
        for part in ("enhanced-scene", "scene"):
            if (self.folder / name / part / "scene.json").is_file():
                return Scene(self.folder / name / part)
        raise KeyError(f"no scene {name!r} in {self.folder}; there are: {', '.join(self.scenes) or 'none'}")

    def scores(self, name):
        """`scores.json` of a scene."""
        return _json(self.folder / name / "scores" / "scores.json")

    def __repr__(self):
        return f"Results({str(self.folder)!r}, {len(self.scenes)} scenes)"
