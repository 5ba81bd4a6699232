"""The plan takes no time from the look-ahead: each move is sent as early, and made at the same time, as without it.

An enabled plan keeps more motion ahead, so that moves are sent earlier."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from plan_rig import Watched, watch
from simulation.sample_gcode import sample_path
from system.conftest import machine

# The plan may slow down hot layers; with minimum_speed_factor 1 every move has the file's own speed.
SECTION = "[temperature_plan]\nmaterial: ABS\nbed_temp: 100\nchamber_temp: 40\nminimum_speed_factor: 1\n"
START = "M104 S240\nG28\nG90\nM83\nG1 X20 Y20 Z0.3 F6000\nM109 S240\n"
FEATURES = ("External perimeter", "Internal infill", "Bridge infill")


def short_chords() -> str:
    """0.5 mm at 100 mm/s, 200 moves a second, another feature every 40 moves and another layer every 400."""
    lines = []
    for i in range(2400):
        row, along = divmod(i, 200)
        if i % 400 == 0:
            lines.append(f";LAYER_CHANGE\nG1 Z{0.3 + i / 2000:.2f} F600")
        if i % 40 == 0:
            lines.append(f";TYPE:{FEATURES[i // 40 % 3]}")
        x = 20.0 + 0.5 * (along if row % 2 == 0 else 200 - along)
        lines.append(f"G1 X{x:.2f} Y{20 + 0.4 * row + 0.02 * (i % 2):.2f} E0.018 F6000")
    return "\n".join(lines)


def sliced() -> str:
    """The first 3000 lines of a real file, with targets of our own."""
    lines = sample_path("benchy").read_text(errors="replace").splitlines()[:3000]
    body = "\n".join(line for line in lines if not re.match(r"(M1[0-9]{2}|G28|G29|T)\b", line))
    return f"{body}\nM107"


def printed(tmp_path: Path, body: str, section: str) -> Watched:
    config, gcode = machine(tmp_path, section), tmp_path / "part.gcode"
    gcode.write_text(f"{START}{body}\nM400\nG4 P1000\n")
    watched = watch(config, gcode, until_s=60.0)
    assert watched.outcome is not None and watched.outcome.status == 0, watched.outcome
    return watched


def deposited(watched: Watched) -> np.ndarray:
    """(phases of moves, 3): start and end after the first road begins, flow. Before it the printer waits for heat,
    until the host looks, which is some ms sooner or later."""
    first = next(i for i, road in enumerate(watched.roads) if road.flow_mm3_s > 0.0)
    zero_s = watched.roads[first].start_s
    return np.array([(r.start_s - zero_s, r.end_s - zero_s, r.flow_mm3_s) for r in watched.roads[first:]])


@pytest.mark.parametrize("body", [short_chords, sliced])
def test_every_move_comes_as_early_and_is_deposited_at_the_same_time(tmp_path: Path, body) -> None:  # type: ignore[no-untyped-def]
    """In virtual time, where no calculation takes any: a difference would be a wait."""
    text = body()
    without, planned = printed(tmp_path, text, ""), printed(tmp_path, text, SECTION)
    assert len(planned.emitted) > 20  # it has planned
    known = len(deposited(without))  # where the run ends; with a plan more is
    assert known > 1000
    assert deposited(planned)[:known] == pytest.approx(deposited(without), abs=1e-6)
    assert planned.stalls == without.stalls == 0
    starts, ends = deposited(planned)[1:-2, 0], deposited(planned)[:-3, 1]
    assert np.abs(starts - ends).max() < 1e-6  # never dry: each begins where the one before it ends
    # how far ahead of the machine each batch was given out; the host looks at other moments, some ms apart
    batches = len(without.ahead_s)
    assert np.min(np.subtract(planned.ahead_s[5:batches], without.ahead_s[5:])) > -0.02
    assert min(planned.ahead_s[5:]) > min(without.ahead_s[5:]) - 0.02
