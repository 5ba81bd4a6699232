"""What is going to take heat from an induction nozzle: the planned extrusion and the part fan, for its control law.

Moves stand in the extruder's motion queue a fraction of a second before they happen; asking the queue costs nothing
while nothing is printed and does not slow the planning of moves down, as a callback for each move would.
"""

from __future__ import annotations

import chelper
from roles import Printer
from thermal.control.control_api import IDLE, Schedule

BEHIND_S = 0.050  # blocks that are still to arrive lie this far back
AHEAD_S = 0.200  # beyond any horizon, and until the next look
LOOK_S = 0.025


class FlowAhead:
    """Looks ahead for one heater."""

    def __init__(self, printer: Printer, extruder_name: str) -> None:
        self.printer = printer
        self.extruder_name = extruder_name
        self.flow = self.fan = IDLE
        self._looked_s = -1e9
        self._changes: tuple[tuple[float, float], ...] = ()  # of the fan: print time, speed
        self._ffi, self._lib = chelper.get_ffi()
        self._filament = self._ffi.new("struct filament_flow *")
        self._lib.filament_flow_reset(self._filament)
        self._times_s = self._ffi.new("double[]", self._lib.FLOW_STEPS_MAX)
        self._flows = self._ffi.new("double[]", self._lib.FLOW_STEPS_MAX)

    def look(self, now_s: float) -> bool:
        """Bring flow and fan up to date; False: it is too soon to look again."""
        if abs(now_s - self._looked_s) < LOOK_S:
            return False
        self._looked_s = now_s
        self.flow = self._flow(now_s)
        part_fan = self.printer.lookup_object("fan", None)
        fan = getattr(part_fan, "fan", None)
        if fan is not None and tuple(fan.changes) != self._changes:
            self._changes = tuple(fan.changes)
            changes = sorted(self._changes)
            self.fan = Schedule(tuple(at for at, _ in changes), tuple(speed for _, speed in changes))
        return True

    def _flow(self, now_s: float) -> Schedule:
        extruder = self.printer.lookup_object(self.extruder_name, None)
        if extruder is None or not hasattr(extruder, "get_trapq"):
            return IDLE
        times_s, flows = self._times_s, self._flows
        count = self._lib.filament_flow_look(
            self._filament,
            extruder.get_trapq(),
            now_s - BEHIND_S,
            now_s + AHEAD_S,
            extruder.filament_area,
            times_s,
            flows,
        )
        if not count:
            return IDLE
        return Schedule(tuple(self._ffi.unpack(times_s, count)), tuple(self._ffi.unpack(flows, count)))
