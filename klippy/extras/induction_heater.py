"""[induction_heater NAME]: an induction-heated nozzle whose own coil current tells its temperature.

The joint of the thermal chain (thermal/loop.py, which decides) with the printer (which acts): blocks from the
induction unit go in, phase commands come out and are sent ahead by clock. Outward it is a heater like any
other; an extruder uses it with `heater: NAME` and it is then known by the extruder's name. Not used by an
extruder it is known by its own.
"""

from __future__ import annotations

import logging
import math
from typing import Any

from thermal import features, loop
from thermal.records import PhaseCommand, SampleBlock

from . import heaters as heater_registry
from . import induction_settings as settings
from .induction_mcu import InductionUnit


class InductionHeater:
    """One nozzle: the heater interface on one side, the induction unit on the other."""

    def __init__(
        self,
        printer: Any,
        name: str,
        unit: InductionUnit,
        parameters: loop.LoopParameters,
        min_extrude_c: float,
        smooth_time_s: float,
    ) -> None:
        self.printer = printer
        self.name = name
        self.section_name = name
        self.unit = unit
        self.parameters = parameters
        self.loop = loop.InductionLoop(parameters)
        self.min_temp = parameters.supervise.temp_low_c
        self.max_temp = parameters.supervise.temp_high_c
        self.min_extrude_c = min_extrude_c
        self.smooth_time_s = smooth_time_s
        self.batch = heater_registry.is_batch(printer)
        self.served_by = ""
        self._reactor = printer.get_reactor()
        self._timer: Any = None
        self._running = False
        self._smoothed_c = 0.0
        self._smoothed_s = -math.inf
        unit.setup_callback(self._on_blocks)

    def register(self) -> None:
        printer = self.printer
        printer.register_event_handler("klippy:ready", self._on_ready)
        printer.register_event_handler("klippy:shutdown", self._stop)
        printer.register_event_handler("klippy:disconnect", self._stop)

    def serve(self, config: Any) -> InductionHeater:
        """An extruder's section names this heater: take its name and its min_extrude_temp."""
        if self.served_by:
            users = f"[{self.served_by}] and [{config.get_name()}]"
            raise config.error(f"[induction_heater {self.section_name}] is used by {users}; one is the limit")
        self.served_by = config.get_name()
        self.name = self.served_by.split()[-1]
        self.min_extrude_c = config.getfloat(
            "min_extrude_temp", self.min_extrude_c, minval=self.min_temp, maxval=self.max_temp
        )
        return self

    # Life of the loop

    def _on_ready(self) -> None:
        if self.batch:
            return
        self.loop.start(self._now_s())
        self._running = True
        self._timer = self._reactor.register_timer(self._on_timer, self._reactor.NOW)

    def _stop(self) -> None:
        """The MCU turns the bridge off in its own shutdown; here nothing more is sent."""
        self._running = False
        self.loop.state.target_c = 0.0
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None

    def _now_s(self) -> float:
        return self.unit.print_time_now(self._reactor.monotonic())

    def _on_blocks(self, blocks: list[SampleBlock]) -> None:
        if not self._running:
            return
        now_s = self._now_s()
        self._send(self.loop.on_blocks(blocks, now_s))
        self._smooth()

    def _on_timer(self, eventtime: float) -> float:
        """Watch, and a command if the newest one ages; control itself runs on the arrival of blocks."""
        period_s = self.parameters.timing.refresh_s
        now_s = self.unit.print_time_now(eventtime)
        if now_s - self.loop.state.decided_s >= period_s:
            self._send(self.loop.on_timer(now_s))
        return eventtime + period_s if self._running else self._reactor.NEVER

    def _send(self, commands: list[PhaseCommand]) -> None:
        for command in commands:
            self.unit.queue_phase(command)
        if self.loop.fault and self._running:
            self._running = False
            text = f"Induction heater '{self.section_name}': {self.loop.fault}"
            logging.error("%s", text)
            self.printer.invoke_shutdown(text)

    def _smooth(self) -> None:
        """The displayed temperature: first-order, over `smooth_time`."""
        news = self.loop.state.estimate
        since_s = news.time_s - self._smoothed_s
        if not news.valid or since_s <= 0.0:
            return
        share = since_s / (since_s + self.smooth_time_s) if since_s < math.inf else 1.0
        self._smoothed_c += (news.temp_c - self._smoothed_c) * share
        self._smoothed_s = news.time_s

    # The heater interface

    def set_temp(self, degrees: float) -> None:
        """New target in degC, 0 = off. Raises the printer's command_error if out of range."""
        if degrees and not self.min_temp <= degrees <= self.max_temp:
            raise self.printer.command_error(
                heater_registry.range_error(degrees, self.min_temp, self.max_temp)
            )
        if self._running:
            self._send(self.loop.set_target(degrees, self._now_s()))
        else:
            self.loop.state.target_c = degrees

    def alter_target(self, target_temp: float) -> None:
        """Move the target without an error, limited to the range; 0 stays off."""
        if target_temp:
            target_temp = max(self.min_temp, min(self.max_temp, target_temp))
        self.set_temp(target_temp)

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        """(displayed temperature, target) in degC."""
        return self._smoothed_c, self.loop.state.target_c

    def check_busy(self, eventtime: float) -> bool:
        """Still on the way to the target?"""
        return not self.batch and not self.loop.is_settled()

    @property
    def can_extrude(self) -> bool:
        return self.batch or self._smoothed_c >= self.min_extrude_c

    def get_max_power(self) -> float:
        return 1.0

    def get_smooth_time(self) -> float:
        return self.smooth_time_s

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The usual heater fields; `power` is the share of max_power_w."""
        state = self.loop.state
        return {
            "temperature": round(self._smoothed_c, 2),
            "target": state.target_c,
            "power": round(state.request.power_w / self.parameters.pid.output_high, 4),
        }

    def get_detail(self, eventtime: float) -> dict[str, Any]:
        """Status of the section `induction_heater NAME`: the heater fields and the chain's inside."""
        state = self.loop.state
        news = state.estimate
        age_s = self.unit.print_time_now(eventtime) - news.time_s
        return {
            **self.get_status(eventtime),
            "can_extrude": self.can_extrude,
            "estimate": round(news.temp_c, 3) if news.valid else None,
            "sigma": round(news.sigma_c, 3) if news.valid else None,
            "estimate_age": round(age_s, 4) if news.valid else None,
            "power_w": round(state.request.power_w, 3),
            "phase": state.commanded.phase_ticks,
            "fault": self.loop.fault or None,
            **self.unit.get_status(),
        }

    def stats(self, eventtime: float) -> tuple[bool, str]:
        state = self.loop.state
        active = state.target_c > 0.0 or self._smoothed_c > 50.0
        share = state.request.power_w / self.parameters.pid.output_high
        text = (
            f"{self.name}: target={state.target_c:.0f} temp={self._smoothed_c:.1f} pwm={share:.3f}"
            f" power_w={state.request.power_w:.2f} phase={state.commanded.phase_ticks}"
            f" blocks_lost={self.unit.counters.missing_blocks}"
        )
        return active, text


class InductionSection:
    """The object under the section's own name: detailed status, and the heater for others."""

    def __init__(self, config: Any, heater: InductionHeater) -> None:
        self.heater = heater
        self._config = config
        self.serve = heater.serve
        self.get_status = heater.get_detail
        self.get_temp = heater.get_temp
        self.stats = heater.stats

    def register(self) -> None:
        self.heater.register()
        self.heater.printer.register_event_handler("klippy:connect", self._on_connect)

    def _on_connect(self) -> None:
        """No extruder took it: it is a heater of its own."""
        if not self.heater.served_by:
            registry = self.heater.printer.lookup_object("heaters")
            registry.add_heater(self._config, self.heater)


def load_config_prefix(config: Any) -> InductionSection:
    printer = config.get_printer()
    printer.load_object(config, "heaters")
    name = config.get_name().split()[-1]
    sense = printer.lookup_object("pins").lookup_pin(config.get("sense_pin"))
    unit_settings = settings.read_unit(config)
    parameters = settings.read_parameters(config, unit_settings)
    rows = settings.guard_rows(config, parameters)
    unit = InductionUnit(sense["chip"], sense["pin"], unit_settings, rows)
    heater = InductionHeater(
        printer,
        name,
        unit,
        parameters,
        config.getfloat(
            "min_extrude_temp",
            170.0,
            minval=parameters.supervise.temp_low_c,
            maxval=parameters.supervise.temp_high_c,
        ),
        config.getfloat("smooth_time", 0.050, minval=0.0, maxval=5.0),
    )
    section = InductionSection(config, heater)
    section.register()
    return section
