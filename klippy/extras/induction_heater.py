"""[induction_heater NAME]: an induction-heated nozzle whose temperature is computed from its coil current.

The joint of the thermal chain (thermal/control/loop.py, which decides) with the printer (which acts): blocks from the
induction unit go in, phase commands come out and are sent ahead by clock. Outward it is a heater like any
other; an extruder uses it with `heater: NAME` and it is then known by the extruder's name. Not used by an
extruder it is known by its own.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any, Protocol

from configfile import ConfigWrapper
from link import optional_board
from roles import Printer
from thermal.control import loop
from thermal.identification.run import OutputRun, as_control
from thermal.identification.sweep import Sweep
from thermal.records import PhaseCommand
from thermal.sensing import features, laws
from thermal.sensing.blocks import Blocks

from . import heaters as heater_registry
from .induction import calibrate as induction_calibrate
from .induction import dump as induction_dump
from .induction import flow as induction_flow
from .induction import record as induction_record
from .induction import settings, supply_switch
from .induction import supply as induction_supply
from .induction.mcu import InductionUnit
from .induction.notices import Notices
from .induction.shown import MEASURED, ShownTemperature, SweepView
from .induction.signal_limits import seen_cause
from .induction.stopped import StoppedWatch
from .outputs import output_file

QUIET_S = 0.5  # how often it is looked whether melt or fan take heat
LAPSE_MESSAGE_S = 60.0


class Planner(Protocol):
    """What moves the target along the path while one is under way: [temperature_plan]."""

    def take_target(self, target_c: float) -> bool: ...
    def is_on_path(self) -> bool: ...
    def user_target_c(self) -> float: ...
    def renew(self) -> None: ...


class InductionHeater:
    """One nozzle: the heater interface on one side, the induction unit on the other."""

    def __init__(
        self,
        printer: Printer,
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
        self.loop.on_listener_error = self._on_listener_error
        self.min_temp = parameters.supervise.temp_low_c
        self.max_temp = parameters.supervise.temp_high_c
        self.min_extrude_c = min_extrude_c
        self.smooth_time_s = smooth_time_s
        self.batch = heater_registry.is_batch(printer)
        self.served_by = ""
        self.config: Any = None  # of the section, for tunings given by option (tuning.py)
        self._reactor = printer.get_reactor()
        self._timer: Any = None
        self._run: Sweep | OutputRun | None = None  # in calibration
        self._view: SweepView | None = None  # the run commands the bridge
        self._before = parameters  # a run
        self.planner: Planner | None = None
        self._quiet_s = -math.inf
        self.notices = Notices(printer, name)
        self._next_lapse_message = 0.0
        self._ahead: induction_flow.FlowAhead | None = None
        self._running = False
        self.shown = ShownTemperature(parameters, smooth_time_s)
        self.stopped = StoppedWatch(self)
        self.record: induction_record.InductionRecord | None = None
        unit.setup_callback(self._on_blocks)

    def register(self) -> None:
        printer = self.printer
        printer.register_event_handler("klippy:ready", self._on_ready)
        printer.register_event_handler("klippy:shutdown", self._on_shutdown)
        printer.register_event_handler("klippy:disconnect", self._on_disconnect)
        printer.register_event_handler("mcu:explain_shutdown", self._explain)

    def serve(self, config: ConfigWrapper) -> InductionHeater:
        """An extruder's section names this heater: take its name and its min_extrude_temp."""
        if self.served_by:
            users = f"[{self.served_by}] and [{config.get_name()}]"
            raise config.error(f"[induction_heater {self.section_name}] is used by {users}; one is the limit")
        self.served_by = config.get_name()
        self.name = self.served_by.split()[-1]
        self.min_extrude_c = config.getfloat(
            "min_extrude_temp", self.min_extrude_c, minval=self.min_temp, maxval=self.max_temp
        )
        self._show_limits(config)
        return self

    def _show_limits(self, config: ConfigWrapper) -> None:
        """Front ends look for a heater's limits, sensor and law among the settings of the extruder's own section."""
        shown = {
            "min_temp": self.min_temp,
            "max_temp": self.max_temp,
            "sensor_type": "induction",
            "control": self.parameters.control.law.name,
            "smooth_time": self.smooth_time_s,
            "max_power": self.get_max_power(),
        }
        for option, value in shown.items():
            if config.get(option, None, note_valid=False) is not None:
                raise config.error(
                    f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): the extruder is"
                    f" heated by [induction_heater {self.section_name}], which has its own; remove it here."
                )
            read = config.getfloat if isinstance(value, float) else config.get
            read(option, value)

    # Life of the loop

    def _on_ready(self) -> None:
        if self.batch:
            return
        if self.served_by:
            self._ahead = induction_flow.FlowAhead(self.printer, self.served_by)
        self.loop.start(self._now_s())
        self.shown.start(self._now_s())
        self._running = True
        self._timer = self._reactor.register_timer(self._on_timer, self._reactor.NOW)

    def _on_shutdown(self) -> None:
        """Of whichever MCU or by whatever fault: its last moments go to the log."""
        if self._timer is not None:
            for line in self.loop.story.lines(self.loop.state, self.loop.chain.witness):
                logging.info("Induction heater '%s': %s", self.section_name, line)
            self._stop()
            self.stopped.start()

    def _on_disconnect(self) -> None:
        self._stop()
        self.stopped.end()

    def _stop(self) -> None:
        """The MCU turns the bridge off in its own shutdown; here nothing more is sent."""
        self._running = False
        self.loop.state.target_c = 0.0
        if self._run is not None:
            self._run.abort("the printer stopped")
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None

    def _explain(self, mcu: Any, reason: str) -> str:
        """After a stop of the board by its own guard: which heater, and what its signal last said."""
        if mcu is not self.unit.mcu or not reason.startswith("Induction"):
            return ""
        news = self.loop.state.estimate
        last = f"its last reading was {news.temp_c:.0f} C" if news.valid else "there was no reading before"
        if seen := seen_cause(self.loop.story.blocks(), self.parameters.front):
            last += f"; {seen}"
        self.notices.keep(reason)
        return f"Induction heater '{self.section_name}': {last}."

    def _now_s(self) -> float:
        return self.unit.print_time_now(self._reactor.monotonic())

    def _on_blocks(self, blocks: Blocks) -> None:
        if not self._running:
            self.stopped.take(blocks)
            return
        eventtime = self._reactor.monotonic()
        now_s = self.unit.print_time_now(eventtime)
        if self._view is not None:
            self._sweep(self._view, blocks, now_s)
            return
        if self.record is not None:
            self.record.tick(now_s)
        self._look_ahead(now_s)
        self._send(self.loop.on_blocks(blocks, now_s), now_s)
        if self.shown.is_calibrated:
            self.shown.measured(self.loop.state.estimate)
        else:
            self.shown.heated(now_s, 0.0)
        if (
            self._running and eventtime - self._quiet_s < QUIET_S
        ):  # while blocks come there is nothing to watch
            self._reactor.update_timer(self._timer, eventtime + self.parameters.timing.refresh_s)

    def _sweep(self, view: SweepView, blocks: Blocks, now_s: float) -> None:
        """The run decides; what it does is shown."""
        self.loop.publish(blocks, now_s, measured=False)
        self._send(view.run.on_blocks(blocks, now_s), now_s)
        news = view.take(blocks)
        if news is not None:
            self.loop.state.estimate = news
            if not self.shown.is_referred(now_s):
                self.shown.measured(news)
        self.shown.heated(now_s, view.take_heat_j())

    def show_reference(self, temp_c: float) -> None:
        """A calibration's reference reads so: better than the law that is being replaced."""
        if self._view is not None:
            self.shown.referred(temp_c, self._now_s())

    def _look_ahead(self, now_s: float) -> None:
        """Planned flow and fan, for laws that know what to do with them."""
        if self._ahead is not None and self._ahead.look(now_s):
            self.loop.flow, self.loop.fan = self._ahead.flow, self._ahead.fan

    def _on_timer(self, eventtime: float) -> float:
        """Watch, and a command if the newest one ages; control itself runs on the arrival of blocks."""
        now_s = self.unit.print_time_now(eventtime)
        period_s = self.parameters.timing.refresh_s
        if self._view is not None:
            self._send(self._view.run.on_timer(now_s), now_s)
            return eventtime + min(period_s, 0.020)
        if eventtime - self._quiet_s >= QUIET_S:
            self._quiet_s = eventtime
            self.loop.quiet = self._is_quiet(eventtime)
            self.notices.warn_once(self.warning())
            self._report_lapse(eventtime)
        if now_s - self.loop.state.decided_s >= period_s:
            self._send(self.loop.on_timer(now_s), now_s)
        return eventtime + period_s if self._running else self._reactor.NEVER

    def _send(self, commands: list[PhaseCommand], now_s: float) -> None:
        # a calibration heats to where it must
        state = self.loop.state
        self.unit.set_ceiling(state.target_c if self._run is None else math.inf, state.drift.applied_c)
        if commands:
            self.unit.queue_plan(commands)
            if self._view is not None:
                self._view.note(commands)
        # a calibration or a dump gets each message at once
        watched = self._view is not None or bool(self.loop.listeners)
        self.unit.set_batched(0.0 if watched else self.loop.patience_s())
        if self.loop.fault and self._running:
            self._running = False
            text = f"Induction heater '{self.section_name}': {self.loop.fault}"
            logging.error("%s", text)
            self.notices.keep(self.loop.fault)
            self.printer.invoke_shutdown(text)

    def _on_listener_error(self, problem: Exception) -> None:
        text = (
            f"Induction heater '{self.section_name}': what read its blocks failed and gets no more: {problem}"
        )
        logging.error("%s", text, exc_info=problem)
        self.printer.lookup_object("gcode").respond_info(text, log=False)

    def _is_quiet(self, eventtime: float) -> bool:
        """Does nothing but the air take heat from the nozzle?"""
        motion = self.printer.lookup_object("motion_report", None)
        if motion is not None and abs(motion.get_status(eventtime)["live_extruder_velocity"]) > 1e-6:
            return False
        fan = self.printer.lookup_object("fan", None)
        return fan is None or not fan.get_status(eventtime)["speed"]

    def _report_lapse(self, eventtime: float) -> None:
        """Heat lapsed and was resumed: a line in the log each time, a message not too often."""
        lapse_s, self.loop.state.lapse_s = self.loop.state.lapse_s, 0.0
        if lapse_s <= self.unit.settings.max_duration_s:
            return
        text = (
            f"no control for {lapse_s:.2f} s, the bridge was off meanwhile. The print goes on. The computer was too"
            " busy, or the line to the board was interrupted."
        )
        if eventtime >= self._next_lapse_message:
            self._next_lapse_message = eventtime + LAPSE_MESSAGE_S
            self.notices.warn(text)
        else:
            logging.warning("Induction heater '%s': %s", self.section_name, text)

    def warning(self) -> str:
        """What is not as it should be, "" while all is well."""
        noise = self.loop.chain.noise_lsb()
        if noise is not None and noise < features.NOISE_NEEDED_LSB:
            return (
                f"too little noise at the ADC for oversampling ({noise:.2f} LSB, {features.NOISE_NEEDED_LSB} needed):"
                " readings snap to whole codes"
            )
        return self.loop.state.warning

    # In calibration

    def acquire(self, run: Sweep | OutputRun) -> None:
        """Let a sweep command the bridge, or another run be the control law; raises command_error if the heater is in
        use."""
        if not self._running:
            raise self.printer.command_error(f"Induction heater '{self.section_name}' is not running")
        if self.loop.state.target_c or self.in_calibration:
            raise self.printer.command_error(f"Turn heater '{self.name}' off before calibrating it")
        if isinstance(run, OutputRun):
            self._refuse_uncalibrated()
            self._before = self.parameters
            still = replace(self.parameters.actuator, hold_look_s=0.0)
            control = as_control(run, self.output_max)
            self.use(replace(self.parameters, control=control, actuator=still, drift=None))
            self._set_target(run.target_c)
        else:
            self._view = SweepView(run, self.parameters, self._now_s())
        self._run = run

    def follow_run(self) -> None:
        """The loop's target is the run's."""
        if isinstance(self._run, OutputRun) and self._run.target_c != self.loop.state.target_c:
            self._set_target(self._run.target_c)

    def release(self) -> None:
        """The loop commands the bridge again, by its own law, heater off."""
        if self._view is not None:
            self._send(self._view.run.on_timer(self._now_s()), self._now_s())
            self._view = None
            self.loop.resume(self._now_s())
        else:
            self._set_target(0.0)
            before = self._before
            looks = replace(self.parameters.actuator, hold_look_s=before.actuator.hold_look_s)
            self.use(replace(self.parameters, control=before.control, actuator=looks, drift=before.drift))
        self._run = None

    @property
    def in_calibration(self) -> bool:
        return self._run is not None

    @property
    def output_max(self) -> float:
        """W."""
        return self.parameters.control.power_max_w

    def reading(self, eventtime: float) -> tuple[float, float]:
        """(age in s, degC) of the newest estimate."""
        news = self.loop.state.estimate
        if not news.valid:
            return math.inf, math.nan
        return self.unit.print_time_now(eventtime) - news.time_s, news.temp_c

    def now_s(self) -> float:
        """Print time of the induction unit's MCU."""
        return self._now_s()

    def use(self, parameters: loop.LoopParameters) -> None:
        """Work with other parameters from now on (a new calibration); the MCU's own limits stay as configured."""
        parameters = settings.remodelled(parameters)
        before, self.parameters = self.parameters, parameters
        self.loop.use(parameters)
        self.shown.use(parameters)
        if self.planner is not None and parameters.melt != before.melt:
            self.planner.renew()

    # The heater interface

    def set_temp(self, degrees: float) -> None:
        """New target in degC, 0 = off. Raises the printer's command_error if out of range."""
        if self._run is not None:
            if degrees:
                raise self.printer.command_error(f"Heater '{self.name}' is being calibrated; ABORT ends that")
            self._run.abort("the heater was turned off")
        if degrees:
            self._refuse_uncalibrated()
        if degrees and not self.min_temp <= degrees <= self.target_max_c:
            raise self.printer.command_error(self._range_error(degrees))
        if degrees and self.planner is not None and self.planner.take_target(degrees):
            return  # path is under way: the plan moves with it
        self._set_target(degrees)

    def _set_target(self, degrees: float) -> None:
        if self._running:
            now_s = self._now_s()
            self._send(self.loop.set_target(degrees, now_s), now_s)
        else:
            self.loop.state.target_c = degrees

    def _refuse_uncalibrated(self) -> None:
        if not self.parameters.supervise.calibrated:
            raise self.printer.command_error(
                f"Heater '{self.name}' is not calibrated: run INDUCTION_CALIBRATE HEATER={self.section_name} first"
            )

    @property
    def target_max_c(self) -> float:
        """The greatest target: the law in use holds it below supervision's limit."""
        return self.max_temp - self.parameters.control.beyond_c

    def _range_error(self, degrees: float) -> str:
        text = heater_registry.range_error(degrees, self.min_temp, self.target_max_c)
        if degrees > self.max_temp or degrees < self.min_temp:
            return text
        chosen = self.parameters.control
        return (
            f"{text}: control: {chosen.law.name} swings, so that the greatest target is {chosen.beyond_c:g} C below"
            f" max_temp of [induction_heater {self.section_name}]"
        )

    def alter_target(self, target_temp: float) -> None:
        """Move the target without an error, limited to the range; 0 stays off."""
        if target_temp:
            target_temp = max(self.min_temp, min(self.target_max_c, target_temp))
        self.set_temp(target_temp)

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        """(displayed temperature, target) in degC."""
        return self.shown.temp_c, self.loop.state.target_c

    def check_busy(self, eventtime: float) -> bool:
        """Still on the way to the target?"""
        if self.planner is not None and self.planner.is_on_path():
            return not self.batch
        # A reading that swings is at the target by its mean.
        is_near = abs(self.shown.temp_c - self.loop.state.target_c) <= self.loop.SETTLED_C
        return not self.batch and not is_near and not self.loop.is_settled()

    @property
    def target_temp(self) -> float:
        """The user's own: a macro that saves it in a pause must not save what a plan wants at that moment."""
        if self._view is not None:
            return self._view.run.target_c
        if self.planner is not None and self.planner.is_on_path():
            return self.planner.user_target_c()
        return self.loop.state.target_c

    @property
    def min_extrude_temp(self) -> float:
        """min_extrude_c by the name other heaters have."""
        return self.min_extrude_c

    @property
    def can_extrude(self) -> bool:
        is_measured = self._view is None and self.shown.source == MEASURED
        return self.batch or (is_measured and self.shown.temp_c >= self.min_extrude_c)

    def get_max_power(self) -> float:
        return 1.0

    def get_smooth_time(self) -> float:
        return self.smooth_time_s

    def _given(self) -> tuple[float, int]:
        """(W, phase) that the bridge is to give now; after a stop it is off."""
        if not self._running:
            return 0.0, 0
        if self._view is not None:
            return self._view.power_w, self._view.command.phase_ticks
        return self.loop.state.request.power_w, self.loop.state.commanded.phase_ticks

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The usual heater fields; `power` is the share of max_power_w."""
        return {
            "temperature": round(self.shown.temp_c, 2),
            "temperature_source": self.shown.source,
            "target": self.target_temp,
            "power": round(self._given()[0] / self.parameters.control.power_max_w, 4),
        }

    def get_detail(self, eventtime: float) -> dict[str, Any]:
        """Status of the section `induction_heater NAME`: the heater fields and the chain's inside."""
        state = self.loop.state
        news = state.estimate
        now_s = self.unit.print_time_now(eventtime)
        age_s = now_s - news.time_s
        power_w, phase_ticks = self._given()
        return {
            **self.get_status(eventtime),
            "can_extrude": self.can_extrude,
            "estimate": round(news.temp_c, 3) if news.valid else None,
            "sigma": round(news.sigma_c, 3) if news.valid else None,
            "tip": _rounded(
                self.parameters.melt.tip_c(news.temp_c, self.loop.flow.at(now_s)) if news.valid else None
            ),
            "estimate_age": round(age_s, 4) if news.valid else None,
            "valid": self._running and news.valid and age_s <= self.parameters.supervise.invalid_s,
            "power_w": round(power_w, 3),
            "phase": phase_ticks,
            "fault": self.loop.fault or None,
            "warning": self.warning() or None,
            "notices": self.notices.kept,
            "control": self.parameters.control.law.name,
            "flow": round(self.loop.flow.at(now_s), 3),
            "disturbance_w": _rounded(
                getattr(state.law, "disturbance_w", None)
            ),  # of the predictive law only
            "guard": "armed" if self._running else "off",
            "law": laws.coefficients_of(self.parameters.estimator.law)[0],
            "law_residual": self.parameters.estimator.law.residual_units,
            "calibrated": self.parameters.supervise.calibrated,
            "calibrating": self._running and self.in_calibration,
            "latency": round(state.latency_s, 4),
            "noise_lsb": _rounded(self.loop.chain.noise_lsb()),
            "drive_offset": round(self.loop.chain.state.drive.full_c, 2),
            "drift": round(state.drift.state.drift_c, 2),
            "drift_sigma": round(state.drift.state.sigma_c, 2),
            "heat_balance": _rounded(state.heat_balance.drift_c),
            "capacity_ratio": _rounded(state.heat_balance.capacity_ratio),
            "supply": round(self.parameters.estimator.supply, 4),
            **self.unit.get_status(),
        }

    def stats(self, eventtime: float) -> tuple[bool, str]:
        state = self.loop.state
        active = state.target_c > 0.0 or self.shown.temp_c > 50.0
        power_w, phase_ticks = self._given()
        share = power_w / self.parameters.control.power_max_w
        text = (
            f"{self.name}: target={state.target_c:.0f} temp={self.shown.temp_c:.1f} pwm={share:.3f}"
            f" power_w={power_w:.2f} phase={phase_ticks}"
            f" blocks_lost={self.unit.get_status()['blocks_lost']}"
        )
        return active, text


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


class InductionSection:
    """The object under the section's own name: detailed status, and the heater for others."""

    def __init__(self, config: ConfigWrapper, heater: InductionHeater) -> None:
        self.heater = heater
        self._config = config
        self.serve = heater.serve
        self.get_status = heater.get_detail
        self.get_temp = heater.get_temp
        self.stats = heater.stats

    def register(self) -> None:
        self.heater.register()
        self.heater.printer.register_event_handler("klippy:mcu_identify", self._check_name)
        self.heater.printer.register_event_handler("klippy:connect", self._on_connect)

    def _check_name(self) -> None:
        """All sections are read: HEATER=name must mean one heater."""
        name = self.heater.section_name
        if self.heater.printer.lookup_object("heaters").heaters.get(name, self.heater) is not self.heater:
            raise self._config.error(
                f"Section '{self._config.get_name()}' ({self._config.where()}): heater '{name}' is another one, and"
                f" commands with HEATER={name} must know which is meant. Give the section another name."
            )

    def _on_connect(self) -> None:
        """Commands know it by its section's name, too. No extruder took it: it is a heater of its own."""
        heater, registry = self.heater, self.heater.printer.lookup_object("heaters")
        if not heater.served_by:
            registry.add_heater(self._config, heater)
        elif heater.name != heater.section_name:
            registry.answer_to(heater.section_name, heater)


def load_config_prefix(config: ConfigWrapper) -> InductionSection:
    printer = config.get_printer()
    printer.load_object(config, "heaters")
    name = config.get_name().split()[-1]
    optional_board.refuse(config, "sense_pin")
    sense = printer.lookup_object("pins").lookup_pin(config.get("sense_pin"))
    unit_settings = settings.read_unit(config)
    parameters = settings.read_parameters(config, unit_settings)
    rows = settings.guard_rows(config, parameters)
    tests = settings.read_tests(config, parameters)
    ceiling = settings.ceiling(config, parameters, rows)
    unit = InductionUnit(sense["chip"], sense["pin"], unit_settings, parameters.front, rows, tests, ceiling)
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
    heater.config = config
    section = InductionSection(config, heater)
    section.register()
    folder = config.get("calibration_folder", output_file.default_folder(printer))
    induction_calibrate.InductionCalibrate(printer, heater, folder).register()
    induction_dump.InductionDump(printer, heater, folder).register()
    heater.record = induction_record.InductionRecord(config, heater, rows, folder)
    heater.record.register()
    supply_switch.read(config)
    supply = induction_supply.read(config)
    if supply is not None:
        supply.serve(heater)
    return section
