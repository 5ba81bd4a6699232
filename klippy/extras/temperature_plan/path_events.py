"""What a printer reports to a session of the temperature plan: comments, objects, requests, moves, the bed.

The look-ahead calls with moves whose times are known; they are only copied then. The session's owner decides when to
process them: [temperature_plan] in a timer, simulation/plan_offline.py as the file is read.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from thermal.plan import requests
from thermal.plan.layer_time import LayerSpeed
from thermal.plan.session import Session

from .settings import Settings

AHEAD_S = 2.0  # motion that a plan knows


class PathEvents:
    """Feeds one session from one printer."""

    session: Session

    def __init__(self, printer: Any, settings: Settings) -> None:
        self.printer = printer
        self.settings = settings
        self.enabled = settings.enabled
        self.heater: Any = None
        self.min_extrude_c = 0.0  # of that heater
        self._gcode = printer.lookup_object("gcode")
        self._toolhead: Any = None
        self._is_listening = False
        self._fan_device: Any = None
        self._bed: Any = None
        self._extruder: Any = None  # that the look-ahead moves, and is it ours?
        self._is_ours = True

    def register_requests(self) -> None:
        """The commands that ask for a temperature."""
        self._gcode.register_command(
            "SET_SEGMENT_TEMPERATURE",
            self.cmd_SET_SEGMENT_TEMPERATURE,
            desc="Melt temperature of the path that follows",
        )
        self._gcode.register_command("M104.1", self.cmd_M104_1)

    def find_devices(self) -> None:
        """All sections are loaded: what the path depends on beside the heater."""
        self._toolhead = self.printer.lookup_object("toolhead")
        fan = self.printer.lookup_object("fan", None)
        self._fan_device = fan.fan if fan is not None else None
        self._bed = self.printer.lookup_object("heater_bed", None)

    def listen(self) -> None:
        """From now on everything goes to the session."""
        self.printer.register_event_handler("exclude_object:current", self._on_object)
        self._gcode.register_comment_listener(self._on_comment)
        self._toolhead.register_move_listener(self._on_moves, as_records=True)
        self._is_listening = True
        self.keep_ahead()

    def keep_ahead(self) -> None:
        """A nozzle falls by 15 C in more than a second: the plan needs motion longer ahead than a pause should wait."""
        self._toolhead.keep_ahead(AHEAD_S if self.enabled else 0.0)

    # For who owns the session

    def on_due(self) -> None:
        """Enough new motion has come for another plan."""

    def on_speed(self, speed: LayerSpeed) -> None:
        """Hot layers get this speed from now on."""

    # Names of places, as the G-code comes by

    def _mark(self, state: requests.Requests) -> None:
        """`state` holds from the end of the moves queued now."""
        session = self.session
        if not self.enabled or not self._is_listening:
            session.requested.state = state
        elif session.note(state):
            self._toolhead.register_lookahead_callback(lambda time_s: session.hold(state, time_s))

    def _on_comment(self, line: str) -> None:
        found = requests.read_comment(line)
        if found is not None:
            self._mark(self.session.requested.state.comment(found))
            if found.kind == "layer":
                self.begin_layer()

    def _on_object(self, name: str | None) -> None:
        self._mark(self.session.requested.state.inside(name or ""))

    def cmd_SET_SEGMENT_TEMPERATURE(self, gcmd: Any) -> None:
        temp_c = gcmd.get_float("TEMP", minval=0.0, maxval=self.heater.max_temp)
        until = gcmd.get("UNTIL", "").lower()
        if until not in ("", "layer", "feature", "object"):
            raise gcmd.error(f"UNTIL is layer, feature or object, not '{until}'")
        duration_s = gcmd.get_float("DURATION", math.inf, above=0.0)
        self._request(gcmd, temp_c, until, duration_s)

    def cmd_M104_1(self, gcmd: Any) -> None:
        """M104.1 S<degC>: the same, until the next one; S0 takes it back."""
        self._request(gcmd, gcmd.get_float("S", minval=0.0, maxval=self.heater.max_temp), "", math.inf)

    def _request(self, gcmd: Any, temp_c: float, until: str, duration_s: float) -> None:
        if temp_c and temp_c < self.min_extrude_c:
            raise gcmd.error(
                f"A segment cannot be deposited at {temp_c:.0f} C: min_extrude_temp is {self.min_extrude_c:.0f} C"
            )
        if not self.enabled:
            gcmd.respond_info(
                "The temperature plan is disabled: this changes nothing until TEMPERATURE_PLAN ENABLE=1"
            )
        self._mark(self.session.requested.state.explicitly(temp_c or math.nan, until, duration_s))

    # Moves, as soon as their times are known

    def _on_moves(self, row: Any, count: int, print_time: float) -> None:
        if not self.enabled or not self._is_listening or getattr(self.heater, "in_calibration", False):
            return
        serving = self._toolhead.get_extruder()
        if serving is not self._extruder:
            self._extruder = serving
            self._is_ours = not serving.get_name() or serving.get_heater() is self.heater
        if not self._is_ours:
            return  # another tool prints
        fan = self._fan_device.last_fan_value if self._fan_device is not None else 0.0
        if self.session.moves(row, count, print_time, fan):
            self.on_due()

    def watch_bed(self, eventtime: float) -> None:
        """Pass the bed's target to the session; without a target the last one holds."""
        bed_c = self._bed.get_status(eventtime)["target"] if self._bed is not None else 0.0
        if bed_c > 0.0:
            self.session.set_bed(bed_c)

    # The speed of hot layers

    def begin_layer(self) -> None:
        """The file says that a layer begins; called before its first move is queued."""
        if self.enabled and self._is_listening and self.session.speeds.is_used:
            pause_s = self.choose_speed().pause_s
            if pause_s > 0.0:
                self._toolhead.dwell(pause_s)

    def choose_speed(self) -> LayerSpeed:
        """Set the speed of the next layer to what the layer below allows."""
        speed = self.session.choose_speed()
        self.set_speed(speed.factor)
        self.on_speed(speed)
        return speed

    def set_speed(self, factor: float) -> None:
        """Part of the file's speed for moves that extrude."""
        modes = self.printer.lookup_object("gcode_move").modes
        if factor != modes.plan_speed_factor:
            modes.plan_speed_factor = factor
            self._mark(replace(self.session.requested.state, speed_factor=factor))
