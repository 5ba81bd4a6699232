"""MODEL_CALIBRATE HEATER= [TARGET=] [POWER=] [AMBIENT=] [FAN=1] [FLOW=] [WAIT=]: the model of any heater, in minutes.

The run is thermal/identification/step_test.py, the fit thermal/identification/fit_load.py in a process of its own.
Ordinary heaters get `control: model` with its numbers, an induction nozzle its heat capacity and losses, and with
FLOW what the filament takes. The heater is off before and after, however that ends; a fit that does not predict the
segment it was not shown changes nothing.
"""

from __future__ import annotations

import tempfile
import time
from functools import partial
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.identification import step_test

from .heater import run as heater_run
from .heater import tuning as heater_tuning

WARM_C = 45.0  # a heater hotter than this has not cooled down yet
MIN_RISE_C = 30.0
MARGIN_C = 10.0  # of the default target below max_temp
USUAL_C = {"heater_bed": 80.0}
NOZZLE_POWER_W = 30.0
EVEN_C = 5.0  # 6 W/K; off and on would leave the thermometer without a reading at each peak
MELT_C = 230.0  # usual for the steps with filament ...
COOLER_C, COOLER_MIN_C = 45.0, 20.0  # ... and how far below it the second temperature is
EXTRUDE_MARGIN_C = 5.0  # above min_extrude_temp at least
AIR_MM = 20.0  # below the nozzle, for filament to come out
PIECE_S, PIECE_AHEAD_S = (
    5.0,
    0.4,
)  # time of a feeding move: ABORT ends it soon, and few joints disturb it
MIN_POWER_W = 1.0  # no heater of a printer is weaker


class ModelCalibrate:
    """The command; one run at a time."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._reactor = printer.get_reactor()
        self._fan = self._flow = self._users_fan = 0.0
        self._fed_stage = ""
        self._fed_until_s = self._feed_end_s = 0.0

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "MODEL_CALIBRATE", self.cmd_MODEL_CALIBRATE, desc="Measure a heater's thermal model"
        )

    def cmd_MODEL_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        heater_run.need_fit(gcmd)
        heater = heater_tuning.heater_of(self.printer, gcmd, sole_nozzle=True)
        runner = heater_run.Runner(self.printer, heater, "MODEL_CALIBRATE")
        now_c = runner.check_sensor(gcmd)
        if now_c > WARM_C:
            raise gcmd.error(
                f"MODEL_CALIBRATE: heater '{heater.name}' is at {now_c:.0f} C. The run begins cold, at the"
                " temperature of the room; let it cool down"
            )
        ambient_c = gcmd.get_float("AMBIENT", now_c, minval=-20.0, maxval=60.0)
        flow_mm3_s = gcmd.get_float("FLOW", 0.0, minval=0.0, maxval=50.0)
        usual_c = MELT_C if runner.induction and flow_mm3_s else 200.0
        usual_c = min(USUAL_C.get(heater.name, usual_c), heater.max_temp - MARGIN_C)
        target_c = gcmd.get_float(
            "TARGET", usual_c, minval=round(now_c + MIN_RISE_C, 1), maxval=heater.max_temp
        )
        power_w = self._power(gcmd, runner)
        plan = self._plan(gcmd, runner, target_c, flow_mm3_s)
        feeding = self._check_flow(gcmd, runner, plan)
        run = step_test.StepTest(plan, now_c)
        wait = gcmd.get_int("WAIT", 0)
        self._fan, self._flow, self._fed_stage = 0.0, 0.0, ""
        runner.start(run, lambda: self._finish(runner, run, power_w, ambient_c), partial(self._surround, run))
        runner.say(f"MODEL_CALIBRATE: heater '{heater.name}' up to {target_c:.0f} C{feeding}; ABORT ends it")
        self._begin_fan(runner, plan.fan_s > 0.0)
        if wait:
            runner.wait()

    def _power(self, gcmd: GCodeCommand, runner: heater_run.Runner) -> float:
        """W at full output."""
        if runner.induction:
            return float(runner.heater.output_max)
        written = heater_tuning.options_of(runner.heater).get("heater_power_w")
        default = float(written) if written is not None else 0.0
        power_w = gcmd.get_float("POWER", default, minval=0.0)
        if power_w < MIN_POWER_W:
            raise gcmd.error(
                "MODEL_CALIBRATE: the heater's power at full duty is needed once: POWER= in watts (voltage squared over"
                " resistance)"
            )
        return float(power_w)

    def _plan(
        self, gcmd: GCodeCommand, runner: heater_run.Runner, target_c: float, flow: float
    ) -> step_test.StepTestPlan:
        fan = self.printer.lookup_object("fan", None) is not None and gcmd.get_int("FAN", 0)
        if runner.induction:
            cool_c = max(target_c - COOLER_C, runner.heater.min_extrude_temp + EXTRUDE_MARGIN_C)
            return step_test.StepTestPlan(
                target_c=target_c,
                high=min(runner.heater.output_max, NOZZLE_POWER_W),
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
        return step_test.StepTestPlan(
            target_c=target_c,
            high=runner.heater.output_max,
            band_c=0.5,
            delay_s=runner.heater.get_pwm_delay(),
            hold_s=60.0,
            cool_s=60.0,
            coast_s=30.0,
            fan_s=45.0 if fan else 0.0,
            flow_s=30.0 if flow else 0.0,
            flow_mm3_s=flow,
            lost_c=runner.heater.max_temp - target_c + 20.0,
        )

    def _check_flow(self, gcmd: GCodeCommand, runner: heater_run.Runner, plan: step_test.StepTestPlan) -> str:
        """What would spoil the steps with filament, before anything is heated; the text that names them."""
        steps = [(step.target_c, step.flow_mm3_s, step.lasts_s) for step in plan.further]
        if plan.flow_s:
            steps.append((plan.target_c, plan.flow_mm3_s, plan.flow_s))
        fastest = max((flow for _, flow, _ in steps), default=0.0)
        if not fastest:
            return ""
        extruder, heater = self.printer.lookup_object("toolhead").get_extruder(), runner.heater
        needed_c = heater.min_extrude_temp
        if extruder.get_name() != heater.name:
            raise gcmd.error(f"MODEL_CALIBRATE: FLOW needs the extruder of heater '{heater.name}' in use")
        span_c = COOLER_MIN_C if plan.further else 0.0
        lowest_c = needed_c + EXTRUDE_MARGIN_C + span_c
        if plan.target_c < lowest_c:
            raise gcmd.error(
                f"MODEL_CALIBRATE: with FLOW the TARGET must be {lowest_c:.0f} C at least: filament is fed at it"
                + (f" and at {span_c:.0f} C less" if span_c else "")
                + f", and min_extrude_temp is {needed_c:.0f} C"
            )
        max_flow = extruder.max_e_velocity * extruder.filament_area
        if fastest > max_flow:
            raise gcmd.error(
                f"MODEL_CALIBRATE: max_extrude_only_velocity of [extruder] allows FLOW={max_flow:.1f} at most"
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

    def _begin_fan(self, runner: heater_run.Runner, measured: bool) -> None:
        """A run with a fan step begins with the fan off; what the user has set comes back after it."""
        part = self.printer.lookup_object("fan", None)
        self._users_fan = 0.0
        if part is None or not part.fan.last_fan_value:
            return
        if measured:
            self._users_fan = part.fan.last_fan_value / part.fan.settings.max_power
            part.fan.set_speed(0.0)
        else:
            runner.say(
                "The part fan is on: its cooling will count as the heater's own loss. FAN=1 measures it separately"
            )

    def _surround(self, run: step_test.StepTest, now_s: float) -> None:
        """Fan and extruder as the run wants them."""
        if run.fan != self._fan:
            self._fan = run.fan
            self.printer.lookup_object("fan").fan.set_speed(run.fan)
        if run.stage != self._fed_stage:
            self._fed_stage, self._flow = run.stage, run.flow_mm3_s
            self._fed_until_s, self._feed_end_s = now_s, now_s + run.lasts_s()
        if self._flow and self._fed_until_s - PIECE_AHEAD_S <= now_s < self._feed_end_s - PIECE_AHEAD_S:
            try:
                self._fed_until_s += self._extrude(self._feed_end_s - self._fed_until_s)
            except self.printer.command_error as e:
                run.abort(f"the extruder says: {e}")

    def _extrude(self, lasts_s: float) -> float:
        """Feed for this time, or for the longest time of one move; returns the time, s."""
        toolhead = self.printer.lookup_object("toolhead")
        extruder = toolhead.get_extruder()
        speed_mm_s = self._flow / extruder.filament_area
        length_mm = min(min(PIECE_S, lasts_s) * speed_mm_s, extruder.max_e_dist)
        toolhead.manual_move([None, None, None, toolhead.get_position()[3] + length_mm], speed_mm_s)
        return float(length_mm / speed_mm_s)

    def _finish(
        self, runner: heater_run.Runner, run: step_test.StepTest, power_w: float, ambient_c: float
    ) -> None:
        if (self._fan or self._users_fan) and not self.printer.is_shutdown():
            self.printer.lookup_object("fan").fan.set_speed(self._users_fan)
        if run.stage != "done":
            runner.say(f"MODEL_CALIBRATE ended: {run.fault}. Nothing was changed.")
            return
        folder, begin = tempfile.gettempdir(), f"model-{runner.heater.name}-{time.strftime('%Y%m%d-%H%M%S')}-"
        options = {"newline": "", "encoding": "utf-8", "prefix": begin, "suffix": ".csv", "delete": False}
        path = runner.write_trace(
            run, folder, partial(tempfile.NamedTemporaryFile, "w", **options), ". Nothing was changed."
        )
        if path is None:
            return
        runner.say("The run is over. Fitting ...")
        arguments = [str(path), "--power", f"{power_w:g}", "--ambient", f"{ambient_c:.2f}"]
        arguments += ["--nozzle"] if runner.induction else []
        refused = "MODEL_CALIBRATE: the run cannot be used"
        runner.fit("fit_load", arguments, partial(self._take, runner), refused)

    def _take(self, runner: heater_run.Runner, result: dict[str, Any]) -> None:
        """Use a fit's result from now on, and offer it to SAVE_CONFIG."""
        texts = {name: heater_tuning.NUMBER.format(value) for name, value in result["options"].items()}
        tuning = heater_tuning.Tuning(control="model", **texts)
        heater = runner.heater
        try:
            heater_tuning.use(self.printer, heater, tuning)
        except self.printer.command_error as e:
            runner.say(f"MODEL_CALIBRATE: {e}. Nothing was changed.")
            return
        heater_tuning.stage(self.printer, heater, tuning)
        runner.say(
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
