"""What every test may use: the checkout's folders and the sliced sample files."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from hypothesis import settings

from simulation.sample_gcode import SampleMissing, sample_path

ROOT = Path(__file__).resolve().parent.parent
# The same examples on every machine, however busy it is: a run that fails elsewhere fails here.
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")
# Tests that press Ctrl-C: a shell ignores it for what it runs in the background, and programs inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def cubhelix() -> Path:
    """A small real print (140 KB, PrusaSlicer)."""
    return _sample("cubhelix")


@pytest.fixture(scope="session")
def benchy() -> Path:
    """A large real print (5 MB, PrusaSlicer)."""
    return _sample("benchy")


def _sample(name: str) -> Path:
    try:
        return sample_path(name)
    except SampleMissing as e:
        pytest.fail(str(e))
