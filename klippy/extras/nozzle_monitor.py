"""[nozzle_monitor]: is the hole narrowed, or filament lost? By the melt's heat and the extruder mount's vibration.

heater's loop ── each 0.1 s temperature, heat put in ──► thermal/sensing/flow_monitor.py ──┐
extruder ── filament fed ──────────────────────────┬─────▲                                 ├─► condition, diameter
accelerometer/mount.py (with accel_chip) ──────────┴──► vibration/mount_witness.py ────────┘
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.records import TempEstimate
from thermal.sensing import flow_monitor
from vibration import mount_witness, nozzle_condition

from .accelerometer import mount_calibrate, report
from .accelerometer.axes import axis_number
from .accelerometer.mount import MountVibration

HISTORY_ROWS = 2000
HISTORY_S = 30.0  # between rows while the condition stays
TRACE_ROWS, TRACE_S = 2880, 5.0  # four hours, for NOZZLE_REPORT's picture
NEW_FILAMENT_MM = 50.0  # from the farthest place: filament is changed
LAG_S = 0.06  # from the motor to the heat: compliance and the wall of the bore
CALIBRATED_SIGMA = 0.03  # of a saved gain: one spool and temperature to another
GOOD = (flow_monitor.CLEAR, flow_monitor.UNKNOWN)
MOUNTS = {"direct": (200.0, 20.0, 3.86), "bowden": (16.0, 10.0, 4.91)}  # Hz, quality, exponent: Tlegenov 2018


class FedFilament:
    """Filament that goes beyond its farthest place; what returns from a retraction is no flow."""

    def __init__(self) -> None:
        self._peak_mm = math.nan

    def since(self, extruder: Any, print_time: float) -> float:
        """mm3 since the call before."""
        place_mm = extruder.find_past_position(print_time)
        new_mm = place_mm - self._peak_mm
        if not abs(new_mm) < NEW_FILAMENT_MM:
            self._peak_mm = place_mm
            return 0.0
        self._peak_mm = max(self._peak_mm, place_mm)
        return float(max(0.0, new_mm) * extruder.filament_area)


class NozzleMonitor:
    """The object `nozzle_monitor`."""

    def __init__(
        self,
        printer: Printer,
        name: str,
        where: str,
        options: dict[str, Any],
        alarm: Any,
        vibration: MountVibration | None,
    ) -> None:
        self.printer = printer
        self.name, self._where = name, where
        self.history: deque[dict[str, Any]] = deque(maxlen=HISTORY_ROWS)
        self._trace: deque[tuple[Any, ...]] = deque(maxlen=TRACE_ROWS)  # time and report.COLUMNS
        self._options, self._alarm = options, alarm
        self._gcode = printer.lookup_object("gcode")
        self._reactor = printer.get_reactor()
        self._heater: Any = None
        self._extruder: Any = None
        self._parameters: flow_monitor.FlowMonitorParameters | None = None
        self._state: flow_monitor.FlowMonitorState | None = None
        self._fed = FedFilament()
        self._models: tuple[Any, ...] = ()
        self._vibration = vibration
        self._news = 0.0  # of the vibration, since the heat's last reading
        self._temp_c = math.nan
        self._condition = flow_monitor.UNKNOWN

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._on_connect)
        if self._vibration is not None:
            self.printer.register_event_handler("klippy:ready", self._vibration.start)
        for name, handler, text in (
            ("NOZZLE_REPORT", self.cmd_NOZZLE_REPORT, "Condition of the nozzle and of its feed"),
            (
                "NOZZLE_MONITOR_CALIBRATE",
                self.cmd_NOZZLE_MONITOR_CALIBRATE,
                "Keep the melt's heat as now measured",
            ),
        ):
            self._gcode.register_command(name, handler, desc=text)

    def _on_connect(self) -> None:
        section = self.printer.lookup_object(f"induction_heater {self.name}", None)
        if section is None or not section.heater.served_by:
            raise self.printer.config_error(
                f"Section [nozzle_monitor] ({self._where}): heater '{self.name}' must be an [induction_heater] that an"
                " extruder uses."
            )
        self._heater = section.heater
        self._extruder = self.printer.lookup_object(self._heater.served_by)
        self._heater.loop.on_balance = self._on_balance
        if self._vibration is not None:
            self._vibration.connect(self._where)
            fed = FedFilament()
            self._vibration.fed_mm3 = lambda print_time: fed.since(self._extruder, print_time)
            self._vibration.temp_c = lambda: self._temp_c
            self._vibration.on_step = self._on_vibration

    def _take_models(self) -> flow_monitor.FlowMonitorState:
        """The nozzle's models as they are now; another calibration starts anew."""
        p = self._heater.parameters
        models = (p.heat_balance.heat, p.heat_balance.loss, p.melt)
        if self._state is None or models != self._models:
            self._models = models
            self._parameters = flow_monitor.FlowMonitorParameters(*models, **self._options)
            self._state = flow_monitor.start(self._parameters)
        return self._state

    def _on_balance(self, news: TempEstimate, heat_j: float) -> None:
        state = self._take_models()
        p, balance = self._parameters, self._heater.loop.state.heat_balance
        assert p is not None
        planned_mm3 = self._fed.since(self._extruder, news.time_s - LAG_S)
        self._temp_c = news.temp_c
        reading = flow_monitor.HeatReading(
            news.time_s, news.temp_c, balance.second_c, balance.second_doubt_c, heat_j, planned_mm3,
            self._heater.loop.fan.at(news.time_s), self._news,
        )  # fmt: skip
        self._news = 0.0
        if flow_monitor.observe(p, state, reading):
            self._judge()

    def _on_vibration(self) -> None:
        """A step of that witness."""
        assert self._vibration is not None
        self._news += self._vibration.state.news
        self._judge()

    def _witnesses(self) -> tuple[nozzle_condition.Heat, nozzle_condition.Vibration]:
        vibration = self._vibration
        usable = vibration is not None and vibration.fault is None
        return (
            nozzle_condition.Heat(self._parameters, self._state),
            nozzle_condition.Vibration(vibration.parameters, vibration.state)
            if usable and vibration is not None
            else nozzle_condition.Vibration(),
        )

    def _judge(self) -> None:
        before, self._condition = self._condition, nozzle_condition.condition(*self._witnesses())
        self._note(self._condition)
        self._trace_now()
        if self._condition not in GOOD and before in GOOD:
            self._reactor.register_callback(self._on_alarm)

    def _note(self, condition: str) -> None:
        """One row when the condition changes, and now and then."""
        now_s = self._reactor.monotonic()
        last = self.history[-1] if self.history else None
        if last is None or last["condition"] != condition or now_s - last["t_s"] >= HISTORY_S:
            diameter_mm, sigma_mm = self._diameter()
            self.history.append(
                {"t_s": now_s, "condition": condition, "diameter_mm": diameter_mm, "sigma_mm": sigma_mm}
            )

    def _trace_now(self) -> None:
        """A row of what NOZZLE_REPORT draws."""
        now_s = self._reactor.monotonic()
        if self._trace and now_s - self._trace[-1][0] < TRACE_S:
            return
        status = self.get_status(now_s)
        names = ("condition", "diameter", "diameter_sigma", "lost_flow", "evidence")
        self._trace.append((now_s, *(status[name] for name in names)))

    def _diameter(self) -> tuple[float | None, float | None]:
        """mm, and its standard deviation."""
        _, vibration = self._witnesses()
        lost = self._condition not in GOOD and vibration.state is not None and not vibration.state.is_narrowed
        if lost or not vibration.judges or vibration.parameters is None or vibration.state is None:
            return None, None
        hole_mm = vibration.parameters.hole_mm * vibration.diameter_share()
        return round(hole_mm, 4), round(hole_mm * vibration.state.log_sigma, 4)

    def _on_alarm(self, eventtime: float) -> None:
        text = f"Nozzle monitor: {self._describe_alarm()}"
        logging.warning("%s", text)
        self._gcode.respond_info(text, log=False)
        if self._alarm is None:
            return
        try:
            self._gcode.run_script(self._alarm.render())
        except self.printer.command_error as e:
            self._gcode.respond_error(f"Nozzle monitor: alarm_gcode failed: {e}")

    def _describe_alarm(self) -> str:
        """What was seen, and what it may be."""
        _, vibration = self._witnesses()
        diameter_mm, _ = self._diameter()
        if vibration.judges and vibration.state is not None and vibration.state.is_narrowed:
            percent = 100.0 * (1.0 - vibration.diameter_share())
            return (
                f"the mount vibrates as with a hole of {diameter_mm:.2f} mm, {percent:.0f} % less than before: the"
                " nozzle is partly clogged, or too cold for this filament"
            )
        if self._state is not None and self._state.lost_share:
            percent = 100.0 * self._state.lost_share
            return (
                f"the melt takes {percent:.0f} % less heat than its planned flow needs: the filament ran"
                " out, the drive grinds it, or the nozzle is clogged"
            )
        percent = 100.0 * vibration.lost_share()
        return f"the mount vibrates as with {percent:.0f} % less flow: the filament ran out, or the drive grinds it"

    def get_status(self, eventtime: float) -> dict[str, Any]:
        p, state = self._parameters, self._state
        heat, vibration = self._witnesses()
        diameter_mm, sigma_mm = self._diameter()
        status: dict[str, Any] = {
            "condition": nozzle_condition.condition(heat, vibration),
            "diameter": diameter_mm,
            "diameter_sigma": sigma_mm,
            "lost_flow": None,
            "evidence": 0.0,
            "heat_gain": None,
            "heat_gain_sigma": None,
            "sensor_fault": self._vibration.fault if self._vibration is not None else None,
        }
        if vibration.judges and vibration.state is not None and vibration.parameters is not None:
            sums = max(vibration.state.narrowed, vibration.state.lost)
            status["evidence"] = round(sums / vibration.parameters.threshold, 3)
        if p is None or state is None:
            return status
        return status | {
            "lost_flow": None if heat.condition() == flow_monitor.UNKNOWN else round(state.lost_share, 3),
            "evidence": max(status["evidence"], round(state.evidence / p.threshold, 3)),
            "heat_gain": round(state.unknowns[0], 4),
            "heat_gain_sigma": round(math.sqrt(state.covariance[0][0]), 4),
        }

    def cmd_NOZZLE_REPORT(self, gcmd: GCodeCommand) -> None:
        status = self.get_status(self._reactor.monotonic())
        lines = [f"Nozzle: {status['condition']}"]
        if status["lost_flow"] is None:
            lines.append("Too little was extruded to say more, or the heater is not calibrated.")
        else:
            lines.append(f"Lost flow: {100.0 * status['lost_flow']:.0f} %")
            lines.append(f"Evidence of a change: {100.0 * status['evidence']:.0f} % of what an alarm needs")
            gain, sigma = status["heat_gain"], status["heat_gain_sigma"]
            lines.append(f"Heat of the melt: {gain:.3f} +- {sigma:.3f} of that of the model")
        if self._vibration is None:
            lines.append(
                "Diameter: not measured, this needs an accelerometer on the extruder's mount (accel_chip)"
            )
        elif self._vibration.fault is not None:
            lines.append(f"Diameter: not measured, the accelerometer is {self._vibration.fault}")
        elif status["diameter"] is None:
            lines.append("Diameter: not yet known")
        else:
            lines.append(f"Diameter: {status['diameter']:.3f} +- {status['diameter_sigma']:.3f} mm")
        if gcmd.get_int("PLOT", 0, minval=0, maxval=1):
            lines.append(report.write(self.printer, gcmd, self._trace))
        gcmd.respond_info("\n".join(lines))

    def cmd_NOZZLE_MONITOR_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """The nozzle is clear: find the mount's resonance, and keep the heat of what was extruded so far."""
        if self._vibration is not None:
            self._calibrate_vibration(gcmd, self._vibration)
        status = self.get_status(self._reactor.monotonic())
        p, sigma = self._parameters, status["heat_gain_sigma"]
        heat, _ = self._witnesses()
        if p is not None and heat.condition() == flow_monitor.CLEAR and sigma <= CALIBRATED_SIGMA:
            gain = status["heat_gain"]
            self._options |= {"gain": gain, "gain_sigma": CALIBRATED_SIGMA}
            self._parameters = replace(p, gain=gain, gain_sigma=CALIBRATED_SIGMA)
            self.printer.lookup_object("configfile").set("nozzle_monitor", "heat_gain", f"{gain:.4f}")
            gcmd.respond_info(
                f"The melt takes {gain:.3f} times the heat of the model (+- {sigma:.3f}). SAVE_CONFIG keeps it."
            )
        elif self._vibration is None:
            raise gcmd.error(
                "NOZZLE_MONITOR_CALIBRATE: too little was extruded; print for a minute or two with a clear nozzle and"
                " filament that is fed well, then repeat"
            )

    def _calibrate_vibration(self, gcmd: GCodeCommand, vibration: MountVibration) -> None:
        found = mount_calibrate.measure(self.printer, gcmd, vibration, self._extruder, self._temp_c)
        values = {
            "mount_frequency": f"{found.frequency_hz:.2f}",
            "mount_quality": f"{found.quality:.1f}",
            "mount_amplitude": f"{found.amplitude_m_s2:.4f}",
            "flow_exponent": f"{found.flow_exponent:.3f}",
        }
        vibration.apply(
            replace(
                vibration.parameters,
                frequency_hz=found.frequency_hz,
                quality=found.quality,
                amplitude_m_s2=found.amplitude_m_s2,
                flow_exponent=found.flow_exponent,
            )
        )
        configfile = self.printer.lookup_object("configfile")
        for option, value in values.items():
            configfile.set("nozzle_monitor", option, value)
        lines = [f"The mount rings at {found.frequency_hz:.1f} Hz, quality {found.quality:.0f}."]
        lines.append(
            f"Amplitude {found.amplitude_m_s2:.3f} m/s2 at 5 mm3/s and 210 C, flow exponent {found.flow_exponent:.2f}"
            f" +- {found.flow_exponent_sigma:.2f}; noise {found.noise_m_s2:.3f} m/s2."
        )
        if found.weakest_m_s2 < 3.0 * found.noise_m_s2:
            lines.append("At the smallest flow the vibration is weak: slow extrusion will not be judged.")
        if found.times_longer > 1.0:
            lines.append(
                f"The flow exponent is not known well: repeat this with a TIME {found.times_longer:.1f} times as long."
            )
        gcmd.respond_info("\n".join([*lines, "SAVE_CONFIG keeps it."]))


def _load_vibration(config: ConfigWrapper, options: dict[str, Any]) -> MountVibration | None:
    """The witness of an accelerometer, if there is one."""
    printer = config.get_printer()
    section = config.get("accel_chip", "")
    frequency_hz, quality, exponent = config.getchoice("mount", MOUNTS, "direct")
    frequency_hz = config.getfloat("mount_frequency", frequency_hz, minval=5.0, maxval=1000.0)
    hole_mm = config.getfloat("nozzle_diameter", 0.4, minval=0.1, maxval=2.0)
    parameters = mount_witness.MountParameters(
        frequency_hz=frequency_hz,
        quality=config.getfloat("mount_quality", quality, minval=2.0, maxval=100.0),
        hole_mm=hole_mm,
        exponent=config.getfloat("amplitude_exponent", exponent, minval=1.0, maxval=8.0),
        amplitude_m_s2=config.getfloat("mount_amplitude", None, above=0.0, maxval=1000.0),
        flow_exponent=config.getfloat("flow_exponent", None, minval=0.3, maxval=2.0),
        restriction=config.getfloat("restriction", 0.1, minval=0.03, maxval=0.5),
        lost_share=options["lost_share"],
        false_alarm_s=options["false_alarm_s"],
    )
    axis = axis_number(config, "mount_axis", "z")
    notches = config.getlists("notch_frequencies", [], parser=float)
    if not section:
        return None
    respond = printer.lookup_object("gcode").respond_info
    return MountVibration(printer, section, axis, parameters, notches, lambda text: respond(text, log=True))


def load_config(config: ConfigWrapper) -> NozzleMonitor:
    printer = config.get_printer()
    options = {
        "lost_share": config.getfloat("lost_flow", 0.3, minval=0.1, maxval=0.9),
        "false_alarm_s": 3600.0 * config.getfloat("false_alarm_hours", 100.0, minval=1.0, maxval=1e6),
        "noise_w_s": config.getfloat("heat_noise", 0.15, minval=0.01, maxval=10.0),
    }
    options["has_other"] = bool(config.get("accel_chip", ""))
    gain = config.getfloat("heat_gain", None, minval=0.5, maxval=2.0)
    if gain is not None:
        options |= {"gain": gain, "gain_sigma": CALIBRATED_SIGMA}
    template = None
    if config.get("alarm_gcode", None) is not None:
        template = printer.load_object(config, "gcode_macro").load_template(config, "alarm_gcode")
    vibration = _load_vibration(config, options)
    monitor = NozzleMonitor(printer, config.get("heater"), config.where(), options, template, vibration)
    monitor.register()
    return monitor
