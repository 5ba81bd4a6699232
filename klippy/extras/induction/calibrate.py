"""Commands around the thermometer of an [induction_heater].

INDUCTION_CALIBRATE, INDUCTION_REFERENCE, INDUCTION_STATUS, INDUCTION_ZERO. The run is
thermal/identification/sweep.py, its evaluation thermal/identification/fit_sweep.py; here are the reference sensor and
what becomes of the result.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gcode import GCodeCommand
from roles import Printer
from thermal.drift import correction as drift
from thermal.identification import sweep
from thermal.models import heat_loss
from thermal.sensing import heat_balance_monitor, laws, temperature_filter
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS

from ..heater import run as heater_run
from ..heater import tuning as heater_tuning
from ..outputs import output_file
from . import settings

MANUAL_SILENCE_S = 60.0  # a person types readings: patience with the next one
SAME_S = 0.5  # a reading that does not change is taken again after this
ZERO_LIMIT_C = 60.0
LOSS_UNCERTAINTY = 0.03  # of a calibrated two-node model


class InductionCalibrate:
    """One heater's commands; one run at a time."""

    def __init__(self, printer: Printer, heater: Any, folder: str) -> None:
        self.printer = printer
        self.heater = heater
        self.folder = Path(folder).expanduser()
        self.gcode = printer.lookup_object("gcode")
        self._reactor = printer.get_reactor()
        self._run: sweep.Sweep | None = None
        self._reference: Any = None  # object with get_temp, None: manual
        self._seen = (-1e9, 0.0)  # (time, reading) taken last

    def register(self) -> None:
        commands = (
            ("INDUCTION_CALIBRATE", self.cmd_calibrate, "Calibrate the nozzle thermometer"),
            ("INDUCTION_STATUS", self.cmd_status, "State of the nozzle thermometer"),
            ("INDUCTION_ZERO", self.cmd_zero, "Correct the thermometer at one known temperature"),
            ("INDUCTION_REFERENCE", self.cmd_reference, "Enter a manual reference reading"),
        )
        heater_tuning.register_commands(self.printer, self.heater, commands)

    def _say(self, text: str) -> None:
        self.gcode.respond_info(text)

    # The run

    def cmd_calibrate(self, gcmd: GCodeCommand) -> None:
        reference = gcmd.get("REFERENCE", "manual")
        heater_run.need_fit(gcmd)
        parameters = self.heater.parameters
        limit_c = gcmd.get_float(
            "TEMP_MAX", min(350.0, self.heater.max_temp - 10.0), above=120.0, maxval=500.0
        )
        gain = gcmd.get_float("GAIN", 1.0, minval=0.5, maxval=1.5)
        sensor = self._find_reference(gcmd, reference)
        plan = sweep.SweepParameters(
            parameters.front,
            parameters.actuator.law,
            limit_c,
            heat_w=gcmd.get_float("POWER", 14.0, minval=6.0, maxval=30.0),
            heat_s=gcmd.get_float("HEAT_TIME", 90.0, minval=10.0, maxval=600.0),
            cool_s=gcmd.get_float("COOL_TIME", 75.0, minval=10.0, maxval=600.0),
            phase_low_ticks=parameters.estimator.phase_low_ticks,
            lag_s=gcmd.get_float("LAG", 1.5, minval=0.0, maxval=10.0),
            lead_s=parameters.timing.lead_s,
            reference_s=3.0 if sensor is not None else MANUAL_SILENCE_S,
            contact_s=6.0 if sensor is not None else MANUAL_SILENCE_S,
        )
        wait = gcmd.get_int("WAIT", 0)
        run = sweep.Sweep(plan, self.heater.now_s())
        runner = heater_run.Runner(self.printer, self.heater, "calibration")
        runner.start(run, lambda: self._finish(runner, run, gain), partial(self._read, run))
        self._run, self._reference, self._seen = run, sensor, (-1e9, 0.0)
        self.heater.stopped.sensor = sensor
        against = "readings you enter by INDUCTION_REFERENCE" if sensor is None else reference
        self._say(
            f"Calibrating '{self.heater.section_name}' up to {limit_c:.0f} C against {against}; ABORT ends it."
        )
        if wait:
            runner.wait()

    def _find_reference(self, gcmd: GCodeCommand, name: str) -> Any:
        if name == "manual":
            return None
        for prefix in ("temperature_sensor ", "heater_generic ", ""):
            found = self.printer.lookup_object(prefix + name, None)
            if found is not None and found is not self.heater:
                return found
        known = [
            full.split()[-1]
            for full, _ in self.printer.lookup_objects()
            if full.startswith("temperature_sensor ")
        ]
        raise gcmd.error(
            f"There is no temperature sensor '{name}' to calibrate against (known: {', '.join(known) or 'none'};"
            " or REFERENCE=manual)"
        )

    def cmd_reference(self, gcmd: GCodeCommand) -> None:
        """REFERENCE=manual: what an instrument of one's own shows now."""
        if self._run is None or self._reference is not None:
            raise gcmd.error("INDUCTION_REFERENCE is for a calibration with REFERENCE=manual")
        temp_c = gcmd.get_float("TEMP", minval=-20.0, maxval=600.0)
        self._run.reference(self.heater.now_s(), temp_c)
        if not self.heater.shown.is_calibrated:  # a law in force is quicker than a person
            self.heater.show_reference(temp_c)

    def _read(self, run: sweep.Sweep, eventtime: float) -> None:
        """The reference sensor, when it has something new."""
        if self._reference is None:
            return
        now_s, reading = self.heater.now_s(), self._reference.get_temp(eventtime)[0]
        if reading and (reading != self._seen[1] or now_s - self._seen[0] >= SAME_S):
            self._seen = (now_s, reading)
            run.reference(now_s, reading)
            self.heater.show_reference(reading)

    def _finish(self, runner: heater_run.Runner, run: sweep.Sweep, gain: float) -> None:
        """Trace kept, and if the run went well the evaluation."""
        self._run = None
        name = f"induction-{self.heater.section_name}-{time.strftime('%Y%m%d-%H%M%S')}.csv"
        path = runner.write_trace(run, self.folder, partial(output_file.open_new, self.folder, name))
        if run.fault:
            self._say(f"Calibration ended: {run.fault}. Nothing was changed. Trace: {path or 'not written'}")
        elif path is not None:
            self._say(f"The run is over. Fitting {path} ...")
            drive = self.heater.parameters.actuator.law
            arguments = [str(path), "--gain", str(gain), "--power-full", str(drive.power_max_w)]
            arguments += ["--exponent", str(drive.exponent)]
            refused = "The calibration run cannot be evaluated"
            runner.fit("fit_sweep", arguments, self._take, refused)

    def _take(self, result: dict[str, Any]) -> None:
        """Use a fit's result from now on, and offer it to SAVE_CONFIG."""
        rows = result["table"]
        table = laws.LawTable.of_rows(rows) if rows else None
        law = laws.law_of(result["law"], result["coefficients"], result["residual_units"], table)
        self._apply(law, result)
        self._stage(law, result)
        self._say("\n".join(result["report"]))
        self._say(
            "The new law is in use. SAVE_CONFIG keeps it; until then the firmware guards by the limits of the old one."
        )

    def _apply(self, law: laws.Law, result: dict[str, Any]) -> None:
        old = self.heater.parameters
        heat = heat_loss.HeatCapacity(result["capacity_j_k"])
        low_ticks = result["phase_low_ticks"]
        factor, ambient_c = result["loss_factor"], result["ambient_c"]
        base = heat_loss.LossLaw()
        loss = heat_loss.LossLaw(base.conductance_w_k * factor, base.radiation_m2 * factor, ambient_c)
        two_nodes = heat_balance_monitor.scaled(factor, ambient_c, result["second_factor"])
        self.heater.use(
            replace(
                old,
                estimator=replace(old.estimator, law=law, phase_low_ticks=low_ticks),
                actuator=replace(old.actuator, phase_low_ticks=low_ticks),
                supervise=replace(old.supervise, calibrated=True),
                loss=loss,
                approach=settings.approach_for(law, old.actuator.law),
                filter=temperature_filter.FilterParameters(loss, heat),
                heat_balance=replace(
                    old.heat_balance, heat=heat, loss=two_nodes, loss_uncertainty=LOSS_UNCERTAINTY
                ),
            )
        )
        self.heater.loop.restart_filter()

    def _stage(self, law: laws.Law, result: dict[str, Any] | None) -> None:
        """Put the values where SAVE_CONFIG finds them."""
        name, values = laws.coefficients_of(law)
        options = {"estimator": name, **{f"{name}_{key}": f"{value:.7g}" for key, value in values.items()}}
        options["law_residual"] = f"{law.residual_units:.3g}"
        if result is not None:
            rows = result["table"] or ()
            options["tank_table"] = "".join("\n" + ", ".join(f"{value:.6g}" for value in row) for row in rows)
            more = {
                "heat_capacity_j_per_k": result["capacity_j_k"],
                "loss_factor": result["loss_factor"],
                "second_mass_factor": result["second_factor"],
                "ambient_temp": result["ambient_c"],
                "loss_uncertainty": LOSS_UNCERTAINTY,
            }
            options |= {key: f"{value:.4g}" for key, value in more.items()}
            if result["phase_low_ticks"] != SENSING_PHASE_TICKS:
                options["sensing_phase"] = str(result["phase_low_ticks"])
        heater_tuning.stage(self.printer, self.heater, heater_tuning.Tuning(options))

    # One point, and a look

    def cmd_zero(self, gcmd: GCodeCommand) -> None:
        """The nozzle is at TEMP now: move the law's drifting number so that it says so."""
        temp_c = gcmd.get_float("TEMP", minval=-20.0, maxval=600.0)
        parameters, state = self.heater.parameters, self.heater.loop.state
        news = state.estimate
        if not news.valid or self.heater.now_s() - news.time_s > 2.0:
            raise gcmd.error("INDUCTION_ZERO: there is no valid reading to correct")
        shift_c = temp_c - news.temp_c
        if abs(shift_c) > ZERO_LIMIT_C:
            raise gcmd.error(
                f"INDUCTION_ZERO: the reading is {news.temp_c:.1f} C, {abs(shift_c):.0f} C off; that is no drift."
                " Run INDUCTION_CALIBRATE"
            )
        law, supply = parameters.estimator.law, parameters.estimator.supply
        used = drift.corrected(parameters.estimator, state.drift.applied_c).law
        error = used.error(news.temp_c, news.phase_ticks, supply)
        law = law.rezeroed(temp_c, error, news.phase_ticks, supply)
        self.heater.use(replace(parameters, estimator=replace(parameters.estimator, law=law)))
        self.heater.loop.restart_filter()
        self._stage(law, None)
        gcmd.respond_info(f"Thermometer moved by {shift_c:+.1f} C, now {temp_c:.1f} C. SAVE_CONFIG keeps it.")

    def cmd_status(self, gcmd: GCodeCommand) -> None:
        status = self.heater.get_detail(self._reactor.monotonic())
        parameters = self.heater.parameters
        name, values = laws.coefficients_of(parameters.estimator.law)
        noise = self.heater.loop.chain.noise_lsb()
        lines = [
            f"Induction heater '{self.heater.section_name}': law {name}"
            + ("" if parameters.supervise.calibrated else " (NOT CALIBRATED)"),
            "  " + ", ".join(f"{key}={value:.6g}" for key, value in values.items()),
            f"  temperature {_or_unknown(status['estimate'], 'C')}, 1 sigma {_or_unknown(status['sigma'], 'C')},"
            f" latency {status['latency']} s",
            f"  phase {status['phase']} ticks, power {status['power_w']} W,"
            f" supply {100 * status['supply']:.1f} % of vdc_reference",
            f"  noise at the ADC {'unknown' if noise is None else f'{noise:.2f} LSB'},"
            f" blocks {status['blocks']}, lost {status['blocks_lost']}",
            f"  drift against the heat balance: {_or_unknown(status['drift'], 'C')},"
            f" heat capacity found: {_or_unknown(status['capacity_ratio'], 'times the configured one')}",
        ]
        said = dict.fromkeys([*self.heater.notices.read(), status["warning"]])
        lines += [f"  WARNING: {text}" for text in said if text]
        gcmd.respond_info("\n".join(lines))


def _or_unknown(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.2f} {unit}".strip()
