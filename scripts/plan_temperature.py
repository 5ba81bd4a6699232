#!/usr/bin/env python3
"""Plans nozzle temperatures along the path of a G-code file, offline, for any printer.

    scripts/plan_temperature.py part.gcode --config printer.cfg --report plan.html
    scripts/plan_temperature.py part.gcode --config printer.cfg --heater slow --emit part-planned.gcode

The plan is that of the section [temperature_plan] (docs/theory/Temperature_Plan.md); what the config leaves out takes
the section's defaults, and options here go before the config. --emit writes the file again with M104 commands for
firmware that has nothing else. Exit status: 0 done, 2 bad input.
"""

from __future__ import annotations

import in_venv

import argparse
import difflib
import json
import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "klippy"))

import configtext
from configfile import ConfigWrapper
from extras import temperature_plan
from extras.induction import settings as induction_settings
from simulation import plan_emit, plan_offline
from simulation.report import plan as plan_report
from thermal.models.heat_loss import HeatCapacity, LossLaw
from thermal.models.melt_exchange import NozzleLimits
from thermal.plan.materials import MATERIALS, Material

# What heats, if the config has no induction heater: watts that planning may use, J/K, W/K to the air. induction: the
# reference plant (thermal/models/heat_loss.py); slow: a 40 W cartridge in an aluminium block of about 20 g.
HEATERS = {
    "induction": NozzleLimits(),
    "slow": NozzleLimits(
        power_w=32.0,
        capacity=HeatCapacity(20.0, 0.0),
        loss=LossLaw(conductance_w_k=0.075, radiation_m2=5e-4),
        holder_w_k=0.0,  # the block is all there is
    ),
}


class BadInput(Exception):
    """The text is for people."""


def _min_change_c(text: str) -> float:
    """--step: 0.1 to 50 degC."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 50.0:  # false for nan as well
        raise argparse.ArgumentTypeError(f"'{text}' is no change of temperature from 0.1 to 50 degC")
    return value


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("gcode", type=Path, help="sliced file")
    parser.add_argument("--config", type=Path, required=True, help="printer.cfg")
    parser.add_argument(
        "--report", type=Path, metavar="OUT.html", help="one page: path coloured by temperature"
    )
    parser.add_argument("--emit", type=Path, metavar="OUT.gcode", help="the file again with M104 commands")
    parser.add_argument("--json", type=Path, metavar="OUT", help="the figures")
    parser.add_argument(
        "--heater", choices=sorted(HEATERS), help="default: induction if the config has one, else slow"
    )
    parser.add_argument("--material", choices=sorted(MATERIALS), help="instead of the config's")
    parser.add_argument(
        "--set", action="append", default=[], metavar="OPTION=VALUE", help="of [temperature_plan]"
    )
    parser.add_argument(
        "--step", type=_min_change_c, default=2.0, help="--emit: smallest change written, degC (2)"
    )
    return parser.parse_args(argv)


def read_config(options: argparse.Namespace) -> tuple[ConfigWrapper, temperature_plan.Settings, bool]:
    """(the config, the plan's settings, has it an induction heater). Raises ConfigError, BadInput."""
    data, _ = configtext.read_main(str(options.config))
    changes = [("material", options.material)] if options.material else []
    for text in options.set:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise BadInput(f"--set {text}: it has to be OPTION=VALUE")
        changes.append((name, value))
    for name, value in changes:
        data.set("temperature_plan", name, value, configtext.Origin("command line", 0))
    access: dict[tuple[str, str], Any] = {}
    wrapper = ConfigWrapper(None, data, access, "temperature_plan")
    settings = temperature_plan.read_settings(wrapper)
    known = {option for section, option in access if section == "temperature_plan"}
    for name, _ in changes:
        if name.lower() not in known:
            near = difflib.get_close_matches(name.lower(), known, 1)
            hint = f", did you mean {near[0]}?" if near else f"; there are {', '.join(sorted(known))}"
            raise BadInput(f"--set {name}: [temperature_plan] has no such option{hint}")
    return wrapper, settings, any(name.startswith("induction_heater") for name in data.sections)


def limits_of(heater: str, config: ConfigWrapper, settings: temperature_plan.Settings) -> NozzleLimits:
    """The nozzle: the config's own induction heater, or else what heats it within the config's temperatures."""
    section = config.getsection(settings.heater if config.has_section(settings.heater) else "extruder")
    name = f"induction_heater {section.get('heater', '')}"
    if heater == "induction" and config.has_section(name):
        own = config.getsection(name)
        parameters = induction_settings.read_parameters(own, induction_settings.read_unit(own))
        low_c = section.getfloat("min_extrude_temp", own.getfloat("min_extrude_temp", 170.0))
        return temperature_plan.nozzle_limits(settings, parameters, low_c)
    low_c = section.getfloat("min_extrude_temp", 170.0)
    high_c = section.getfloat("max_temp", 300.0) - temperature_plan.HEADROOM_C
    return replace(HEATERS[heater], min_c=0.0, max_c=high_c, min_extrude_c=low_c)


def leave_out_tools(options: argparse.Namespace, line: int) -> None:
    """Say so; G-code with their lines in it cannot be written."""
    if options.emit:
        raise BadInput(
            f"{options.gcode}, line {line}: this tool has a nozzle of its own, and --emit knows one nozzle"
        )
    print("what the other tools deposit is left out")


def print_result(
    found: plan_offline.OfflinePlan, plain: plan_offline.OfflinePlan, material: Material
) -> None:
    """What a user may want to know or to change."""
    print(temperature_plan.report_line(found.summary, material))
    if found.summary.cold_share > 0.01:
        print(
            f"{100 * found.summary.cold_share:.0f} % of the path would need a hotter melt than the material bears"
        )
    if found.summary.hot_share > 0.01:
        print(
            f"{100 * found.summary.hot_share:.0f} % is too hot even for the coolest melt: a lower minimum_speed_factor,"
            " max_layer_pause or more fan would help"
        )
    slowest = min(move.speed_factor for move in found.moves)
    if slowest < 1.0:
        low_c, _, high_c = plain.summary.interface_5_50_95_c[1]
        print(
            f"hot layers are printed at down to {100 * slowest:.0f} % of the file's speed; at its own speed one fixed"
            f" temperature gives {low_c:.0f}..{high_c:.0f} C"
        )


def plan(options: argparse.Namespace) -> dict[str, Any]:
    """Everything asked for; the figures."""
    config, settings, induction = read_config(options)
    heater = options.heater or ("induction" if induction else "slow")
    base_c = 0.5 * (settings.material.low_c + settings.material.high_c)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        total = sum(1 for _ in options.gcode.open("rb"))
        task = progress.add_task("planning", total=total)

        def run(settings: temperature_plan.Settings) -> plan_offline.OfflinePlan:
            nozzle = limits_of(heater, config, settings)
            planning = plan_offline.OfflineRun(
                settings, nozzle, base_c, lambda lines: progress.update(task, completed=lines)
            )
            return planning.run(options.config, options.gcode)

        found, plain, known = plan_offline.plan_whole(settings, run)
    if not found.moves:
        raise BadInput(f"{options.gcode}: no line of it extrudes while it moves")
    if found.other_tool_line >= 0:
        leave_out_tools(options, found.other_tool_line + 1)
    if settings.options.follow_mm > 0.0:
        print(
            f"interface_temp: {known.options.interface_c} is what the material's window lets the whole path come"
            " nearest to; planned with it"
        )
    print_result(found, plain, settings.material)
    if options.report:
        plan_report.write(options.report, options.gcode.name, found, settings.material, plain.summary)
    if options.emit:
        count = plan_emit.write(options.gcode, options.emit, found, options.step)
        print(f"{options.emit}: {count} commands")
    return plan_report.figures(found, settings.material, plain.summary)


def main(argv: Sequence[str] | None = None) -> int:
    options = parse(argv)
    logging.getLogger().addHandler(logging.NullHandler())  # what the host has to say is in its error
    try:
        figures = plan(options)
        if options.json:
            options.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    except (BadInput, configtext.ConfigError, OSError, ValueError) as error:
        print(f"plan_temperature: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
