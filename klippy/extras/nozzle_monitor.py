"""[nozzle_monitor]: is filament lost between motor and nozzle? By the heat that the melt takes from the nozzle.

The heater's loop gives each tenth of a second a temperature and the heat put in; here stands what the extruder has fed
meanwhile. thermal/sensing/flow_monitor.py judges. It sees lost flow (runout, grinding, skipping), not a diameter.
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

HISTORY_ROWS = 2000
HISTORY_S = 30.0  # between rows while the condition stays
NEW_FILAMENT_MM = 50.0  # from the farthest place: filament is changed
LAG_S = 0.06  # from the motor to the heat: compliance and the wall of the bore
CALIBRATED_SIGMA = 0.03  # of a saved gain: one spool and temperature to another


class NozzleMonitor:
    """The object `nozzle_monitor`."""

    def __init__(self, printer: Printer, name: str, where: str, options: dict[str, Any], alarm: Any) -> None:
        self.printer = printer
        self.name, self._where = name, where
        self.history: deque[dict[str, Any]] = deque(maxlen=HISTORY_ROWS)
        self._options, self._alarm = options, alarm
        self._gcode = printer.lookup_object("gcode")
        self._reactor = printer.get_reactor()
        self._heater: Any = None
        self._extruder: Any = None
        self._parameters: flow_monitor.FlowMonitorParameters | None = None
        self._state: flow_monitor.FlowMonitorState | None = None
        self._peak_mm = math.nan  # farthest place of the filament
        self._models: tuple[Any, ...] = ()

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._on_connect)
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
        planned_mm3 = self._fed_mm3(news.time_s - LAG_S)
        reading = flow_monitor.HeatReading(
            news.time_s, news.temp_c, balance.second_c, balance.second_doubt_c, heat_j, planned_mm3,
            self._heater.loop.fan.at(news.time_s),
        )  # fmt: skip
        was_lost = state.lost
        if not flow_monitor.observe(p, state, reading):
            return
        self._note(flow_monitor.condition(p, state))
        if state.lost and not was_lost:
            self._reactor.register_callback(self._on_alarm)

    def _fed_mm3(self, print_time: float) -> float:
        """Filament that went beyond its farthest place; what returns from a retraction takes no heat."""
        place_mm = self._extruder.find_past_position(print_time)
        new_mm = place_mm - self._peak_mm
        if not abs(new_mm) < NEW_FILAMENT_MM:
            self._peak_mm = place_mm
            return 0.0
        self._peak_mm = max(self._peak_mm, place_mm)
        return float(max(0.0, new_mm) * self._extruder.filament_area)

    def _note(self, condition: str) -> None:
        """One row when the condition changes, and now and then."""
        now_s = self._reactor.monotonic()
        last = self.history[-1] if self.history else None
        if last is None or last["condition"] != condition or now_s - last["t_s"] >= HISTORY_S:
            self.history.append({"t_s": now_s, "condition": condition, "diameter_mm": None, "sigma_mm": None})

    def _on_alarm(self, eventtime: float) -> None:
        state = self._state
        assert state is not None
        percent = 100.0 * state.lost_share
        text = (
            f"Nozzle monitor: the melt takes {percent:.0f} % less heat than its planned flow needs: the filament ran"
            " out, the drive grinds it, or the nozzle is clogged"
        )
        logging.warning("%s", text)
        self._gcode.respond_info(text, log=False)
        if self._alarm is None:
            return
        try:
            self._gcode.run_script(self._alarm.render())
        except self.printer.command_error as e:
            self._gcode.respond_error(f"Nozzle monitor: alarm_gcode failed: {e}")

    def get_status(self, eventtime: float) -> dict[str, Any]:
        p, state = self._parameters, self._state
        if p is None or state is None:
            return {
                "condition": flow_monitor.UNKNOWN, "diameter": None, "diameter_sigma": None, "lost_flow": None,
                "evidence": 0.0, "heat_gain": None, "heat_gain_sigma": None,
            }  # fmt: skip
        found = flow_monitor.condition(p, state)
        return {
            "condition": found,
            "diameter": None,
            "diameter_sigma": None,
            "lost_flow": None if found == flow_monitor.UNKNOWN else round(state.lost_share, 3),
            "evidence": round(state.evidence / p.threshold, 3),
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
        lines.append("Diameter: not measured, this needs a vibration sensor")
        gcmd.respond_info("\n".join(lines))

    def cmd_NOZZLE_MONITOR_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """What was extruded so far, with a nozzle known to be clear, becomes the measure."""
        status = self.get_status(self._reactor.monotonic())
        p, state = self._parameters, self._state
        sigma = status["heat_gain_sigma"]
        if (
            p is None
            or state is None
            or status["condition"] != flow_monitor.CLEAR
            or sigma > CALIBRATED_SIGMA
        ):
            raise gcmd.error(
                "NOZZLE_MONITOR_CALIBRATE: too little was extruded; print for a minute or two with a clear nozzle and"
                " filament that is fed well, then repeat"
            )
        gain = status["heat_gain"]
        self._options |= {"gain": gain, "gain_sigma": CALIBRATED_SIGMA}
        self._parameters = replace(p, gain=gain, gain_sigma=CALIBRATED_SIGMA)
        self.printer.lookup_object("configfile").set("nozzle_monitor", "heat_gain", f"{gain:.4f}")
        gcmd.respond_info(
            f"The melt takes {gain:.3f} times the heat of the model (+- {sigma:.3f}). SAVE_CONFIG keeps it."
        )


def load_config(config: ConfigWrapper) -> NozzleMonitor:
    printer = config.get_printer()
    options = {
        "lost_share": config.getfloat("lost_flow", 0.3, minval=0.1, maxval=0.9),
        "false_alarm_s": 3600.0 * config.getfloat("false_alarm_hours", 100.0, minval=1.0, maxval=1e6),
        "noise_w_s": config.getfloat("heat_noise", 0.15, minval=0.01, maxval=10.0),
    }
    gain = config.getfloat("heat_gain", None, minval=0.5, maxval=2.0)
    if gain is not None:
        options |= {"gain": gain, "gain_sigma": CALIBRATED_SIGMA}
    template = None
    if config.get("alarm_gcode", None) is not None:
        template = printer.load_object(config, "gcode_macro").load_template(config, "alarm_gcode")
    monitor = NozzleMonitor(printer, config.get("heater"), config.where(), options, template)
    monitor.register()
    return monitor
