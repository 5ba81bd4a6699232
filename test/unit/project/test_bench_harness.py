"""What the benches share (scripts/bench/harness.py): limits, exit status, figures, the cost of a process."""

from __future__ import annotations

import harness

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Bench = Callable[[argparse.Namespace, harness.Report], None]


def status_of(bench: Bench, path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["bench_some", "--json", str(path)])
    return harness.main(bench, harness.options("Some bench."))


@pytest.mark.parametrize(("value", "missed"), [(1.0, 0), (1.001, 1), (math.nan, 1)])
def test_a_figure_above_its_limit_or_without_a_value_is_missed(
    value: float, missed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bench(options: argparse.Namespace, report: harness.Report) -> None:
        report.at_most("rms", value, 1.0)
        report.at_least("speed", -value, -1.0)
        report.figures["rms"] = 0.5

    assert status_of(bench, tmp_path / "new" / "f.json", monkeypatch) == missed
    figures = json.loads((tmp_path / "new" / "f.json").read_text())
    assert figures["rms"] == 0.5 and len(figures["missed"]) == 2 * missed


def test_a_process_that_fails_ends_the_bench_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def bench(options: argparse.Namespace, report: harness.Report) -> None:
        harness.run(sys.executable, "-c", "raise SystemExit('out of paper')")

    assert status_of(bench, tmp_path / "f.json", monkeypatch) == 2
    assert "out of paper" in capsys.readouterr().err and not (tmp_path / "f.json").exists()


def test_the_cost_of_a_process_is_its_own() -> None:
    idle = harness.run(sys.executable, "-c", "import time; time.sleep(0.5); print('rested')")
    busy = harness.run(sys.executable, "-c", "data = b'1' * 500_000_000; sum(range(10_000_000))")
    assert idle.output == "rested\n" and busy.output == ""
    assert idle.wall_s > 0.5 and busy.cpu_s > 2.0 * idle.cpu_s
    assert busy.peak_mb > 500.0
