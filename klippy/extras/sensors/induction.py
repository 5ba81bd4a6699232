"""Sensor types of an induction nozzle's own figures, so that any front end charts them.

    [temperature_sensor melt]
    sensor_type: induction_melt     # or another of FIGURES

`heater` names the [induction_heater]; with one there it may be left out. Not all read in degC: induction_power is in W,
nozzle_diameter in um, and nozzle_condition is the place of the condition in CONDITIONS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

REPORT_TIME_S = 0.5


def _melt(printer: Printer, heater: Any, eventtime: float) -> float | None:
    """Mean temperature of the melt that leaves the nozzle, by the planned flow."""
    status, exchange = heater.get_detail(eventtime), heater.parameters.melt
    if status["estimate"] is None:
        return None
    inlet_c = float(exchange.inlet_c)
    return inlet_c + (float(status["estimate"]) - inlet_c) * float(exchange.share(status["flow"]))


def _plan(printer: Printer, heater: Any, eventtime: float) -> float | None:
    """The plan's temperature at this moment; without one the target."""
    plan = printer.lookup_object("temperature_plan", None)
    planned = plan.get_status(eventtime)["planned_temperature"] if plan is not None else None
    return float(heater.get_temp(eventtime)[1] if planned is None else planned)


def _field(name: str) -> Callable[[Printer, Any, float], float | None]:
    def read(printer: Printer, heater: Any, eventtime: float) -> float | None:
        value = heater.get_detail(eventtime)[name]
        return None if value is None else float(value)

    return read


CONDITIONS = ("unknown", "clear", "restricted", "clogged", "no_filament")


def _monitor(read: Callable[[dict[str, Any]], float | None]) -> Callable[[Printer, Any, float], float | None]:
    """A figure of [nozzle_monitor]."""

    def figure(printer: Printer, heater: Any, eventtime: float) -> float | None:
        monitor = printer.lookup_object("nozzle_monitor", None)
        return None if monitor is None else read(monitor.get_status(eventtime))

    return figure


FIGURES: dict[str, Callable[[Printer, Any, float], float | None]] = {
    "induction_melt": _melt,
    "induction_plan": _plan,
    "induction_sigma": _field("sigma"),
    "induction_drift": _field("drift"),
    "induction_power": _field("power_w"),
    "nozzle_diameter": _monitor(lambda status: status["diameter"] and 1000.0 * status["diameter"]),
    "nozzle_condition": _monitor(lambda status: float(CONDITIONS.index(status["condition"]))),
}


class InductionFigure:
    """One figure, read twice a second; 0 while it is not known."""

    def __init__(self, printer: Printer, figure: str, heater_name: str | None, where: str) -> None:
        self.printer = printer
        self._read = FIGURES[figure]
        self._heater_name, self._where, self._figure = heater_name, where, figure
        self._heater: Any = None
        self._reactor = printer.get_reactor()
        self._callback: Callable[[float, float], None] | None = None
        self._timer = self._reactor.register_timer(self._sample)

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._find)
        self.printer.register_event_handler("klippy:ready", self._start)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        """A figure has no limits of its own: the nozzle's supervision has them."""

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def _find(self) -> None:
        nozzles = {
            name.split()[-1]: section.heater
            for name, section in self.printer.lookup_objects("induction_heater")
        }
        name = self._heater_name or (next(iter(nozzles)) if len(nozzles) == 1 else "")
        if name not in nozzles:
            known = ", ".join(sorted(nozzles)) or "there is none"
            asked = f"has no [induction_heater {name}]" if name else "needs the option 'heater'"
            raise self.printer.config_error(f"{self._where}: {self._figure} {asked} (known: {known}).")
        self._heater = nozzles[name]
        if self._figure.startswith("nozzle_") and self.printer.lookup_object("nozzle_monitor", None) is None:
            raise self.printer.config_error(
                f"{self._where}: {self._figure} needs a section [nozzle_monitor]."
            )

    def _start(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is None:
            self._reactor.update_timer(self._timer, self._reactor.NOW)

    def _sample(self, eventtime: float) -> float:
        value = self._read(self.printer, self._heater, eventtime)
        if self._callback is not None:
            now_s = self.printer.lookup_object("mcu").estimated_print_time(eventtime)
            self._callback(now_s, 0.0 if value is None else value)
        return eventtime + REPORT_TIME_S


def build_sensor(config: ConfigWrapper) -> InductionFigure:
    """Sensor of a section with one of these types."""
    where = f"Section '{config.get_name()}' ({config.where()})"
    figure = InductionFigure(
        config.get_printer(), config.get("sensor_type"), config.get("heater", None), where
    )
    figure.register()
    return figure


def register_builtin(heaters: Any) -> None:
    """Register the types of this file."""
    for name in FIGURES:
        heaters.add_sensor_factory(name, build_sensor)
