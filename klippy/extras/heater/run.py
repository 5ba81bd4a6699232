"""A calibration at a heater's place of command: starts it, watches it, ends it with the heater off.

A run (thermal/identification/relay.py, thermal/identification/step_test.py) is asked at every reading for the output.
At an ordinary heater it takes the law's place (`borrow`); at an induction nozzle it *is* the law for a while, so the
whole chain with its guards stays as it is. ABORT, TURN_OFF_HEATERS or a stop of the printer end it at any time.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from gcode import GCodeCommand
from roles import Printer
from thermal.control import control_api, loop
from thermal.identification import step_test

from . import tuning as heater_tuning

FIT_PACKAGES = ("numpy", "scipy")  # requirements.txt
ABORT_HELP = "End the calibration"
POLL_S = 0.1
PROGRESS_S = 10.0
FRESH_S = 3.0
SENSOR_LEAST_C = 0.0
QUIET_S = 10.0  # no reading for so long: the sensor is gone


def need_fit(gcmd: GCodeCommand) -> None:
    """Before a run of minutes: are the packages there that its evaluation needs? Raises the command's error."""
    missing = [name for name in FIT_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise gcmd.error(
            f"The fit after the run needs Python packages that are missing: {', '.join(missing)}. Run"
            " scripts/install.sh or `make setup` in the folder of the host, then restart it"
        )


class Run(Protocol):
    """A calibration that decides outputs."""

    fault: str

    @property
    def over(self) -> bool: ...
    @property
    def target_c(self) -> float: ...
    def decide(self, time_s: float, temp_c: float, limit: float = math.inf) -> float: ...
    def abort(self, reason: str) -> None: ...
    def progress(self) -> str: ...


class OrdinarySeat:
    """Command of an ordinary heater."""

    def __init__(self, heater: Any) -> None:
        self.heater = heater
        self.most = float(heater.get_max_power())

    def reading(self, eventtime: float) -> tuple[float, float]:
        """(age in s, degC)."""
        read_s, temp_c = self.heater.reading
        if not read_s:
            return math.inf, math.nan
        return self.heater.pwm.get_mcu().estimated_print_time(eventtime) - read_s, temp_c

    def take(self, run: Run) -> None:
        self.heater.borrow(run)

    def keep(self, run: Run) -> None:
        """Nothing to do between readings."""

    def leave(self) -> None:
        self.heater.give_back()


class InductionSeat:
    """Command of an induction nozzle, through its loop; outputs in watts."""

    def __init__(self, heater: Any) -> None:
        self.heater = heater
        self.most = float(heater.parameters.control.power_max_w)
        self._control: loop.Control = heater.parameters.control
        self._taken = False
        self._told_c = 0.0

    def reading(self, eventtime: float) -> tuple[float, float]:
        news = self.heater.loop.state.estimate
        return (self.heater.now_s() - news.time_s, news.temp_c) if news.valid else (math.inf, math.nan)

    def take(self, run: Run) -> None:
        heater = self.heater
        if heater.loop.state.target_c:
            raise heater.printer.command_error(f"Turn heater '{heater.name}' off before calibrating it")
        self._control = heater.parameters.control
        law = control_api.Law("calibration", _stepper(run, self.most), 0, lambda p, state, inputs, out: state)
        heater.use(replace(heater.parameters, control=loop.Control(law, None, self.most, models=True)))
        self._told_c = run.target_c
        heater.set_temp(self._told_c)
        self._taken = heater.lent = True

    def keep(self, run: Run) -> None:
        """The loop's target follows the run's; one set from outside ends it."""
        if self.heater.loop.state.target_c != self._told_c:
            run.abort("somebody else set the heater's target")
        elif run.target_c != self._told_c:
            self._told_c = run.target_c
            self.heater.set_temp(self._told_c)

    def leave(self) -> None:
        if self._taken:
            self.heater.set_temp(0.0)
            self.heater.use(replace(self.heater.parameters, control=self._control))
            self.heater.lent = False


def _stepper(run: Run, most: float) -> Callable[..., tuple[control_api.ControlOutput, int]]:
    """The run as a control law."""

    def step(
        parameters: None, state: int, inputs: control_api.ControlInput, time_s: float
    ) -> tuple[control_api.ControlOutput, int]:
        seen = [s for s in inputs.samples if s.temp_c == s.temp_c and not s.rebased]
        if isinstance(run, step_test.Drill):
            run.heard(inputs.samples, inputs.flow_mm3_s)
        temp_c = math.fsum(s.temp_c for s in seen) / len(seen) if seen else math.nan
        at_s = math.fsum(s.time_s for s in seen) / len(seen) if seen else time_s
        power = max(0.0, min(most, inputs.limit, run.decide(at_s, temp_c, min(most, inputs.limit))))
        return control_api.ControlOutput(power, power, power, 0.0, 0.0, 0.0), state

    return step


class Session:
    """One calibration of one heater."""

    def __init__(self, printer: Printer, heater: Any, what: str) -> None:
        self.printer = printer
        self.heater = heater
        self.what = what
        self.gcode = printer.lookup_object("gcode")
        self.induction = heater_tuning.is_induction(heater)
        self.seat = InductionSeat(heater) if self.induction else OrdinarySeat(heater)
        self._reactor = printer.get_reactor()
        self._timer: Any = None
        self._run: Run | None = None
        self._done: Callable[[], None] = lambda: None
        self._each: Callable[[], None] = lambda: None
        self._told_s = self._heard_s = 0.0
        self.active = False

    def check_sensor(self, gcmd: GCodeCommand) -> float:
        """Temperature now; an error for a sensor that is silent or reads what no room has."""
        eventtime = self._reactor.monotonic()
        until_s = eventtime + FRESH_S
        age_s, temp_c = self.seat.reading(eventtime)
        while not age_s < FRESH_S and eventtime < until_s:  # just started: the first reading is on its way
            eventtime = self._reactor.pause(eventtime + POLL_S)
            age_s, temp_c = self.seat.reading(eventtime)
        if not age_s < FRESH_S or not math.isfinite(temp_c):
            raise gcmd.error(
                f"{self.what}: heater '{self.heater.name}' has no fresh reading; check its temperature sensor"
            )
        if temp_c < SENSOR_LEAST_C:
            raise gcmd.error(
                f"{self.what}: heater '{self.heater.name}' reads {temp_c:.1f} C. A sensor so cold is disconnected or of"
                " another type than configured; nothing was heated"
            )
        if temp_c > self.heater.max_temp:
            raise gcmd.error(
                f"{self.what}: heater '{self.heater.name}' reads {temp_c:.0f} C, above its max_temp. Either it is that"
                " hot, or its sensor is shorted or of another type than configured; nothing was heated"
            )
        return temp_c

    def start(self, run: Run, done: Callable[[], None], each: Callable[[], None] | None = None) -> None:
        """Take the heater; `done` when the run is over, the heater off and given back; `each` every 0.1 s before."""
        running = self.gcode.register_command("ABORT", None)
        if running is not None:
            self.gcode.register_command("ABORT", running, desc=ABORT_HELP)
            raise self.printer.command_error("Another calibration is running; ABORT ends it")
        self.seat.take(run)
        self._run, self._done, self._each = run, done, each or (lambda: None)
        self.active = True
        self.gcode.register_command("ABORT", self._cmd_abort, desc=ABORT_HELP)
        self._told_s = self._heard_s = self._reactor.monotonic()
        self._timer = self._reactor.register_timer(self._on_timer, self._reactor.NOW)

    def wait(self) -> None:
        """Until the calibration is over."""
        eventtime = self._reactor.monotonic()
        while self.active and not self.printer.is_shutdown():
            eventtime = self._reactor.pause(eventtime + POLL_S)

    def say(self, text: str) -> None:
        self.gcode.respond_info(text)

    def _cmd_abort(self, gcmd: GCodeCommand) -> None:
        if self._run is not None:
            self._run.abort("ended by ABORT")

    def _on_timer(self, eventtime: float) -> float:
        run = self._run
        if run is None:
            return float(self._reactor.NEVER)
        if self.printer.is_shutdown():
            run.abort("the printer stopped")
        age_s, temp_c = self.seat.reading(eventtime)
        if age_s < FRESH_S:
            self._heard_s = eventtime
        elif not run.over and eventtime - self._heard_s > QUIET_S:
            run.abort(f"no reading for {QUIET_S:.0f} s")
        if not run.over:
            self.seat.keep(run)
            self._each()
        if run.over:
            self._finish()
            return float(self._reactor.NEVER)
        if eventtime - self._told_s >= PROGRESS_S:
            self._told_s = eventtime
            self.say(f"{self.what}: {run.progress()}, {temp_c:.1f} C")
        return eventtime + POLL_S

    def _finish(self) -> None:
        self._reactor.unregister_timer(self._timer)
        self._timer = self._run = None
        if not self.printer.is_shutdown():
            self.seat.leave()
        self.gcode.register_command("ABORT", None)
        try:
            self._done()
        finally:
            self.active = False
