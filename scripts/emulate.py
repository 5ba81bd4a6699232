#!/usr/bin/env python3
"""Runs the image for a chip in real time behind a pseudo terminal, with a simulated machine around it.

    scripts/emulate.py stm32f334
    .venv/bin/python klippy/klippy.py config/sim-f334.cfg    (in another terminal; `serial:` is the pseudo terminal)

The machine is that of the config's simulator sections; without --config that of the chip's own example in config/. The
run ends with Ctrl-C, or when the chip's model objects to something the firmware does.
"""

from __future__ import annotations

import in_venv

import argparse
import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

from simulation import world  # noqa: E402
from simulation.builds import BUILDS, WorldError, use_image  # noqa: E402
from simulation.emulator import Emulator  # noqa: E402
from simulation.realtime import RealTimePrinter  # noqa: E402

CONFIGS = {
    "stm32f334": ROOT / "config" / "sim-f334.cfg",
    "atmega2560": ROOT / "config" / "sim-mega.cfg",
}


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Run the image for a chip in real time behind a pseudo terminal."
    )
    chips = [build.name for build in BUILDS.values() if build.emulated]
    parser.add_argument("chip", choices=chips, help="whose image to run")
    parser.add_argument(
        "--pty",
        type=Path,
        metavar="PATH",
        help="where to put the pseudo terminal (default: the config's serial)",
    )
    parser.add_argument(
        "--config",
        type=Path,
        help="printer.cfg with simulator sections (default: the chip's, config/sim-*.cfg)",
    )
    parser.add_argument(
        "--image",
        type=Path,
        metavar="FOLDER",
        help="where another image is than the usual one (ferrite.elf and ferrite.dict, of a make with OUT=)",
    )
    parser.add_argument("--mcu", default="mcu", help="which MCU of the config it is (default mcu)")
    parser.add_argument("--trace", type=Path, metavar="FILE.csv", help="as in simulate.py")
    parser.add_argument("--until", type=float, metavar="SECONDS", help="end by itself after so many seconds")
    return parser.parse_args(argv)


def what_it_did(counters: Mapping[str, Any], clock_hz: float) -> str:
    """What the chip did, in one line; its ticks are of `clock_hz`."""
    ticks = counters["ticks"] or 1
    return (
        f"{ticks / clock_hz:.1f} s, {counters['instructions'] / 1e6:.1f} million instructions, "
        f"{100.0 * (1.0 - counters['idle_ticks'] / ticks):.1f} % of the time awake, "
        f"{counters['interrupts']} interrupts, {counters['resets']} resets"
    )


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    logging.basicConfig(level=logging.WARNING, format="emulate: %(message)s")
    terminals = {} if options.pty is None else {options.mcu: options.pty}
    try:
        world.build()
        if options.image is not None:
            use_image(options.chip, options.image)
        printer = RealTimePrinter(
            options.config or CONFIGS[options.chip],
            terminals,
            trace=options.trace,
            builds={options.mcu: options.chip},
        )
    except (WorldError, OSError) as e:
        print(f"emulate: {e}", file=sys.stderr)
        return 2
    print("emulate: " + ", ".join(str(path) for path in printer.paths), flush=True)
    status = 0
    try:
        printer.run(options.until)
    except KeyboardInterrupt:
        pass
    except WorldError as e:
        print(f"emulate: the chip objects: {e}", file=sys.stderr)
        status = 1
    counters = Emulator(printer.world, printer.machine.mcus[options.mcu]).counters()
    print("emulate: " + what_it_did(counters, BUILDS[options.chip].clock_hz))
    printer.close()
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
