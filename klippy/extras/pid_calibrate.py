"""PID_CALIBRATE HEATER= TARGET= [WRITE_FILE=] [WAIT=] [KEEP_LAW=pid]: a PID for any heater, from its swings around the
target.

The run and its evaluation are thermal/identification/relay.py. Ordinary heaters get pid_Kp, pid_Ki, pid_Kd (duty, per
255), induction nozzles pid_kp_w_per_k, pid_ki_w_per_k_s, pid_kd_w_s_per_k. They are in use at once; SAVE_CONFIG keeps
them. A nozzle with another law goes on with that, unless KEEP_LAW=pid asks for the change: predictive control holds it
many times better.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.control import pid
from thermal.identification import relay

from .heater import run as heater_run
from .heater import tuning as heater_tuning

TRACE = Path("/tmp/heattest.txt")  # where Klipper's users look for it
BAND_C, INDUCTION_BAND_C = 0.5, 1.0
MIN_ABOVE_C = 10.0
INDUCTION_SWING_C = 20.0  # a nozzle with 300 W swings so far beyond the target ...
# ... within a fraction of a second.
INDUCTION_TIMES = {"swing_s": 20.0, "heat_s": 60.0, "gain_s": 5.0, "lost_c": 60.0, "cycles": 12}


class PidCalibrate:
    """The command."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "PID_CALIBRATE",
            self.cmd_PID_CALIBRATE,
            desc="Find a heater's PID gains by swinging around TARGET",
        )

    def cmd_PID_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        heater = heater_tuning.heater_of(self.printer, gcmd)
        runner = heater_run.Runner(self.printer, heater, "PID_CALIBRATE")
        highest_c = heater.max_temp - (INDUCTION_SWING_C if runner.induction else 0.0)
        target_c = gcmd.get_float("TARGET", minval=heater.min_temp, maxval=highest_c)
        keep_law = gcmd.get("KEEP_LAW", "").lower()
        if keep_law not in ("", "pid"):
            raise gcmd.error(
                f"PID_CALIBRATE: KEEP_LAW={keep_law}: only 'pid' can come of it, or leave it out"
            )
        other = "" if keep_law or not runner.induction else _other_law(heater)
        now_c = runner.check_sensor(gcmd)
        if target_c < now_c + MIN_ABOVE_C:
            raise gcmd.error(
                f"PID_CALIBRATE: heater '{heater.name}' is at {now_c:.1f} C; TARGET must be {MIN_ABOVE_C:.0f} C above"
                " that, or the way there says nothing"
            )
        if runner.induction:
            plan = relay.RelayPlan(target_c, heater.output_max, INDUCTION_BAND_C, **INDUCTION_TIMES)  # type: ignore[arg-type]
        else:
            plan = relay.RelayPlan(
                target_c, heater.output_max, BAND_C, lost_c=heater.max_temp - target_c + 20.0
            )
        run = relay.RelayRun(plan)
        write = gcmd.get_int("WRITE_FILE", 0)
        wait = gcmd.get_int("WAIT", 1)
        runner.start(run, lambda: _finish(runner, run, bool(write), other))
        runner.say(f"PID_CALIBRATE: heater '{heater.name}' will swing around {target_c:.0f} C")
        if other:
            runner.say(_advice(heater, other))
        if wait:
            runner.wait()


def _finish(runner: heater_run.Runner, run: relay.RelayRun, write: bool, other: str) -> None:
    """`other`: the law that stays in use, "" if it is the PID from now on."""
    if write:
        runner.write_trace(run, TRACE, _open_trace)
    try:
        result = relay.evaluate(run)
    except relay.CalibrationError as e:
        runner.say(f"PID_CALIBRATE ended: {e}. Nothing was changed.")
        return
    heater = runner.heater
    tuning = _tuning(result, runner.induction)
    if not runner.induction:
        heater.set_control(heater_tuning.check(runner.printer, heater, tuning))
    elif other:
        del tuning["control"]  # the gains wait for it
    else:
        heater_tuning.use(runner.printer, heater, tuning)
    heater_tuning.stage(runner.printer, heater, tuning)
    unit = "W" if runner.induction else "of duty"
    gains = " ".join(f"{name}={value}" for name, value in tuning.items() if name != "control")
    runner.say(
        f"PID parameters: {gains}\n"
        f"  integrator {result.gain_per_s:.4g} +- {result.gain_sigma:.2g} C/s per {unit}, delay"
        f" {result.delay_s:.3g} +- {result.delay_sigma_s:.2g} s; swing {result.swing_c:.1f} C"
        f" in {result.period_s:.3g} s\n"
        + (
            f"SAVE_CONFIG keeps the gains, but they are not in use. {_advice(heater, other)}"
            if other
            else "The new gains are in use. SAVE_CONFIG keeps them and restarts the printer."
        )
    )


def _open_trace() -> TextIO:
    TRACE.unlink(missing_ok=True)  # a link or a pipe of that name is not opened
    return TRACE.open("x", encoding="utf-8")


def _other_law(heater: Any) -> str:
    """The law a nozzle works with, "" if that is a PID."""
    name = str(heater.parameters.control.law.name)
    return "" if name == "pid" else name


def _advice(heater: Any, law: str) -> str:
    better = (
        f" It holds the nozzle better than a PID can; MODEL_CALIBRATE HEATER={heater.name} measures what it needs."
        if law == "model"
        else ""
    )
    return (
        f"Heater '{heater.name}' stays with control: {law}.{better} PID_CALIBRATE with KEEP_LAW=pid changes the law to"
        " control: pid."
    )


def _tuning(result: relay.RelayResult, induction: bool) -> heater_tuning.Tuning:
    if induction:
        names, scale = ("pid_kp_w_per_k", "pid_ki_w_per_k_s", "pid_kd_w_s_per_k"), 1.0
    else:
        names, scale = ("pid_kp", "pid_ki", "pid_kd"), pid.PID_SCALE
    gains = (result.kp, result.ki, result.kd)
    values = {name: f"{scale * gain:.5g}" for name, gain in zip(names, gains, strict=True)}
    return heater_tuning.Tuning(control="pid", **values)


def load_config(config: ConfigWrapper) -> PidCalibrate:
    command = PidCalibrate(config.get_printer())
    command.register()
    return command
