"""The runner of a calibration: acquires the heater, ends the run in every case, writes its trace, has it fitted.

    start ── acquire ── poll until the run is over ── release ── done() ── fit() in a process of its own ── take(result)

The run itself is pure (thermal/identification/run.py); the heater feeds it with readings or blocks. ABORT,
TURN_OFF_HEATERS, M104 S0, a silent sensor or a stop of the printer end it, and the heater is off after it. ABORT ends
a fit, too.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import util
from gcode import GCodeCommand
from gcode_waits import ScriptEnded
from roles import Printer
from thermal.identification.run import Run

from ..outputs import output_file
from . import tuning as heater_tuning

HOST_FOLDER = Path(__file__).resolve().parents[2]
FIT_PACKAGES = ("numpy", "scipy")  # requirements.txt
ABORTED = "ended by ABORT"
WAIT_S = 0.1
FRESH_S = 3.0
SENSOR_MIN_C = 0.0


def need_fit(gcmd: GCodeCommand) -> None:
    """Before a run of minutes: are the packages there that its evaluation needs? Raises the command's error."""
    missing = [name for name in FIT_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise gcmd.error(
            f"The fit after the run needs Python packages that are missing: {', '.join(missing)}. Run"
            " scripts/install.sh or `make setup` in the folder of the host, then restart it"
        )


class Runner:
    """One calibration of one heater."""

    def __init__(self, printer: Printer, heater: Any, what: str) -> None:
        self.printer = printer
        self.heater = heater
        self.what = what
        self.gcode = printer.lookup_object("gcode")
        self.induction = heater_tuning.is_induction(heater)
        self.active = False  # until the fit has ended
        self._reactor = printer.get_reactor()
        self._timer: Any = None
        self._run: Run | None = None
        self._fit: subprocess.Popen[str] | None = None
        self._is_fitting = self._is_aborted = False
        self._done: Callable[[], None] = lambda: None
        self._each: Callable[[float], None] = lambda eventtime: None
        self._reported_s = self._received_s = 0.0

    def check_sensor(self, gcmd: GCodeCommand) -> float:
        """Temperature now; an error for a sensor that is silent or reads what no room has."""
        eventtime = self._reactor.monotonic()
        until_s = eventtime + FRESH_S
        age_s, temp_c = self.heater.reading(eventtime)
        while not age_s < FRESH_S and eventtime < until_s:  # just started: the first reading is on its way
            eventtime = self._reactor.pause(eventtime + WAIT_S)
            age_s, temp_c = self.heater.reading(eventtime)
        if not age_s < FRESH_S or not math.isfinite(temp_c):
            raise gcmd.error(
                f"{self.what}: heater '{self.heater.name}' has no fresh reading; check its temperature sensor"
            )
        if temp_c < SENSOR_MIN_C:
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

    def start(self, run: Run, done: Callable[[], None], each: Callable[[float], None] | None = None) -> None:
        """Acquire the heater; `done` when the run is over, the heater off and released; `each` at each poll before."""
        if self.gcode.get_handler("ABORT") is not None:
            raise self.printer.command_error("Another calibration is running; ABORT ends it")
        self.heater.acquire(run)
        self._run, self._done, self._each = run, done, each or self._each
        self.active = True
        self.gcode.register_command("ABORT", self._cmd_abort, desc="End the calibration")
        self._reported_s = self._received_s = self._reactor.monotonic()
        self._timer = self._reactor.register_timer(self._on_timer, self._reactor.NOW)
        self._prompt(
            f"begin {self.what} of {self.heater.name}",
            "text The heater gets hot by itself. Abort switches it off.",
            "footer_button Abort|ABORT|error",
            "show",
        )

    def _prompt(self, *actions: str) -> None:
        """A dialog in front ends that know them."""
        for action in actions:
            self.gcode.respond_raw(f"// action:prompt_{action}")

    def wait(self) -> None:
        """Wait until the calibration is over and fitted. Whatever else ends the wait ends the calibration, too."""
        waits = self.gcode.waits
        try:
            with waits.ended_by("ABORT"):
                while self.active and not self.printer.is_shutdown():
                    waits.sleep(self._reactor.monotonic() + WAIT_S, f"the end of {self.what}")
        except ScriptEnded as e:
            if e.by != "ABORT":  # that comes itself
                self._abort()
            raise

    def say(self, text: str) -> None:
        self.gcode.respond_info(text)

    def _cmd_abort(self, gcmd: GCodeCommand) -> None:
        self._abort()

    def _abort(self) -> None:
        if self._run is not None:
            self._run.abort(ABORTED)
            return
        self._is_aborted = True
        if self._fit is not None:
            self._fit.kill()

    def _on_timer(self, eventtime: float) -> float:
        run = self._run
        if run is None:
            return float(self._reactor.NEVER)
        if self.printer.is_shutdown():
            run.abort("the printer stopped")
        age_s, temp_c = self.heater.reading(eventtime)
        if age_s < FRESH_S:
            self._received_s = eventtime
        elif eventtime - self._received_s > run.timeout_s:
            run.abort(f"no reading for {run.timeout_s:.0f} s")
        if not run.over:
            if self.induction:
                self.heater.follow_run()
            self._each(eventtime)
        if run.over:
            self._finish()
            return float(self._reactor.NEVER)
        if eventtime - self._reported_s >= run.progress_s:
            self._reported_s = eventtime
            self.say(f"{self.what}: {run.progress(temp_c)}")
        return eventtime + run.poll_s

    def _finish(self) -> None:
        self._reactor.unregister_timer(self._timer)
        self._timer = self._run = None
        if not self.printer.is_shutdown():
            self.heater.release()
        try:
            self._done()
        finally:
            if not self._is_fitting:
                self._end()

    def _end(self) -> None:
        self.gcode.register_command("ABORT", None)
        self.active = False
        self._prompt("end")

    # What becomes of the recording

    def write_trace(self, run: Run, where: object, opened: Callable[[], Any], more: str = "") -> Path | None:
        """The run's trace to the file that `opened` makes; None, and people know why, if that cannot be."""
        try:
            with opened() as stream:
                run.write(stream)
        except (OSError, output_file.OutputError) as e:
            logging.warning("%s: %s: %s", self.what, where, e)
            self.say(f"The trace cannot be written to {where}: {getattr(e, 'strerror', None) or e}{more}")
            return None
        return Path(stream.name)

    def fit(
        self, module: str, arguments: list[str], take: Callable[[dict[str, Any]], None], refused: str
    ) -> None:
        """Evaluate a trace with thermal/identification/`module` in a process of its own; `take` gets what it finds.

        `refused` begins the text for people if it finds nothing.
        """
        self._is_fitting = True
        command = [sys.executable, "-m", f"thermal.identification.{module}", *arguments]
        done = self._reactor.run_beside(partial(self._evaluate, command))
        self._reactor.register_callback(lambda eventtime: self._on_fit(done.wait(), take, refused))

    def _evaluate(self, command: list[str]) -> dict[str, Any]:
        """On a thread of its own."""
        pipe, command = subprocess.PIPE, util.at_ordinary_priority(command)
        self._fit = subprocess.Popen(command, cwd=HOST_FOLDER, stdout=pipe, stderr=pipe, text=True)
        output, errors = self._fit.communicate()
        if self._is_aborted or self._fit.returncode:
            lines = errors.strip().splitlines()
            why = lines[-1] if lines else f"status {self._fit.returncode}"
            raise RuntimeError(ABORTED if self._is_aborted else why)
        return dict(json.loads(output))

    def _on_fit(
        self, found: dict[str, Any] | Exception, take: Callable[[dict[str, Any]], None], refused: str
    ) -> None:
        try:
            if isinstance(found, Exception):
                self.say(f"{refused}: {found}. Nothing was changed.")
            else:
                take(found)
        finally:
            self._end()
