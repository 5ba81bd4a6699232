"""Fifty recorded runs of different machines, laws and faults, decided again: what moved is shown, or nothing did.

The figures are compared to six digits, since compilers and libm may differ in the last bits. After a change that is
meant to move them:  scripts/replay.py test/data/runs/*.run --json test/data/runs/figures.json
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from simulation import replay
from thermal.recording import stored

RUNS = Path(__file__).resolve().parents[2] / "data" / "runs"
FILES = sorted(RUNS.glob("*.run"))
FIGURES = json.loads((RUNS / "figures.json").read_text(encoding="utf-8"))
# What the loop decides; how far that is from the recorded answers is for people.
DECIDED = ("answers", "commands", "energy_j", "highest_c", "last_c", "fault", "guard")


def found_in(path: Path) -> dict[str, object]:
    run, guard = replay.replayed(path)
    return {**run.figures(), "fault": run.fault[1], "guard": guard.trip}


def same(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9) or (math.isnan(a) and math.isnan(b))
    return a == b


@pytest.mark.parametrize("part", range(5))
def test_the_loop_decides_recorded_runs_as_committed(part: int) -> None:
    moved = []
    for path in FILES[part::5]:
        found, before = found_in(path), FIGURES[path.stem]
        expected = {**before, "fault": before["fault"][1]}
        for name in DECIDED:
            if not same(found[name], expected[name]):
                moved.append(f"{path.stem:28} {name:10} {expected[name]!s:>24} -> {found[name]!s}")
    assert not moved, "recorded runs are decided otherwise:\n" + "\n".join(moved)


def test_each_run_has_figures_and_each_fault_is_among_them() -> None:
    assert {path.stem for path in FILES} == set(FIGURES) and len(FILES) >= 50
    faults = [figures["fault"][1] for figures in FIGURES.values() if figures["fault"][1]]
    assert len(faults) >= 5


def test_a_changed_decision_shows_as_a_line(tmp_path: Path) -> None:
    """The comparison itself: the same run with a weaker drive law in its header."""
    path = RUNS / "reference-model.run"
    frames = list(stored.read(path))
    header = frames[0].json()
    header["parameters"]["control"]["parameters"]["loss_w_k"] *= 1.1
    changed = tmp_path / "changed.run"
    with changed.open("wb") as stream:
        writer = stored.Writer(stream)
        writer.write(stored.json_frame("H", header))
        for frame in frames[1:]:
            if frame.kind not in "PU":
                writer.write(stored.packed(frame.kind, frame.payload))
        writer.close()
    assert not same(found_in(changed)["energy_j"], FIGURES[path.stem]["energy_j"])
