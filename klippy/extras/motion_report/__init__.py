"""Where the head is right now, from the planned motion: printer object 'motion_report'. Streams: dump.py."""

from __future__ import annotations

from typing import Any

import chelper
from configfile import ConfigWrapper
from roles import Printer
from toolhead import Coord

from . import dump as motion_dump

# Plans are looked up no more often than this: status is asked for many objects at once.
REFRESH_S = 0.050


class MotionReport:
    """live_position, live_velocity, live_extruder_velocity."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.steppers: dict[str, Any] = {}
        self._ffi, self._lib = chelper.get_ffi()
        self._position = self._ffi.new("double[3]")
        self._velocity = self._ffi.new("double *")
        self._next_time = 0.0
        self._trapq_names: list[str] = []
        self._status = {
            "live_position": Coord(0.0, 0.0, 0.0, 0.0),
            "live_velocity": 0.0,
            "live_extruder_velocity": 0.0,
            "steppers": [],
            "trapq": [],
        }
        printer.register_event_handler("klippy:connect", self._register_streams)

    def _register_streams(self) -> None:
        toolhead = self.printer.lookup_object("toolhead", None)
        if toolhead is None:
            return
        trapqs = {"toolhead": toolhead.get_trapq()}
        for name, thing in self.printer.lookup_objects():
            if name.startswith("extruder") and hasattr(thing, "get_trapq"):
                trapqs[name] = thing.get_trapq()
        self._status["steppers"], self._status["trapq"] = sorted(self.steppers), sorted(trapqs)
        self._trapq_names = sorted(trapqs)
        motion_dump.register(self.printer, self.steppers, trapqs)

    def register_stepper(self, config: ConfigWrapper, mcu_stepper: Any) -> None:
        self.steppers[mcu_stepper.get_name()] = mcu_stepper

    def _state_at(self, trapq: Any, print_time: float) -> tuple[float, float, float, float] | None:
        """(x, y, z, speed along the path) or None if nothing is known."""
        if not self._lib.trapq_state_at(trapq, print_time, self._position, self._velocity):
            return None
        x, y, z = self._position
        return x, y, z, self._velocity[0]

    def _extruder_velocity(self, trapq: Any, print_time: float) -> float:
        span = self._ffi.new("struct trapq_span[1]")
        if not self._lib.trapq_extract(trapq, span, 1, print_time, print_time + 1e-9):
            return 0.0
        s = span[0]
        return s.x_r * (s.start_v + s.accel * max(0.0, print_time - s.print_time))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        toolhead = self.printer.lookup_object("toolhead", None)
        if toolhead is None or eventtime < self._next_time:
            return self._status
        self._next_time = eventtime + REFRESH_S
        print_time = toolhead.mcu.estimated_print_time(eventtime)
        head = self._state_at(toolhead.get_trapq(), print_time)
        x, y, z, speed = head if head is not None else (*toolhead.get_position()[:3], 0.0)
        e = e_speed = 0.0
        extruder = toolhead.get_extruder()
        if extruder.get_name():
            fed = self._state_at(extruder.get_trapq(), print_time)
            e = fed[0] if fed is not None else toolhead.get_position()[3]
            e_speed = self._extruder_velocity(extruder.get_trapq(), print_time)
        self._status = {
            "live_position": Coord(x, y, z, e),
            "live_velocity": speed,
            "live_extruder_velocity": e_speed,
            "steppers": sorted(self.steppers),
            "trapq": self._trapq_names,
        }
        return self._status


def load_config(config: ConfigWrapper) -> MotionReport:
    return MotionReport(config.get_printer())
