"""MODEL_CALIBRATE HEATER= [TARGET=] [POWER=] [AMBIENT=] [FAN=1] [FLOW=] [WAIT=]: the model of any heater, in minutes.

The run is thermal/drill.py, the fit thermal/fit_load.py in a process of its own. Ordinary heaters get `control: model`
with its numbers, an induction nozzle its heat capacity and losses. The heater is off before and after, however that
ends; a fit that does not predict the segment it was not shown changes nothing.
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

from thermal import drill

from . import heater_run, heater_tuning

HOST_FOLDER = Path(__file__).resolve().parents[1]
WARM_C = 45.0  # a heater hotter than this has not cooled down yet
LEAST_RISE_C = 30.0
MARGIN_C = 10.0  # of the default target below max_temp
USUAL_C = {"heater_bed": 80.0}
NOZZLE_POWER_W = 30.0
LEAST_POWER_W = 1.0  # no heater of a printer is weaker


class ModelCalibrate:
    """The command; one run at a time."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self._reactor = printer.get_reactor()
        self._fitting = False
        self._fan = self._flow = 0.0

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "MODEL_CALIBRATE", self.cmd_MODEL_CALIBRATE, desc="Measure a heater's thermal model"
        )

    def cmd_MODEL_CALIBRATE(self, gcmd: Any) -> None:
        if self._fitting:
            raise gcmd.error("The last calibration is still being fitted")
        heater = heater_tuning.heater_of(self.printer, gcmd)
        session = heater_run.Session(self.printer, heater, "MODEL_CALIBRATE")
        now_c = session.check_sensor(gcmd)
        if now_c > WARM_C:
            raise gcmd.error(
                f"MODEL_CALIBRATE: heater '{heater.name}' is at {now_c:.0f} C. The run begins cold, at the"
                " temperature of the room; let it cool down"
            )
        ambient_c = gcmd.get_float("AMBIENT", now_c, minval=-20.0, maxval=60.0)
        usual_c = min(USUAL_C.get(heater.name, 200.0), heater.max_temp - MARGIN_C)
        target_c = gcmd.get_float(
            "TARGET", usual_c, minval=round(now_c + LEAST_RISE_C, 1), maxval=heater.max_temp
        )
        power_w = self._power(gcmd, session)
        plan = self._plan(gcmd, session, target_c)
        run = drill.Drill(plan, now_c)
        wait = gcmd.get_int("WAIT", 0)
        self._fan = self._flow = 0.0
        session.start(
            run, lambda: self._finish(session, run, power_w, ambient_c), lambda: self._surround(run)
        )
        session.say(f"MODEL_CALIBRATE: heater '{heater.name}' up to {target_c:.0f} C; ABORT ends it")
        if wait:
            session.wait()
            eventtime = self._reactor.monotonic()
            while self._fitting and not self.printer.is_shutdown():
                eventtime = self._reactor.pause(eventtime + heater_run.POLL_S)

    def _power(self, gcmd: Any, session: heater_run.Session) -> float:
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

    def _plan(self, gcmd: Any, session: heater_run.Session, target_c: float) -> drill.DrillPlan:
        fan = self.printer.lookup_object("fan", None) is not None and gcmd.get_int("FAN", 0)
        flow = gcmd.get_float("FLOW", 0.0, minval=0.0, maxval=50.0)
        if session.induction:
            return drill.DrillPlan(
                target_c=target_c,
                high=min(session.seat.most, NOZZLE_POWER_W),
                band_c=1.0,
                delay_s=0.0,
                hold_s=25.0,
                cool_s=30.0,
                coast_s=10.0,
                heat_s=30.0,
                gain_s=5.0,
                lost_c=60.0,
            )
        return drill.DrillPlan(
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

    def _surround(self, run: drill.Drill) -> None:
        """Fan and extruder as the run wants them."""
        if run.fan != self._fan:
            self._fan = run.fan
            self.printer.lookup_object("fan").fan.set_speed(run.fan)
        if run.flow_mm3_s != self._flow:
            self._flow = run.flow_mm3_s
            if self._flow:
                self._extrude(self._flow * run.plan.flow_s)

    def _extrude(self, volume_mm3: float) -> None:
        toolhead = self.printer.lookup_object("toolhead")
        area_mm2 = toolhead.get_extruder().filament_area
        position = list(toolhead.get_position())
        position[3] += volume_mm3 / area_mm2
        toolhead.manual_move([None, None, None, position[3]], self._flow / area_mm2)

    def _finish(
        self, session: heater_run.Session, run: drill.Drill, power_w: float, ambient_c: float
    ) -> None:
        if self._fan and not self.printer.is_shutdown():
            self._fan = 0.0
            self.printer.lookup_object("fan").fan.set_speed(0.0)
        if run.stage != "done":
            session.say(f"MODEL_CALIBRATE ended: {run.fault}. Nothing was changed.")
            return
        path = self._keep(session, run)
        if path is None:
            return
        session.say("The run is over. Fitting ...")
        command = [sys.executable, "-m", "thermal.fit_load", str(path)]
        command += ["--power", f"{power_w:g}", "--ambient", f"{ambient_c:.2f}"]
        command += ["--nozzle"] if session.induction else []
        self._fitting = True
        work = partial(subprocess.run, command, cwd=HOST_FOLDER, capture_output=True, text=True, check=False)
        done = self._reactor.run_beside(work)
        self._reactor.register_callback(lambda eventtime: self._on_fit(session, done.wait()))

    def _keep(self, session: heater_run.Session, run: drill.Drill) -> Path | None:
        """Write the trace where the fit (and people) find it."""
        name = f"model-{session.heater.name}-{time.strftime('%Y%m%d-%H%M%S')}.csv"
        path = Path(tempfile.gettempdir()) / name
        try:
            with path.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.writer(stream)
                writer.writerow(drill.Row._fields)
                writer.writerows(run.rows)
        except OSError as e:
            logging.warning("MODEL_CALIBRATE: %s: %s", path, e)
            session.say(f"The trace cannot be written to {path}: {e.strerror}. Nothing was changed.")
            return None
        return path

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
            + "\nIt is in use. SAVE_CONFIG keeps it and restarts the printer."
        )


def load_config(config: Any) -> ModelCalibrate:
    command = ModelCalibrate(config.get_printer())
    command.register()
    return command
