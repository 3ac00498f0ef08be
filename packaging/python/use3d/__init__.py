"""Runs the `use3d` command from Python, and reads its output as NumPy arrays.

    import use3d
    use3d.run("run", "my-reef/")                            # the command, with its own arguments
    results = use3d.Results("use3d-out/my-reef")            # a notebook shows its pictures
    results.table()                                         # all scores, for pandas.DataFrame
    scene = results.scene("my-reef")
    scene.gaussians["x"], scene.medium["coefficients"]      # arrays
    scene.render(), scene.depth()                           # arrays: the scene from one of its cameras
    scene.show()                                            # in a notebook: a picture, and a link to walk through

The module only starts the command and reads files; the command does every computation. Arrays and pictures need
NumPy, the rest needs nothing.
"""

from ._command import CommandFailed, command, run
from ._command import version as _version
from ._files import FormatError, read_ply, read_safetensors
from ._pictures import read_exr
from ._results import Results, Scene

__version__ = _version()

__all__ = [
    "__version__",
    "CommandFailed",
    "FormatError",
    "Results",
    "Scene",
    "command",
    "read_exr",
    "read_ply",
    "read_safetensors",
    "run",
]
