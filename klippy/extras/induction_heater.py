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

from thermal import actuator, control, estimator, features, limits, loop, model, supervise
from thermal.records import PhaseCommand, SampleBlock

from . import heaters as heater_registry
from .induction_mcu import InductionUnit, UnitSettings

SETTLE_MARGIN_SAMPLES = 4  # a sensing pulse lasts this much longer than settling plus one block
WATCH_FRACTION = 1.0 / 3.0  # of max_duration: how often commands are repeated at least
GUARD_LOW_C = -60.0  # below any workshop by more than the law's error

# Defaults for the reference nozzle (0.9 g, 0.45 J/K): found in test/loop, where mass, losses and efficiency
# vary.
DEFAULT_KP_W_PER_K = 5.0
DEFAULT_KI_W_PER_K_S = 10.0
DEFAULT_KD_W_S_PER_K = 0.15
DEFAULT_DERIVATIVE_S = 0.010
DEFAULT_LEAD_S = 0.015


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


######################################################################
# Reading the section
######################################################################


def _read_law(config: Any) -> estimator.Law:
    """`estimator: exp` or `eq5`, each coefficient an option with the seeds' value as default."""
    choice = config.getchoice("estimator", {"exp": "exp", "eq5": "eq5"}, "exp")
    if choice == "eq5":
        paper = estimator.Eq5Law()
        return estimator.Eq5Law(
            config.getfloat("eq5_a", paper.a),
            config.getfloat("eq5_b", paper.b),
            config.getfloat("eq5_ab", paper.ab),
            config.getfloat("eq5_bb", paper.bb),
            config.getfloat("eq5_abb", paper.abb),
            config.getfloat("eq5_c", paper.c),
            config.getfloat("law_residual", paper.residual_units, minval=0.0),
        )
    fitted = estimator.ExpLaw()
    return estimator.ExpLaw(
        config.getfloat("exp_a", fitted.a, above=0.0),
        config.getfloat("exp_b", fitted.b),
        config.getfloat("exp_c", fitted.c),
        config.getfloat("exp_d", fitted.d),
        config.getfloat("law_residual", fitted.residual_units, minval=0.0),
    )


def _read_unit(config: Any) -> UnitSettings:
    return UnitSettings(
        config.getint("bridge", 0, minval=0, maxval=255),
        config.getfloat("frequency", 120000.0, minval=20000.0, maxval=1000000.0),
        config.getint("oversample", 5, minval=2, maxval=6),
        config.getint("settle_samples", 20, minval=0, maxval=1000),
        config.getint("ema_shift", 0, minval=0, maxval=8),
        config.getfloat("max_duration", 0.100, minval=0.030, maxval=5.0),
        config.getint("guard_trip_blocks", 4, minval=1, maxval=255),
    )


def _read_timing(config: Any, unit: UnitSettings) -> loop.Timing:
    period_s = 1.0 / unit.frequency_hz
    refresh_s = unit.max_duration_s * WATCH_FRACTION
    return loop.Timing(
        period_s * 4**unit.oversample,
        period_s * unit.settle_samples,
        config.getfloat("command_lead", DEFAULT_LEAD_S, minval=0.001, maxval=0.200),
        refresh_s,
    )


def _read_drive(config: Any, timing: loop.Timing, frequency_hz: float) -> actuator.ActuatorParameters:
    law = actuator.DriveLaw(
        config.getfloat("power_full_w", 81.3, above=0.0),
        config.getfloat("drive_exponent", 1.5, above=0.0),
        config.getfloat("vdc", 24.0, above=0.0),
    )
    pulse_s = timing.block_s + timing.settle_s + SETTLE_MARGIN_SAMPLES / frequency_hz
    return actuator.ActuatorParameters(
        law,
        pulse_s,
        config.getfloat("sense_interval", 0.100, minval=2.0 * pulse_s, maxval=1.0),
        config.getfloat("idle_interval", 0.500, minval=2.0 * pulse_s, maxval=1.0),
    )


def _read_pid(config: Any, drive: actuator.DriveLaw) -> control.PidParameters:
    config.getchoice("control", {"pid": "pid"}, "pid")
    max_power_w = config.getfloat("max_power_w", drive.power_max_w, above=0.0, maxval=drive.power_max_w)
    return control.PidParameters(
        config.getfloat("pid_kp_w_per_k", DEFAULT_KP_W_PER_K, above=0.0),
        config.getfloat("pid_ki_w_per_k_s", DEFAULT_KI_W_PER_K_S, minval=0.0),
        config.getfloat("pid_kd_w_s_per_k", DEFAULT_KD_W_S_PER_K, minval=0.0),
        0.0,
        max_power_w,
        config.getfloat("pid_derivative_time", DEFAULT_DERIVATIVE_S, minval=0.0, maxval=1.0),
    )


def _read_approach(config: Any, drive: actuator.DriveLaw) -> loop.Approach:
    default = loop.Approach()
    band_c = config.getfloat("approach_band", default.band_c, minval=10.0, maxval=300.0)
    power_w = config.getfloat(
        "approach_power_w", min(default.power_w, drive.power_max_w), above=0.0, maxval=drive.power_max_w
    )
    return loop.Approach(power_w, band_c, band_c + default.leave_c - default.band_c)


def _read_loss(config: Any) -> model.LossLaw:
    return model.LossLaw(
        config.getfloat("loss_w_per_k", model.LossLaw().conductance_w_k, minval=0.0),
        config.getfloat("loss_radiation_m2", model.LossLaw().radiation_m2, minval=0.0),
        config.getfloat("ambient_temp", model.LossLaw().ambient_c, minval=-50.0, maxval=100.0),
    )


def _read_parameters(config: Any, unit: UnitSettings, adc_max: int) -> loop.LoopParameters:
    law = _read_law(config)
    front = features.FeatureParameters(
        config.getfloat("adc_zero", 256.0),
        config.getfloat("units_per_lsb", 1.0, above=0.0),
        config.getfloat("noise_lsb", 1.0, minval=0.0),
        adc_max,
    )
    temp_low_c = config.getfloat("min_temp", -10.0, minval=-20.0)
    temp_high_c = config.getfloat("max_temp", above=max(temp_low_c, 0.0), maxval=700.0)
    timing = _read_timing(config, unit)
    drive = _read_drive(config, timing, unit.frequency_hz)
    return loop.LoopParameters(
        front,
        estimator.EstimatorParameters(law),
        _read_pid(config, drive.law),
        _read_loss(config),
        drive,
        supervise.SuperviseParameters(temp_low_c, temp_high_c),
        timing,
        _read_approach(config, drive.law),
    )


ADC_MAX_12_BIT = 4095


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
    settings = _read_unit(config)
    parameters = _read_parameters(config, settings, ADC_MAX_12_BIT)
    margin_c = config.getfloat("guard_margin", 40.0, minval=5.0, maxval=200.0)
    try:
        rows = limits.guard_limits(
            parameters.estimator.law,
            parameters.front,
            GUARD_LOW_C,
            parameters.supervise.temp_high_c + margin_c,
        )
    except ValueError as e:
        raise config.error(f"Section '{config.get_name()}': {e}") from None
    unit = InductionUnit(sense["chip"], sense["pin"], settings, rows)
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
