"""Where the sliced sample files are.

They come with the PyPI package pyGCodeDecode (MIT licence), of which only the data files are used; it is
found without being imported, since its own dependencies are not installed.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

PACKAGE = "pyGCodeDecode"


class SampleMissing(Exception):
    """A sample file is not there; the text says how to get it."""


def sample_path(name: str) -> Path:
    """Path of the sample `name` ("cubhelix": 140 KB, 6 min of printing; "benchy": 5 MB, 105 min)."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise SampleMissing(f"the Python package {PACKAGE} is not installed: run scripts/setup.sh")
    folder = Path(next(iter(spec.submodule_search_locations))) / "examples" / "data"
    path = folder / f"{name}.gcode"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.gcode")))
        raise SampleMissing(f"{PACKAGE} has no sample '{name}'; it has: {known}")
    return path
