"""Makes the wheel of the module alone for pip (PEP 517), with `packaging/wheel.py`."""

import importlib.util
from pathlib import Path


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    path = Path(__file__).resolve().parents[1] / "wheel.py"
    if not path.is_file():
        # An old pip copies this folder without the rest of the source.
        raise FileNotFoundError(f"{path}: not there; update pip to 21.3 or newer (`pip install --upgrade pip`)")
    spec = importlib.util.spec_from_file_location("wheel", path)
    wheel = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(wheel)
    return wheel.wheel(Path(wheel_directory)).name
