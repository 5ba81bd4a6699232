#!/usr/bin/env python3
"""How often does scripts/why.py name the right cause? Causes are injected into simulated prints, one log each.

    bench_why.py [--logs 20] [--page docs/reference/Why_Matrix.md]

Half of the logs are of machines, files and seeds that the rules were not written on (OTHERS). What the computer reports
(swapping, clock, supply) is put in where the host reads it. Exit status 1 if a limit is missed.
"""

from __future__ import annotations

import harness

import argparse
import collections
import logging
import multiprocessing
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import why
from extras import statistics
from simulate import set_up_log
from simulation.runner import RunOptions, Simulation

RIGHT_MIN, WRONG_MAX = 0.90, 0.02
KNOWN = (harness.SAMPLE_CONFIG,)
OTHERS = (harness.ROOT / "config" / "sim-two-mcu.cfg",)
SWAPPING, SLOW, WEAK = {"swapped": 20_000}, {"clock": 600, "throttled": 1}, {"undervoltage": 1}
Injection = Callable[[Any], None]


@dataclass(frozen=True, slots=True)
class Case:
    """A way to stop a print. `faults`, `hook`: at a random time; `line`: in the file; `computer`: what it reports."""

    name: str
    cause: str
    faults: tuple[str, ...] = ()
    line: str = ""
    config: str = ""
    computer: dict[str, int] = field(default_factory=dict)
    hook: Injection | None = None
    start: str = "G28\n"
    cut: bool = False


def client_stop(printer: Any) -> None:
    printer.lookup_object("webhooks").get_callback("emergency_stop")(None)


def bug(printer: Any) -> None:
    def boom(gcmd: Any) -> None:
        raise ZeroDivisionError("a bug in a plugin")

    printer.lookup_object("gcode").register_command("BOOM", boom)


MACRO = "[gcode_macro TRY]\ngcode:\n    "
DOOR = MACRO + '{action_emergency_stop("door")}\n'
COLD_BED = "[simulator load bed]\nheater_w: 0\n"
OPEN = "[simulator axis x]\nendstop_pin: PF9\n"
CASES = (
    Case("M112 in the file", "M112", line="M112"),
    Case("emergency stop of a client", "Emergency stop of a client", hook=client_stop),
    Case("action_emergency_stop", "Emergency stop of a macro", line="TRY", config=DOOR),
    Case("host stall 1.2 s", "Host too busy", ("host_stall:1.2",)),
    Case("host stall 4 s", "Host too busy", ("host_stall:4",)),
    Case("host stall, swapping", "Swapping", ("host_stall:1.4",), computer=SWAPPING),
    Case("host stall, slow clock", "Slow clock", ("host_stall:1.3",), computer=SLOW),
    Case("host stall, weak supply", "Under-voltage", ("host_stall:1.3",), computer=WEAK),
    Case("line damage 5 %", "Damaged line", ("link_damage:0.05",)),
    Case("line damage 20 %", "Damaged line", ("link_damage:0.2",)),
    Case("line cut", "Lost connection", ("link_cut",)),
    Case("line cut 1.5 s", "Lost connection", ("link_cut:1.5",)),
    Case("uplink cut", "Lost connection", ("uplink_cut",)),
    Case("board reset", "Board reset", ("mcu_reset",)),
    Case("board reset, weak supply", "Brown-out", ("mcu_reset",), computer=WEAK),
    Case("signal frozen", "Signal frozen", ("sense_frozen",)),
    Case("sensing lead shorted", "No coil signal", ("sense_short",)),
    Case("coil open", "No coil signal", ("coil_open",)),
    Case("sensing lead open", "No coil signal", ("sense_open",)),
    Case("supply off", "No coil signal", ("supply_step:-24",)),
    Case("bridge dead", "No coil signal", ("bridge_stuck_off",)),
    Case("nozzle missing", "No nozzle in the coil", ("nozzle_missing",)),
    Case("samples stop", "Samples stopped", ("adc_stop",)),
    Case("bridge on with the heater off", "Bridge stuck on", ("bridge_stuck_on:9000",), start="G28\nM104 S0\nM107\n"),
    Case("bed sensor", "Sensor open or shorted", config="[heater_bed]\nmin_temp: 40\n"),
    Case("bed without power", "Heater too weak", start="M140 S90\nM190 S90\nG28\n", config=COLD_BED),
    Case("endstop open", "Endstop not reached", config=OPEN),
    Case("endstop shorted", "Endstop stuck", config="[stepper_x]\nendstop_pin: !PA4\n" + OPEN),
    Case("unknown option", "Config", config="[printer]\nmax_velocitty: 3\n"),
    Case("option out of range", "Config", config="[printer]\nmax_accel: -3\n"),
    Case("missing include", "Config file", config="[include none.cfg]\n"),
    Case("dead line at the start", "No connection", config="[simulator mcu]\ndrop: 0.5\n"),
    Case("parameter out of range", "Wrong command", line="M204 S0"),
    Case("target out of range", "Wrong command", line="M104 S999"),
    Case("cold extrusion", "Wrong command", line="M104 S0\nG4 P60000\nG1 E5"),
    Case("not homed", "Wrong command", start=""),
    Case("division by zero in a macro", "Macro", line="TRY", config=MACRO + "{1 / 0}\n"),
    Case("macro without an end", "Macro", line="TRY", config=MACRO + "{2**(2**30)}\n"),
    Case("bug of a plugin", "Internal error", line="BOOM", hook=bug),
    Case("killed in the middle", "Host ended", cut=True),
    Case("no stop at all", why.UNKNOWN),
)  # fmt: skip


def part(dice: random.Random, line: str) -> str:
    """Squares or a zigzag, with `line` somewhere."""
    size, feed = dice.uniform(10.0, 40.0), dice.choice((1800, 3000, 4800))
    corners = ((60, 60), (60 + size, 60), (60 + size, 60 + size), (60, 60 + size))
    count = int(45.0 * feed / 60.0 / size)
    moves = [f"G1 X{x:.2f} Y{y:.2f} E{0.03 * size:.4f} F{feed}" for x, y in (corners * count)[:count]]
    moves.insert(dice.randrange(len(moves) // 3, len(moves)), line)
    return "M83\nG1 Z0.3 F600\n" + "\n".join(moves) + "\nM400\nG4 P3000\n"


class Injected(Simulation):
    """A print to which something happens."""

    hook: Injection | None = None
    at_s = 0.0

    def _new_printer(self) -> Any:
        printer = super()._new_printer()
        if self.hook is not None:
            hook = self.hook
            self.reactor.register_callback(
                lambda eventtime: hook(printer), self.reactor.monotonic() + self.at_s
            )
        return printer


def run(case: Case, seed: int, folder: Path) -> str:
    """The cause that why.py names for one log."""
    dice = random.Random(f"{case.name} {seed}")
    base = dice.choice(OTHERS if seed % 2 else KNOWN)
    config, gcode, log = folder / "printer.cfg", folder / "part.gcode", folder / "klippy.log"
    config.write_text(f"[include {base}]\n[respond]\n{case.config}")
    heat = "M104 S210\n" if case.start.startswith("G28") else ""
    gcode.write_text(
        f"{heat}{case.start}{'' if 'S0' in case.start or not heat else 'M109 S210'}\n" + part(dice, case.line)
    )
    if "M104 S0" in case.start:
        gcode.write_text("M104 S210\nG28\nM109 S210\nM104 S0\nG4 P60000\n")
    at_s = dice.uniform(25.0, 45.0)
    _report(case.computer, at_s)
    logging.getLogger().handlers.clear()  # those of whoever started this process
    set_up_log(log)
    logging.info("Starting Ferrite")
    simulation = Injected(
        RunOptions(
            config,
            gcode,
            seed,
            until_s=400.0,
            log=log,
            faults=tuple(f"{name}@{at_s:.3f}" for name in case.faults),
        )
    )
    simulation.hook, simulation.at_s = case.hook, 1.0 if case.hook is bug else at_s
    simulation.run()
    logging.shutdown()
    lines = log.read_text(encoding="utf-8").splitlines()
    if case.cut:
        start = next(n for n, line in enumerate(lines) if line.startswith("Starting SD card print"))
        end = next(n for n, line in enumerate(lines) if line.startswith("Exiting SD card print"))
        lines = lines[: dice.randrange(start + 3, end)]
    return why.cause_of(why.read(lines))[0]


def _report(changes: dict[str, int], at_s: float) -> None:
    """What the host reads of its computer: a quiet one, changed from a time on."""
    looks = 0

    def read_computer() -> dict[str, Any]:
        nonlocal looks
        looks += 1
        facts: dict[str, Any] = {
            "sysload": 0.5,
            "cputime": 1.0,
            "memavail": 900_000,
            "swapped": 100,
            "clock": 1500,
        }
        facts |= {"undervoltage": 0, "throttled": 0}
        now = {name: value * looks if name == "swapped" else value for name, value in changes.items()}
        return facts | (now if looks > at_s - 8.0 else {})

    statistics.read_computer, statistics.READ_S = read_computer, 0.0  # a simulated second is shorter


def one(job: tuple[int, int]) -> tuple[int, str]:
    number, seed = job
    with tempfile.TemporaryDirectory() as folder:
        try:
            return number, run(CASES[number], seed, Path(folder))
        except Exception as e:
            return number, f"bench: {type(e).__name__}: {e}"


def matrix(logs: int, workers: int) -> dict[str, collections.Counter[str]]:
    """For each case, how often which cause was named."""
    found = {case.name: collections.Counter[str]() for case in CASES}
    jobs = [(number, seed) for number in range(len(CASES)) for seed in range(logs)]
    context = multiprocessing.get_context("fork")
    with context.Pool(workers, maxtasksperchild=1) as pool:  # a simulation is one process's
        for number, key in pool.imap_unordered(one, jobs):
            found[CASES[number].name][key] += 1
    return found


def shares(found: dict[str, collections.Counter[str]]) -> tuple[float, float]:
    """(named right, named wrong) of all logs; the rest is unknown."""
    total = sum(counts.total() for counts in found.values())
    right = sum(found[case.name][case.cause] for case in CASES)
    unknown = sum(found[case.name][why.UNKNOWN] for case in CASES if case.cause != why.UNKNOWN)
    return right / total, (total - right - unknown) / total


def page(found: dict[str, collections.Counter[str]], seconds: float) -> str:
    right, wrong = shares(found)
    total = sum(counts.total() for counts in found.values())
    lines = [
        "# How often the named cause is right",
        "",
        "Written by `scripts/bench/bench_why.py`, not by hand. Each row is a cause injected into simulated prints.",
        "Half of the logs are of the machine and the seeds on which the rules were written, half of others.",
        "None is of a real machine. [Trouble](../guides/Trouble.md) explains the causes.",
        "",
        f"Of {total} logs {100 * right:.1f} % are named right, {100 * wrong:.1f} % wrong, the rest unknown"
        f" (at least {100 * RIGHT_MIN:.0f} %, at most {100 * WRONG_MAX:.0f} %).",
        "",
        "| injected | cause | named right | named otherwise |",
        "|---|---|---|---|",
    ]
    for case in CASES:
        counts = found[case.name]
        others = ", ".join(f"{key} {count}" for key, count in sorted(counts.items()) if key != case.cause)
        lines.append(f"| {case.name} | {case.cause} | {counts[case.cause]} of {counts.total()} | {others} |")
    print(f"{seconds:.0f} s", file=sys.stderr)
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=int, default=20, help="of each cause (default %(default)d)")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--page", type=Path, help="write the table to this file")
    options = parser.parse_args(argv)
    begin = time.monotonic()
    found = matrix(options.logs, options.workers)
    text = page(found, time.monotonic() - begin)
    print(text, end="")
    if options.page is not None:
        options.page.write_text(text, encoding="utf-8")
    right, wrong = shares(found)
    return int(right < RIGHT_MIN or wrong > WRONG_MAX)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
