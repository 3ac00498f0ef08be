"""The `use3d` command from Python, and what it writes as NumPy arrays.

    import use3d
    use3d.run("run", "my-reef/")                            # the command, with its own words
    results = use3d.Results("use3d-out/my-reef")
    scene = results.scene("my-reef")
    scene.gaussians["x"], scene.medium["coefficients"]      # arrays
    scene.show()                                            # in a notebook: the scene to walk through

Only reading and starting: every computation is the command's.
"""

from ._command import CommandFailed, command, run
from ._command import version as _version
from ._files import FormatError, read_ply, read_safetensors
from ._results import Results, Scene

__version__ = _version()

__all__ = [
    "__version__",
    "CommandFailed",
    "FormatError",
    "Results",
    "Scene",
    "command",
    "read_ply",
    "read_safetensors",
    "run",
]
