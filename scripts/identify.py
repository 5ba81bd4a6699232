#!/usr/bin/env python3
"""From a recorded run to the plant that simulates this nozzle: a section [simulator nozzle NAME].

    scripts/identify.py RUN.run [--given NAME=VALUE] [--out FILE.cfg] [--plot FILE.png]

The run has to begin with a cold nozzle and to heat it up, and should print at several flows
(docs/guides/Nozzle_Identification.md).

Exit status: 0 written, 2 the file is no recorded run, or one that does not determine a plant.
"""

from __future__ import annotations

import in_venv

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from simulation import world
from simulation.identify import fit, recording, report
from thermal.recording.plain import UnknownType
from thermal.recording.stored import RunFileError


def parse_arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Find the plant that would have given a recorded run.",
        epilog="Exit status: 0 written, 2 the file is no recorded run, or one that does not determine a plant.",
    )
    parser.add_argument("run", type=Path, metavar="RUN.run")
    parser.add_argument(
        "--given",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of the plant that is known, such as ambient_c=22; may be repeated",
    )
    parser.add_argument("--out", type=Path, metavar="FILE.cfg", help="the section; without it to stdout")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="recorded against simulated")
    return parser.parse_args(argv)


def given_values(texts: list[str]) -> dict[str, float]:
    """Raises RunError."""
    table, values = world.parameter_tables()["nozzle"], {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            row, values[name] = table[name], float(value)
        except (KeyError, ValueError):
            raise recording.RunError(
                f"--given {text}: NAME=VALUE is needed, NAME a parameter of klippy/simulation/plant/plant_params.h"
            ) from None
        if not row.min <= values[name] <= row.max:
            raise recording.RunError(
                f"--given {text}: {name} has to lie in {row.min:g} to {row.max:g} {row.unit}"
            )
    return values


def main(argv: list[str] | None = None) -> int:
    options = parse_arguments(argv)
    try:
        world.build()
        given = given_values(options.given)
        run = recording.read(options.run)
        found = fit.fit(run, given)
        text = report.section(run, found, options.run.name)
        if options.plot is not None:
            report.draw(run, found, options.plot)
        if options.out is not None:
            options.out.write_text(text, encoding="utf-8")
    except (recording.RunError, RunFileError, UnknownType, world.WorldError, OSError) as e:
        print(f"identify: {options.run}: {e}", file=sys.stderr)
        return 2
    if options.out is None:
        print(text, end="")
    print(report.summary(run, found), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
