"""Runs the `use3d` command from Python, and reads its output as NumPy arrays.

    import use3d
    use3d.run("run", "my-reef/")                            # the command, with its own arguments
    results = use3d.Results("use3d-out/my-reef")
    scene = results.scene("my-reef")
    scene.gaussians["x"], scene.medium["coefficients"]      # arrays
    scene.show()                                            # in a notebook: an interactive view of the scene

The module only starts the command and reads files; the command does every computation.
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
