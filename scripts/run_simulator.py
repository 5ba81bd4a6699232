#!/usr/bin/env python3
"""Runs the simulated printer in real time behind a pseudo terminal per MCU, for any Klipper-protocol host.

    scripts/run_simulator.py config/sim-induction.cfg --pty /tmp/ferrite_mcu
    .venv/bin/python klippy/klippy.py config/sim-induction.cfg    (in another terminal; `serial:` is that path)

Without --pty the paths are those of the config's own `serial` options.
"""

from __future__ import annotations

import in_venv

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

from simulation import world  # noqa: E402
from simulation.realtime import RealTimePrinter  # noqa: E402


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Run the simulated printer in real time behind pseudo terminals."
    )
    parser.add_argument("config", type=Path, help="printer.cfg with simulator sections")
    parser.add_argument(
        "--pty",
        action="append",
        default=[],
        metavar="[MCU=]PATH",
        help="where to put the pseudo terminal of an MCU (default: the main one); may be repeated",
    )
    parser.add_argument("--trace", type=Path, metavar="FILE.csv", help="as in simulate.py")
    parser.add_argument("--seed", type=int, default=1, help="fixes noise and line damage (default 1)")
    parser.add_argument("--until", type=float, metavar="SECONDS", help="end by itself after so many seconds")
    return parser.parse_args(argv)


def terminals(options: Sequence[str]) -> dict[str, Path]:
    """'PATH' and 'MCU=PATH' → path by MCU."""
    result = {}
    for text in options:
        name, equals, path = text.partition("=")
        result[name if equals else "mcu"] = Path(path if equals else text)
    return result


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    logging.basicConfig(level=logging.WARNING, format="run_simulator: %(message)s")
    try:
        world.build()
        printer = RealTimePrinter(options.config, terminals(options.pty), options.seed, options.trace)
    except (world.WorldError, OSError) as e:
        print(f"run_simulator: {e}", file=sys.stderr)
        return 2
    try:
        print("simulated printer at " + ", ".join(map(str, printer.paths)) + "; Ctrl-C ends it", flush=True)
        printer.run(options.until)
    except KeyboardInterrupt:
        pass
    finally:
        printer.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
