#!/usr/bin/env python3
"""Record the runs of test/data/runs: fifty short ones of different simulated machines, laws and faults.

    scripts/bench/record_runs.py [--out DIR] [NAME ...]

Run it when the format changes or a machine is added, not when figures move: the recorded inputs stay what they were.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "test" / "data" / "runs"
PLANT = "simulator nozzle nozzle."
HEATER = "induction_heater nozzle."

HEAT = "M104 S{target}\nG4 P1900\nM400\nM104 S0\nG4 P200\nM400\n"
FLOW = "M109 S{target}\nM83\nG1 E{feed} F{feed}00\nG4 P300\nM400\n"  # for 0.6 s
FAN = "M106 S255\nM104 S{target}\nG4 P2200\nM400\n"

Case = tuple[str, str, Mapping[str, object]]  # name, G-code, options


def cases() -> Iterator[Case]:
    """Every recorded run."""
    for preset in ("reference", "strong"):
        for law in ("model", "pid", "watermark", "two_period"):
            yield (
                f"{preset}-{law}",
                HEAT.format(target=220),
                {f"{PLANT}preset": preset, f"{HEATER}control": law},
            )
        for name, factor in (
            ("mass", 0.75),
            ("mass", 1.3),
            ("efficiency", 0.7),
            ("efficiency", 1.3),
            ("loss", 1.5),
        ):
            options = {f"{PLANT}preset": preset, f"{PLANT}{name}_factor": factor}
            yield f"{preset}-{name}-{factor}", HEAT.format(target=250), options
        for feed in (1, 3, 6):
            yield f"{preset}-flow-{feed}", FLOW.format(target=230, feed=feed), {f"{PLANT}preset": preset}
        yield f"{preset}-fan", FAN.format(target=200), {f"{PLANT}preset": preset}
    for name, values in {
        "supply_v": (22.8, 23.5, 24.5, 25.2),
        "c1_factor": (0.98, 0.9995, 1.0005, 1.005, 1.02),
        "noise_lsb": (0.1, 0.5, 3.0),
        "ripple_v": (0.5, 2.0),
        "frequency_ppm": (-50.0, 50.0),
        "skew_ns": (-5.0, 5.0),
        "ambient_c": (5.0, 45.0),
    }.items():
        for value in values:
            yield f"{name}-{value}", HEAT.format(target=250), {f"{PLANT}{name}": value}
    for drift_ppm_s in (-30.0, 30.0):
        drift = {f"{PLANT}c1_factor": f"0:1, 100:{1.0 + 1e-4 * drift_ppm_s}"}
        yield f"c1_drift_ppm_s-{drift_ppm_s}", HEAT.format(target=250), drift
    for fault, text in enumerate(("no-nozzle", "coil-broken", "stuck-on", "stuck-signal", "lost-signal"), 1):
        # The host's own checks: a board that tests its signal is faster.
        options = {f"{PLANT}fault": fault, f"{HEATER}signal_test_interval": 0}
        yield f"fault-{text}", HEAT.format(target=220), options


def record(case: Case, folder: Path) -> None:
    name, gcode, options = case
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, "part.gcode")
        file.write_text(gcode)
        command = [
            sys.executable,
            ROOT / "scripts" / "simulate.py",
            ROOT / "config" / "sim-induction.cfg",
            file,
        ]
        command += ["--quiet", "--log", Path(scratch, "log"), "--until", "4"]
        for option, value in {**options, f"{HEATER}record_file": f"{name}.run"}.items():
            command += ["--set", f"{option}={value}"]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
        made = Path(scratch, f"{name}.run")
        if not made.exists():
            raise SystemExit(f"{name}: {done.stdout}{done.stderr}")
        (folder / made.name).write_bytes(made.read_bytes())
        print(f"{name}: {made.stat().st_size // 1024} kB, {done.stdout.strip() or done.stderr.strip()}")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Record the runs of test/data/runs.")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("names", nargs="*", metavar="NAME")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    for case in cases():
        if not options.names or case[0] in options.names:
            record(case, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
