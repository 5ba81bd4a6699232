"""The short way of G0/G1: rows of plain lines go through the C helper (g1path.h) without Python seeing the moves.

It is taken only while nobody could tell the difference: nothing between G-code and toolhead (a transform, another
handler), the checks of kinematics and extruder are those that C knows (`done_in_c`). Any line that is unusual
or wrong ends the row and takes the Python path, with nothing of it applied.
"""

from __future__ import annotations

import os
import struct
from typing import Any

import chelper
from lookahead import is_done_in_c

# struct g1_state: what comes back, and all of it
_OUT = struct.Struct("=11d")
_STATE = struct.Struct("=38d")
# For comparing both ways: without the short one every line goes through Python.
DISABLE_VARIABLE = "FERRITE_NO_G1PATH"


class G1Path:
    """Carries out rows of G0/G1 lines for GCodeDispatch.run_block."""

    def __init__(self, gcode: Any, gcode_move: Any, toolhead: Any) -> None:
        self._gcode = gcode
        self._gcode_move = gcode_move
        self._toolhead = toolhead
        self._ffi, self._lib = chelper.get_ffi()
        self._state = self._ffi.new("struct g1_state *")
        self._state_bytes = self._ffi.buffer(self._state)
        self._disabled = bool(os.environ.get(DISABLE_VARIABLE))

    def _is_plain(self) -> bool:
        """Whether C does just what Python would."""
        toolhead, gcode = self._toolhead, self._gcode
        extruder = toolhead.extruder
        return (
            not self._disabled
            and not toolhead.can_pause
            and not toolhead.extra_axes
            and not toolhead.printer.is_exiting()
            and self._reaches_toolhead()
            and is_done_in_c(
                gcode.get_handler("G0"), gcode.get_handler("G1"), toolhead.move, toolhead.kin.check_move,
                extruder.check_move, extruder.calc_junction, extruder.process_move,
            )
        )  # fmt: skip

    def _reaches_toolhead(self) -> bool:
        """Nothing, or only transforms that have nothing to do now, between G-code and toolhead."""
        transform = self._gcode_move.transform
        while transform is not None and transform is not self._toolhead:
            transform = getattr(transform, "passes_to", None)
        return transform is not None

    def _pack(self) -> None:
        """Modal state, limits of the machine and of the extruder into the C structure."""
        toolhead, gcode_move = self._toolhead, self._gcode_move
        modes, kin, extruder = gcode_move.modes, toolhead.kin, toolhead.extruder
        low, high = zip(*kin.limits, strict=True)
        heater = getattr(extruder, "heater", None)
        filament: tuple[float, ...] = (0.0,) * 7
        if heater is not None:
            filament = (
                heater.can_extrude, extruder.nozzle_diameter, extruder.max_extrude_ratio, extruder.max_e_velocity,
                extruder.max_e_accel, extruder.max_e_dist, extruder.instant_corner_v,
            )  # fmt: skip
        _STATE.pack_into(
            self._state_bytes, 0, *gcode_move.last_position, *toolhead.commanded_pos, modes.speed, 0.0, 0.0,
            *modes.base_position, modes.speed_factor, modes.extrude_factor, modes.absolute_coord,
            modes.absolute_extrude, toolhead.max_velocity, toolhead.max_accel, toolhead.junction_deviation,
            toolhead.max_accel_to_decel, *low, *high, kin.z_limits.velocity, kin.z_limits.accel, *filament,
        )  # fmt: skip

    def run(self, text: bytes, start: int, end: int) -> int:
        """Run lines of text[start:end]; returns where it stopped, behind a line end. Raises what planning raises."""
        buffer = self._ffi.from_buffer(text)
        row = self._toolhead.lookahead.row
        while start < end and self._is_plain():
            self._pack()
            start += self._lib.g1_run(self._state, row, buffer + start, end - start)
            state = _OUT.unpack_from(self._state_bytes)
            due, queued = state[9], state[10]
            self._gcode_move.last_position = list(state[:4])
            self._gcode_move.modes.speed = state[8]
            if not queued:
                break
            self._toolhead.commanded_pos[:] = state[4:8]
            self._toolhead.note_queued(bool(due))
            if not due:
                break
        return start
