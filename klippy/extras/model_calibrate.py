"""MODEL_CALIBRATE HEATER= [TARGET=] [POWER=] [AMBIENT=] [FAN=1] [FLOW=] [WAIT=]: the model of any heater, in minutes.

The run is thermal/identification/step_test.py, the fit thermal/identification/fit_load.py in a process of its own.
Ordinary heaters get `control: model` with its numbers, an induction nozzle its heat capacity and losses, and with
FLOW what the filament takes. The heater is off before and after, however that ends; a fit that does not predict the
segment it was not shown changes nothing.
"""

from __future__ import annotations

import csv
import json
import logging
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.identification import step_test

from .heater import run as heater_run
from .heater import tuning as heater_tuning

HOST_FOLDER = Path(__file__).resolve().parents[1]
WARM_C = 45.0  # a heater hotter than this has not cooled down yet
LEAST_RISE_C = 30.0
MARGIN_C = 10.0  # of the default target below max_temp
USUAL_C = {"heater_bed": 80.0}
NOZZLE_POWER_W = 30.0
EVEN_C = 5.0  # 6 W/K; off and on would leave the thermometer without a reading at each peak
MELT_C = 230.0  # usual for the steps with filament ...
COOLER_C, COOLER_LEAST_C = 45.0, 20.0  # ... and the second temperature so much below it
EXTRUDE_MARGIN_C = 5.0  # above min_extrude_temp at least
AIR_MM = 20.0  # below the nozzle, for filament to come out
PIECE_S, PIECE_AHEAD_S = (
    5.0,
    0.4,
)  # filament is fed in moves of so long: ABORT ends it soon, and few joints disturb it
LEAST_POWER_W = 1.0  # no heater of a printer is weaker


class ModelCalibrate:
    """The command; one run at a time."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._reactor = printer.get_reactor()
        self._fitting = False
        self._fan = self._flow = self._users_fan = 0.0
        self._fed_stage = ""
        self._fed_until_s = self._feed_end_s = 0.0

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "MODEL_CALIBRATE", self.cmd_MODEL_CALIBRATE, desc="Measure a heater's thermal model"
        )

    def cmd_MODEL_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        if self._fitting:
            raise gcmd.error("The last calibration is still being fitted")
        heater_run.need_fit(gcmd)
        heater = heater_tuning.heater_of(self.printer, gcmd, sole_nozzle=True)
        session = heater_run.Session(self.printer, heater, "MODEL_CALIBRATE")
        now_c = session.check_sensor(gcmd)
        if now_c > WARM_C:
            raise gcmd.error(
                f"MODEL_CALIBRATE: heater '{heater.name}' is at {now_c:.0f} C. The run begins cold, at the"
                " temperature of the room; let it cool down"
            )
        ambient_c = gcmd.get_float("AMBIENT", now_c, minval=-20.0, maxval=60.0)
        flow_mm3_s = gcmd.get_float("FLOW", 0.0, minval=0.0, maxval=50.0)
        usual_c = MELT_C if session.induction and flow_mm3_s else 200.0
        usual_c = min(USUAL_C.get(heater.name, usual_c), heater.max_temp - MARGIN_C)
        target_c = gcmd.get_float(
            "TARGET", usual_c, minval=round(now_c + LEAST_RISE_C, 1), maxval=heater.max_temp
        )
        power_w = self._power(gcmd, session)
        plan = self._plan(gcmd, session, target_c, flow_mm3_s)
        told = self._check_flow(gcmd, session, plan)
        run = step_test.Drill(plan, now_c)
        wait = gcmd.get_int("WAIT", 0)
        self._fan, self._flow, self._fed_stage = 0.0, 0.0, ""
        session.start(
            run, lambda: self._finish(session, run, power_w, ambient_c), lambda: self._surround(run)
        )
        session.say(f"MODEL_CALIBRATE: heater '{heater.name}' up to {target_c:.0f} C{told}; ABORT ends it")
        self._begin_fan(session, plan.fan_s > 0.0)
        if wait:
            session.wait()
            eventtime = self._reactor.monotonic()
            while self._fitting and not self.printer.is_shutdown():
                eventtime = self._reactor.pause(eventtime + heater_run.POLL_S)

    def _power(self, gcmd: GCodeCommand, session: heater_run.Session) -> float:
        """W at full output."""
        if session.induction:
            return session.seat.most
        written = heater_tuning.options_of(session.heater).get("heater_power_w")
        default = float(written) if written is not None else 0.0
        power_w = gcmd.get_float("POWER", default, minval=0.0)
        if power_w < LEAST_POWER_W:
            raise gcmd.error(
                "MODEL_CALIBRATE: the heater's power at full duty is needed once: POWER= in watts (voltage squared over"
                " resistance)"
            )
        return float(power_w)

    def _plan(
        self, gcmd: GCodeCommand, session: heater_run.Session, target_c: float, flow: float
    ) -> step_test.DrillPlan:
        fan = self.printer.lookup_object("fan", None) is not None and gcmd.get_int("FAN", 0)
        if session.induction:
            cool_c = max(target_c - COOLER_C, heater_tuning.min_extrude_c(session.heater) + EXTRUDE_MARGIN_C)
            return step_test.DrillPlan(
                target_c=target_c,
                high=min(session.seat.most, NOZZLE_POWER_W),
                band_c=1.0,
                even_c=EVEN_C,
                delay_s=0.0,
                hold_s=25.0,
                cool_s=30.0,
                coast_s=10.0,
                heat_s=30.0,
                gain_s=5.0,
                lost_c=60.0,
                further=step_test.melt_steps(target_c, cool_c, flow) if flow else (),
            )
        return step_test.DrillPlan(
            target_c=target_c,
            high=session.seat.most,
            band_c=0.5,
            delay_s=session.heater.get_pwm_delay(),
            hold_s=60.0,
            cool_s=60.0,
            coast_s=30.0,
            fan_s=45.0 if fan else 0.0,
            flow_s=30.0 if flow else 0.0,
            flow_mm3_s=flow,
            lost_c=session.heater.max_temp - target_c + 20.0,
        )

    def _check_flow(self, gcmd: GCodeCommand, session: heater_run.Session, plan: step_test.DrillPlan) -> str:
        """What would spoil the steps with filament, before anything is heated; the text that tells of them."""
        steps = [(step.target_c, step.flow_mm3_s, step.lasts_s) for step in plan.further]
        if plan.flow_s:
            steps.append((plan.target_c, plan.flow_mm3_s, plan.flow_s))
        fastest = max((flow for _, flow, _ in steps), default=0.0)
        if not fastest:
            return ""
        extruder, heater = self.printer.lookup_object("toolhead").get_extruder(), session.heater
        needed_c = heater_tuning.min_extrude_c(heater)
        if extruder.get_name() != heater.name:
            raise gcmd.error(f"MODEL_CALIBRATE: FLOW needs the extruder of heater '{heater.name}' in use")
        span_c = COOLER_LEAST_C if plan.further else 0.0
        least_c = needed_c + EXTRUDE_MARGIN_C + span_c
        if plan.target_c < least_c:
            raise gcmd.error(
                f"MODEL_CALIBRATE: with FLOW the TARGET must be {least_c:.0f} C at least: filament is fed at it"
                + (f" and at {span_c:.0f} C less" if span_c else "")
                + f", and min_extrude_temp is {needed_c:.0f} C"
            )
        most = extruder.max_e_velocity * extruder.filament_area
        if fastest > most:
            raise gcmd.error(
                f"MODEL_CALIBRATE: max_extrude_only_velocity of [extruder] allows FLOW={most:.1f} at most"
            )
        height_mm = self.printer.lookup_object("toolhead").get_position()[2]
        homed = self.printer.lookup_object("toolhead").get_status(self._reactor.monotonic())["homed_axes"]
        if "z" in homed and height_mm < AIR_MM:
            raise gcmd.error(
                f"MODEL_CALIBRATE: FLOW needs {AIR_MM:g} mm of air below the nozzle, and it is at Z {height_mm:.1f};"
                f" move it up first, as with G1 Z{2.0 * AIR_MM:g}"
            )
        length_mm = sum(flow * lasts_s for _, flow, lasts_s in steps) / extruder.filament_area
        return f", with {length_mm:.0f} mm of filament fed on the way, {fastest:g} mm3/s at most"

    def _begin_fan(self, session: heater_run.Session, measured: bool) -> None:
        """A run with a fan step begins with the fan off; what the user has set comes back after it."""
        part = self.printer.lookup_object("fan", None)
        self._users_fan = 0.0
        if part is None or not part.fan.last_fan_value:
            return
        if measured:
            self._users_fan = part.fan.last_fan_value / part.fan.settings.max_power
            part.fan.set_speed(0.0)
        else:
            session.say(
                "The part fan is on, and what it takes will count as the heater's own loss; FAN=1 tells them apart"
            )

    def _surround(self, run: step_test.Drill) -> None:
        """Fan and extruder as the run wants them."""
        if run.fan != self._fan:
            self._fan = run.fan
            self.printer.lookup_object("fan").fan.set_speed(run.fan)
        now_s = self._reactor.monotonic()
        if run.stage != self._fed_stage:
            self._fed_stage, self._flow = run.stage, run.flow_mm3_s
            self._fed_until_s, self._feed_end_s = now_s, now_s + run.lasts_s()
        if self._flow and self._fed_until_s - PIECE_AHEAD_S <= now_s < self._feed_end_s - PIECE_AHEAD_S:
            try:
                self._fed_until_s += self._extrude(self._feed_end_s - self._fed_until_s)
            except self.printer.command_error as e:
                run.abort(f"the extruder says: {e}")

    def _extrude(self, lasts_s: float) -> float:
        """Feed for so long, or as long as one move may take; that time, s."""
        toolhead = self.printer.lookup_object("toolhead")
        extruder = toolhead.get_extruder()
        speed_mm_s = self._flow / extruder.filament_area
        length_mm = min(min(PIECE_S, lasts_s) * speed_mm_s, extruder.max_e_dist)
        toolhead.manual_move([None, None, None, toolhead.get_position()[3] + length_mm], speed_mm_s)
        return float(length_mm / speed_mm_s)

    def _finish(
        self, session: heater_run.Session, run: step_test.Drill, power_w: float, ambient_c: float
    ) -> None:
        if (self._fan or self._users_fan) and not self.printer.is_shutdown():
            self.printer.lookup_object("fan").fan.set_speed(self._users_fan)
        if run.stage != "done":
            session.say(f"MODEL_CALIBRATE ended: {run.fault}. Nothing was changed.")
            return
        path = self._keep(session, run)
        if path is None:
            return
        session.say("The run is over. Fitting ...")
        command = [sys.executable, "-m", "thermal.identification.fit_load", str(path)]
        command += ["--power", f"{power_w:g}", "--ambient", f"{ambient_c:.2f}"]
        command += ["--nozzle"] if session.induction else []
        self._fitting = True
        work = partial(subprocess.run, command, cwd=HOST_FOLDER, capture_output=True, text=True, check=False)
        done = self._reactor.run_beside(work)
        self._reactor.register_callback(lambda eventtime: self._on_fit(session, done.wait()))

    def _keep(self, session: heater_run.Session, run: step_test.Drill) -> Path | None:
        """Write the trace where the fit (and people) find it."""
        name, path = f"model-{session.heater.name}-{time.strftime('%Y%m%d-%H%M%S')}-", tempfile.gettempdir()
        try:
            with tempfile.NamedTemporaryFile(
                "w", newline="", encoding="utf-8", prefix=name, suffix=".csv", delete=False
            ) as stream:
                path = stream.name
                writer = csv.writer(stream)
                writer.writerow(step_test.Row._fields)
                writer.writerows(run.rows)
        except OSError as e:
            logging.warning("MODEL_CALIBRATE: %s: %s", path, e)
            session.say(f"The trace cannot be written to {path}: {e.strerror}. Nothing was changed.")
            return None
        return Path(path)

    def _on_fit(
        self, session: heater_run.Session, done: subprocess.CompletedProcess[str] | Exception
    ) -> None:
        self._fitting = False
        if isinstance(done, Exception):
            session.say(f"MODEL_CALIBRATE: the run cannot be evaluated: {done}. Nothing was changed.")
            return
        if done.returncode:
            errors = done.stderr.strip()
            why = errors.splitlines()[-1] if errors else f"status {done.returncode}"
            session.say(f"MODEL_CALIBRATE: the run cannot be used: {why}. Nothing was changed.")
            return
        result = json.loads(done.stdout)
        texts = {name: heater_tuning.NUMBER.format(value) for name, value in result["options"].items()}
        tuning = heater_tuning.Tuning(control="model", **texts)
        heater = session.heater
        try:
            heater_tuning.use(self.printer, heater, tuning)
        except self.printer.command_error as e:
            session.say(f"MODEL_CALIBRATE: {e}. Nothing was changed.")
            return
        heater_tuning.stage(self.printer, heater, tuning)
        session.say(
            f"Model of heater '{heater.name}':\n"
            + "\n".join(result["report"])
            + self._overruled(heater)
            + "\nIt is in use. SAVE_CONFIG keeps it and restarts the printer."
        )

    @staticmethod
    def _overruled(heater: Any) -> str:
        planner = getattr(heater, "planner", None)
        if planner is None or planner.settings.exchange_w_k is None:
            return ""
        return "\n[temperature_plan] has a melt_exchange of its own and goes by that; delete it there to use this one"


def load_config(config: ConfigWrapper) -> ModelCalibrate:
    command = ModelCalibrate(config.get_printer())
    command.register()
    return command
