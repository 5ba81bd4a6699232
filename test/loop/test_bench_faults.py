"""The fault matrix in small (scripts/bench/bench_faults.py): one fault in every state, and the table made of it."""

from __future__ import annotations

import harness

import argparse
from pathlib import Path

import pytest

import bench_faults


def test_a_broken_coil_is_caught_in_every_state_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_faults, "QUICK_FAULTS", ("coil_open",))
    monkeypatch.setattr(bench_faults, "QUICK_MACHINES", ("strong",))
    options = argparse.Namespace(quick=True, out=tmp_path, workers=2)
    cells = bench_faults.run(options)
    assert sorted(cell.state for cell in cells) == sorted(bench_faults.STATES)
    for cell in cells:
        assert cell.by, cell
        assert cell.peak_c <= 1.0, cell
        assert cell.figures["power_w"] == 0.0, cell
    climbing = next(cell for cell in cells if cell.state == "climbing")
    assert climbing.figures["start_c"] is not None
    assert 60.0 < climbing.figures["start_c"] < 200.0, "the fault comes in the middle of the climb"
    rows = bench_faults.table(cells)
    assert len(rows) == 1
    assert rows[0][0] == "`coil_open`"
    assert all("ms" in text or " s" in text for text in rows[0][1:6])
