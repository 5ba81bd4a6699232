"""A heater's tuning as options by name: read it, use another one, keep it for SAVE_CONFIG.

Ordinary heaters and induction nozzles alike; an option given here is checked by the same reader as in printer.cfg.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from configfile import ConfigWrapper, error
from configtext import ConfigData, ConfigParser
from gcode import GCodeCommand
from roles import Printer
from thermal.control import pid, two_period
from thermal.records import ParameterError
from thermal.sensing import heat_balance_monitor

from ..induction import settings as induction_settings
from . import laws as heater_laws
from .ordinary import Heater

INDUCTION_OPTIONS = (
    *(
        "control",
        "pid_kp_w_per_k",
        "pid_ki_w_per_k_s",
        "pid_kd_w_s_per_k",
        "pid_derivative_time",
        "max_delta",
    ),
    *heater_laws.OPTIONS["two_period"],
    *("heat_capacity_j_per_k", "loss_factor", "second_mass_factor", "ambient_temp"),
    *("melt_exchange", "melt_heat", "melt_inlet_temp"),
)
NUMBER = "{:.6g}"


class Tuning(dict[str, str]):
    """Option → text, in the words of printer.cfg."""


class _Overlay:
    """A section with some options replaced; the reading half of ConfigWrapper."""

    error = error

    def __init__(self, base: Any, over: Any, names: set[str]) -> None:
        self._base, self._over, self._names = base, over, names

    def get_name(self) -> str:
        return str(self._over.get_name())

    def where(self, option: str | None = None) -> str:
        return str((self._of(option) if option else self._over).where(option))

    def _of(self, option: str) -> Any:
        return self._over if option.lower() in self._names else self._base

    def get(self, option: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(option).get(option, *args, **kwargs)

    def getlists(self, option: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(option).getlists(option, *args, **kwargs)

    def getfloat(self, option: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(option).getfloat(option, *args, **kwargs)

    def getint(self, option: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(option).getint(option, *args, **kwargs)

    def getchoice(self, option: str, *args: Any, **kwargs: Any) -> Any:
        return self._of(option).getchoice(option, *args, **kwargs)


def heater_of(printer: Printer, gcmd: GCodeCommand, sole_nozzle: bool = False) -> Any:
    """The heater that HEATER= names: an induction nozzle by its section's name, too. Without HEATER the only one there
    is, with `sole_nozzle` the only nozzle. An unknown one is the command's error, with the names there are."""
    nozzles, registry = _nozzles(printer), printer.lookup_object("heaters")
    choices = sorted(nozzles) if sole_nozzle and nozzles else sorted(registry.heaters)
    name = gcmd.get("HEATER", None) or (choices[0] if len(choices) == 1 else None)
    if name is None:
        raise gcmd.error(
            f"Error on '{gcmd.get_commandline()}': missing HEATER (choices: {', '.join(choices)})"
        )
    if name in nozzles:
        return nozzles[name]
    try:
        return registry.lookup_heater(name)
    except error as e:
        raise gcmd.error(str(e)) from None


def _nozzles(printer: Printer) -> dict[str, Any]:
    """Induction heaters by their sections' names."""
    sections = printer.lookup_objects("induction_heater")
    return {section.heater.section_name: section.heater for _, section in sections}


Handler = Callable[[Any], None]


def register_commands(printer: Printer, nozzle: Any, commands: Sequence[tuple[str, Handler, str]]) -> None:
    """Commands (name, handler, help) of an induction nozzle: HEATER= is its section's name or that of the extruder it
    serves; if it is the only one, none is needed."""
    gcode = printer.lookup_object("gcode")
    for command, handler, text in commands:
        gcode.register_mux_command(command, "HEATER", nozzle.section_name, handler, desc=text)

    def on_connect() -> None:
        names = [nozzle.name] if nozzle.name != nozzle.section_name else []
        names += [None] if len(_nozzles(printer)) == 1 else []
        for command, handler, _ in commands:
            for name in names:
                gcode.register_mux_command(command, "HEATER", name, handler)

    printer.register_event_handler("klippy:connect", on_connect)


def is_induction(heater: Any) -> bool:
    return not isinstance(heater, Heater)


def refuse_in_calibration(heater: Any) -> None:
    """A run in the law's place is no tuning to keep, and another law there would leave it waiting for ever."""
    if heater.in_calibration:
        raise heater.printer.command_error(f"Heater '{heater.name}' is being calibrated; ABORT ends that")


def section_of(heater: Any) -> str:
    """The printer.cfg section that holds the heater's tuning."""
    return f"induction_heater {heater.section_name}" if is_induction(heater) else heater.settings.name


def _as_config(printer: Printer, section: str, tuning: dict[str, str]) -> ConfigWrapper:
    data = ConfigData()
    lines = "\n".join(f"{option}: {value}" for option, value in tuning.items())
    ConfigParser(data).parse_text(f"[{section}]\n{lines}\n", "tuning")
    return ConfigWrapper(printer, data, {}, section)


def options_of(heater: Any) -> Tuning:
    """The tuning in use."""
    if not is_induction(heater):
        return Tuning(heater.law.options)
    parameters = heater.parameters
    chosen, loss, base = parameters.control, parameters.heat_balance.loss, heat_balance_monitor.TwoNodeLoss()
    values = {
        "heat_capacity_j_per_k": parameters.heat_balance.heat.at_25c_j_k,
        "loss_factor": loss.link_w_k / base.link_w_k,
        "second_mass_factor": loss.second_j_k / base.second_j_k,
        "ambient_temp": loss.ambient_c,
        "melt_exchange": parameters.melt.ua_w_k,
        "melt_heat": parameters.melt.heat_mj_m3k,
        "melt_inlet_temp": parameters.melt.inlet_c,
    }
    if isinstance(chosen.parameters, pid.PidParameters):
        values["pid_kp_w_per_k"] = chosen.parameters.kp
        values["pid_ki_w_per_k_s"] = chosen.parameters.ki
        values["pid_kd_w_s_per_k"] = chosen.parameters.kd
        values["pid_derivative_time"] = chosen.parameters.derivative_s
    if isinstance(chosen.parameters, pid.WatermarkParameters):
        values["max_delta"] = chosen.parameters.max_delta_c
    if isinstance(chosen.parameters, two_period.TwoPeriodParameters):
        values["two_period_turn"] = chosen.parameters.turn_c
        values["two_period_cutoff"] = chosen.parameters.cutoff_c
    texts = {name: NUMBER.format(value) for name, value in values.items()}
    return Tuning(control=chosen.law.name, **texts)


def read(heater: Any, config: ConfigWrapper, tuning: dict[str, str]) -> Any:
    """What a section's tuning means for this heater. Raises the config's error, or ParameterError."""
    known = INDUCTION_OPTIONS if is_induction(heater) else ("control", *_all_options())
    strange = sorted(set(tuning) - set(known))
    if strange:
        raise config.error(
            f"Option '{strange[0]}' in section '{config.get_name()}': heater '{heater.name}' has no such option"
            f" ({config.where(strange[0])})."
        )
    if is_induction(heater):
        overlay: Any = _Overlay(heater.config, config, set(tuning))
        return induction_settings.read_parameters(overlay, heater.unit.settings)
    return heater_laws.read_law(config, heater.get_max_power(), heater.get_smooth_time())


def check(printer: Printer, heater: Any, tuning: dict[str, str]) -> Any:
    """What the tuning means for this heater. Raises command_error in plain words on one that cannot be."""
    try:
        return read(heater, _as_config(printer, section_of(heater), tuning), tuning)
    except (error, ParameterError) as e:
        raise printer.command_error(f"This tuning cannot be used for heater '{heater.name}': {e}") from None


def _all_options() -> list[str]:
    return [name for names in heater_laws.OPTIONS.values() for name in names]


def use(printer: Printer, heater: Any, tuning: dict[str, str]) -> None:
    """Work with this tuning from now on, target kept, at the present power. Raises command_error."""
    refuse_in_calibration(heater)
    meant = check(printer, heater, tuning)
    if not is_induction(heater):
        if meant.name == "mcu_onoff" != heater.law.name:
            raise printer.command_error(
                f"Heater '{heater.name}' is switched by the host now; its MCU takes over (control: mcu_onoff) only at"
                f" start-up: write it to section [{section_of(heater)}] and restart"
            )
        heater.set_control(meant, keep_target=True)
        return
    heater.use(
        replace(
            heater.parameters,
            control=meant.control,
            loss=meant.loss,
            filter=meant.filter,
            heat_balance=meant.heat_balance,
            melt=meant.melt,
        )
    )


def stage(printer: Printer, heater: Any, tuning: dict[str, str]) -> None:
    """Put the tuning where SAVE_CONFIG finds it."""
    configfile = printer.lookup_object("configfile")
    section = section_of(heater)
    for option, value in tuning.items():
        configfile.set(section, option, value)
