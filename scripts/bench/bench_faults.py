#!/usr/bin/env python3
"""Faults x sizes x states x machines: what catches each, how soon, and how hot the nozzle gets (`make bench-faults`).

The study is config/studies/faults/faults.toml. A whole run writes the table of docs/reference/Fault_Matrix.md. The same
command continues a run that was stopped.
"""

from __future__ import annotations

import harness

import argparse
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

STUDY = harness.ROOT / "config" / "studies" / "faults" / "faults.toml"
PAGE = harness.ROOT / "docs" / "reference" / "Fault_Matrix.md"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"
PEAK_MAX_C = 30.0
STATES = {
    "idle": "idle",
    "warm_idle": "warm idle",
    "climbing": "climbing",
    "holding": "holding",
    "printing": "printing",
}
QUICK_MACHINES = ("reference", "strong")
QUICK_FAULTS = (
    "bridge_stuck_on",
    "bridge_leg_dead",
    "command_stuck:45000",
    "coil_open",
    "sense_open",
    "sense_frozen",
    "sense_frozen_noise",
    "sense_gain:0.5",
    "sense_gain:0.8",
    "gain_ramp:-10",
    "adc_bit:5=0",
    "adc_stop",
    "c1_step:0.3",
    "c1_ramp:100",
    "supply_step:-12",
    "nozzle_missing",
    "nozzle_mass:0.5",
    "thermal_short",
    "link_cut:0.3",
    "uplink_cut:0.3",
    "host_stall:0.3",
    "host_kill",
    "mcu_reset",
    "wrong_calibration:0.8",
    "wrong_power_law:2",
)
FAULT = "simulator.fault"
BY = {  # words of the message that ended a print → short name
    "coil signal does not follow": "MCU: signal does not follow",
    "though the bridge is off": "MCU: bridge conducts",
    "changed faster": "MCU: signal jumps",
    "samples do not arrive": "MCU: no samples",
    "above its limit": "MCU: above its limit",
    "below its limit": "MCU: below its limit",
    "signal st": "MCU: signal stands still",
    "no phase command": "MCU: no command",
    "killed": "MCU: no command",
    "end of the ADC": "MCU: end of range",
    "Lost communication": "host: line",
    "spontaneous restart": "host: MCU restarted",
    "no samples": "host: no samples",
    "no valid": "host: no valid temperature",
    "above max_temp": "host: above max_temp",
    "below min_temp": "host: below min_temp",
    "heating too slow": "host: heating too slow",
    "warms with": "host: warms while off",
    "does not follow": "host: heat without rise",
    "rises by": "host: rise without heat",
    "above its target": "host: above its target",
    "than any command": "host: drive beyond commands",
}


@dataclass(frozen=True, slots=True)
class Cell:
    """One print."""

    fault: str
    state: str
    machine: str
    by: str
    figures: dict[str, float | None]

    @property
    def peak_c(self) -> float:
        return self.figures["peak_above_c"] or 0.0


def name_of(reason: str) -> str:
    """What stopped a print, in a few words; "" if nothing did."""
    return next(
        (short for words, short in BY.items() if words in reason), "" if "as asked" in reason else reason[:60]
    )


def run(options: argparse.Namespace) -> list[Cell]:
    from simulation.sample_gcode import sample_path
    from simulation.study.prepare import prepare
    from simulation.study.results import Journal
    from simulation.study.run import run_study
    from simulation.study.studyfile import read_study

    study = read_study(STUDY)
    if options.quick:
        study = replace(study, parameters=tuple(map(_quick, study.parameters)))
    prepared = prepare(study, sample_path)
    run_study(study, prepared, options.out, str(Path(__file__).name), (None, options.workers), _show)
    journal = Journal(options.out)
    rows = journal.rows
    journal.close()
    return [
        Cell(
            prepared.points[key][FAULT].replace("@8", ""),
            Path(job.gcode).stem,
            prepared.points[key]["machine"],
            name_of(rows[key]["reason"]),
            rows[key]["figures"],
        )
        for key, job in prepared.jobs.items()
        if key in rows
    ]


def _quick(parameter: Any) -> Any:
    chosen = QUICK_MACHINES if parameter.sets else [f"{fault}@8" for fault in QUICK_FAULTS]
    return replace(parameter, arguments={"values": list(chosen)})


def _show(done: int, total: int) -> None:
    if done % 100 == 0 or done == total:
        print(f"{done} of {total} prints", file=sys.stderr)


def table(cells: Sequence[Cell]) -> list[list[str]]:
    """A row a fault: in each state the machine that got hottest, and what caught it."""
    rows = []
    for fault in dict.fromkeys(cell.fault for cell in cells):
        row = [f"`{fault}`"]
        for state in STATES:
            found = [cell for cell in cells if (cell.fault, cell.state) == (fault, state)]
            row.append(_text(max(found, key=lambda cell: cell.peak_c)) if found else "")
        rows.append(
            [*row, ", ".join(dict.fromkeys(cell.by for cell in cells if cell.fault == fault and cell.by))]
        )
    return rows


def _text(cell: Cell) -> str:
    after_ms, power_w = cell.figures["after_ms"], cell.figures["power_w"] or 0.0
    peak = f"**{cell.peak_c:+.0f}**" if cell.peak_c > PEAK_MAX_C else f"{cell.peak_c:+.0f}"
    after = (
        "–" if after_ms is None else f"{after_ms:.0f} ms" if after_ms < 1000 else f"{after_ms / 1000:.1f} s"
    )
    return f"{peak}, {after}" + (f", {power_w:.0f} W left" if cell.by and power_w > 0.5 else "")


def write_page(rows: Sequence[Sequence[str]], cells: Sequence[Cell]) -> None:
    text = PAGE.read_text(encoding="utf-8")
    head = ["fault", *STATES.values(), "stopped by"]
    lines = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    missed = [cell for cell in cells if cell.peak_c > PEAK_MAX_C]
    machines = ", ".join(dict.fromkeys(cell.machine for cell in cells))
    lines += [
        "",
        f"{len(cells)} runs; machines: {machines}. {len(missed)} passed their limit by {PEAK_MAX_C:.0f} °C.",
    ]
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    PAGE.write_text(before + BEGIN + "\n".join(lines) + "\n" + END + after, encoding="utf-8")


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    if options.fresh:
        shutil.rmtree(options.out, ignore_errors=True)
    cells = run(options)
    rows = table(cells)
    print("\n".join(" | ".join(row) for row in rows))
    missed = [cell for cell in cells if cell.peak_c > PEAK_MAX_C]
    for cell in sorted(missed, key=lambda cell: -cell.peak_c):
        stopped = cell.by or "nothing stopped it"
        report.require(
            False, f"{cell.fault} {cell.state} {cell.machine}: {cell.peak_c:+.0f} C above, {stopped}"
        )
    report.figures |= {"cells": len(cells), "over": len(missed), "table": rows}
    if options.write or not options.quick:
        write_page(rows, cells)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(
        __doc__, "two machines, one or two sizes of each fault; the page is left as it is"
    )
    parser.add_argument(
        "--out", type=Path, default=harness.ROOT / "out" / "bench" / "faults", help="of the study"
    )
    parser.add_argument(
        "--workers", type=int, default=None, help="prints at a time (default: one for each core)"
    )
    parser.add_argument("--fresh", action="store_true", help="forget the prints of an earlier run")
    parser.add_argument("--write", action="store_true", help="write the page also with --quick")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
