"""Modal G-code state: what G0/G1 mean, given units of modes, offsets and factors.

    G1 X10  --absolute/relative, G92 origin, SET_GCODE_OFFSET, M221-->  toolhead position  --move_with_transform-->

A command is checked completely before anything of it takes effect: a bad parameter leaves the state as it was.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from lookahead import done_in_c, is_done_in_c, limits_of
from motionlimits import PERCENT, POSITION, SPEED
from roles import Printer
from toolhead import Coord

DEFAULT_SPEED_MM_S = 25.0
AXES = "XYZE"
WORDS = "XYZEF"  # of G1, in the order of struct gcode_words


class SavedState(TypedDict):
    """What SAVE_GCODE_STATE keeps. Plugins read and change it."""

    absolute_coord: bool
    absolute_extrude: bool
    base_position: list[float]
    last_position: list[float]
    homing_position: list[float]
    speed: float
    speed_factor: float
    extrude_factor: float


@dataclass(slots=True)
class _Modes:
    """Interpretation of coordinates."""

    absolute_coord: bool = True
    absolute_extrude: bool = True
    speed: float = DEFAULT_SPEED_MM_S  # mm/s, before the speed factor
    speed_factor: float = 1.0
    extrude_factor: float = 1.0
    base_position: list[float] = field(default_factory=lambda: [0.0] * 4)  # toolhead position of G-code zero
    homing_position: list[float] = field(default_factory=lambda: [0.0] * 4)  # its value after G28
    plan_speed_factor: float = (
        1.0  # further factor of moves that extrude, beside the user's own (temperature_plan)
    )


def _mode(name: str) -> property:
    """A field of the modes under its own name, for plugins."""
    return property(
        lambda move: getattr(move.modes, name), lambda move, value: setattr(move.modes, name, value)
    )


class GCodeMove:
    """Printer object 'gcode_move'."""

    base_position = _mode("base_position")
    homing_position = _mode("homing_position")
    absolute_coord = _mode("absolute_coord")
    absolute_extrude = _mode("absolute_extrude")
    speed_factor = _mode("speed_factor")
    extrude_factor = _mode("extrude_factor")

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.toolhead: Any = None
        self.transform: Any = None
        self.modes = _Modes()
        self.last_position = [0.0] * 4  # toolhead coordinates after the last command
        self.saved_states: dict[str, SavedState] = {}
        self._extra_letters: dict[str, int] = {}  # of further axes: their numbers in a position
        self.is_printer_ready = False
        self._move: Any = None
        ffi, self._lib = chelper.get_ffi()
        self._destination = ffi.new("struct gcode_destination *")

    # -- set-up --

    def register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for name in ("G20", "G21", "M82", "M83", "G90", "G91", "G92", "M220", "M221", "M114", "G1"):
            early = name not in ("G1", "M114", "G92")
            gcode.register_command(name, getattr(self, f"cmd_{name}"), when_not_ready=early)
        gcode.register_command("G0", self.cmd_G1)
        for name, text in (
            ("SET_GCODE_OFFSET", "Set a virtual offset to g-code positions"),
            ("SAVE_GCODE_STATE", "Save G-Code coordinate state"),
            ("RESTORE_GCODE_STATE", "Restore a previously saved G-Code state"),
            ("GET_POSITION", "Return information on the current location of the toolhead"),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)
        for event, handler in (
            ("klippy:ready", self._handle_ready),
            ("klippy:shutdown", self._handle_shutdown),
            ("toolhead:set_position", self.reset_last_position),
            ("toolhead:manual_move", self.reset_last_position),
            ("toolhead:update_extra_axes", self._handle_extra_axes),
            ("gcode:command_error", self.reset_last_position),
            ("extruder:activate_extruder", self._handle_activate_extruder),
            ("homing:home_rails_end", self._handle_home_rails_end),
        ):
            self.printer.register_event_handler(event, handler)

    def _handle_ready(self) -> None:
        self.is_printer_ready = True
        self.toolhead = self.printer.lookup_object("toolhead")
        if self.transform is None:
            self.transform = self.toolhead
        self._move = self.transform.move
        self.reset_last_position()
        gcode = self.printer.lookup_object("gcode")
        gcode.register_row_runner(MoveRows(gcode, self, self.toolhead))

    def _handle_shutdown(self) -> None:
        self.is_printer_ready = False

    def _handle_activate_extruder(self) -> None:
        self.reset_last_position()
        self.modes.extrude_factor = 1.0
        self.modes.base_position[3] = self.last_position[3]

    def _handle_extra_axes(self) -> None:
        """Letters of G1 have been added or removed; a new one is counted from where it stands at 0."""
        base = dict(zip(self._extra_letters, self.modes.base_position[4:], strict=True))
        letters: dict[str, int] = {}
        for number, axis in enumerate(self.toolhead.get_extra_axes()):
            letter = axis.get_axis_gcode_id() if axis is not None and number > 3 else None
            if letter:
                letters[letter] = number
        self._extra_letters = letters
        self.modes.base_position[4:] = [base.get(letter, 0.0) for letter in letters]
        self.reset_last_position()

    def _handle_home_rails_end(self, homing_state: Any, rails: Any) -> None:
        self.reset_last_position()
        for axis in homing_state.get_axes():
            self.modes.base_position[axis] = self.modes.homing_position[axis]

    def set_move_transform(self, transform: Any, force: bool = False) -> Any:
        """Put an object with move() and get_position() between G-code and toolhead; returns the one before."""
        if self.transform is not None and not force:
            raise self.printer.config_error("G-Code move transform already specified")
        old = self.transform
        if old is None:
            old = self.printer.lookup_object("toolhead", None)
        self.transform = transform
        self._move = transform.move
        return old

    # -- state --

    def reset_last_position(self) -> None:
        """Take over where the toolhead is."""
        if self.is_printer_ready:
            self.last_position = list(self.transform.get_position())

    def get_gcode_position(self) -> Coord:
        """The position as G-code would name it."""
        modes = self.modes
        p = [last - base for last, base in zip(self.last_position, modes.base_position, strict=False)]
        p[3] /= modes.extrude_factor
        return Coord(*p[:4])

    def get_status(self, eventtime: float | None = None) -> dict[str, Any]:
        modes = self.modes
        return {
            "speed_factor": modes.speed_factor,
            "speed": modes.speed,
            "extrude_factor": modes.extrude_factor,
            "absolute_coordinates": modes.absolute_coord,
            "absolute_extrude": modes.absolute_extrude,
            "homing_origin": Coord(*modes.homing_position),
            "position": Coord(*self.last_position[:4]),
            "gcode_position": self.get_gcode_position(),
            "axis_map": {"X": 0, "Y": 1, "Z": 2, "E": 3, **self._extra_letters},
        }

    # -- moves --

    @done_in_c
    def cmd_G1(self, gcmd: GCodeCommand) -> None:
        """G0, G1 [X] [Y] [Z] [E] [F], and letters of further axes: one line, read here, otherwise as in rows."""
        params = gcmd.get_command_parameters()
        values, given, further = [0.0] * len(WORDS), 0, {}
        try:
            for number, letter in enumerate(WORDS):
                if letter in params:
                    values[number] = float(params[letter])
                    given |= 1 << number
            for letter, number in self._extra_letters.items():
                if letter in params:
                    further[number] = float(params[letter])
        except ValueError:
            raise self._bad_number(gcmd) from None
        dest = self._destination
        self._lib.gcode_destination([self.modal_state()], [(values, given)], dest)
        target = [*dest.target, *self.last_position[4:]]
        for number, value in further.items():
            target[number] = (
                value + (self.modes.base_position if self.modes.absolute_coord else target)[number]
            )
        # a sum is finite exactly if all its parts are (coordinates far below overflow)
        speed = dest.modal_speed
        if not math.isfinite(sum(target) + speed):
            raise self._bad_number(gcmd)
        if speed <= 0.0:
            raise gcmd.error(f"Invalid speed in '{gcmd.get_commandline()}': F must be above zero")
        self._move(target, dest.speed)
        self.modes.speed = speed
        self.last_position = target

    def modal_state(self) -> tuple[Any, ...]:
        """struct gcode_modes."""
        modes = self.modes
        return (
            self.last_position[:4], modes.speed, modes.base_position[:4], modes.speed_factor, modes.plan_speed_factor,
            modes.extrude_factor, modes.absolute_coord, modes.absolute_extrude,
        )  # fmt: skip

    def _bad_number(self, gcmd: GCodeCommand) -> Exception:
        """The error that names the parameter at fault."""
        for letter, text in gcmd.get_command_parameters().items():
            try:
                if letter not in {*"XYZEF", *self._extra_letters} or math.isfinite(float(text)):
                    continue
            except ValueError:
                pass
            what = f"is '{text}', which is not a finite number" if text else "needs a number"
            return gcmd.error(f"Unable to parse move '{gcmd.get_commandline()}': {letter} {what}")
        return gcmd.error(f"Unable to parse move '{gcmd.get_commandline()}': the position is not finite")

    # -- modes --

    def cmd_G20(self, gcmd: GCodeCommand) -> None:
        """Inches are not supported."""
        raise gcmd.error("Machine does not support G20 (inches) command")

    def cmd_G21(self, gcmd: GCodeCommand) -> None:
        """Millimetres: always."""

    def cmd_M82(self, gcmd: GCodeCommand) -> None:
        """Absolute extrusion."""
        self.modes.absolute_extrude = True

    def cmd_M83(self, gcmd: GCodeCommand) -> None:
        """Relative extrusion."""
        self.modes.absolute_extrude = False

    def cmd_G90(self, gcmd: GCodeCommand) -> None:
        """Absolute coordinates."""
        self.modes.absolute_coord = True

    def cmd_G91(self, gcmd: GCodeCommand) -> None:
        """Relative coordinates."""
        self.modes.absolute_coord = False

    def cmd_G92(self, gcmd: GCodeCommand) -> None:
        """G92 [X] [Y] [Z] [E]: the place where the head is gets these coordinates; all zero without any."""
        offsets = [gcmd.get_float(axis, None) for axis in (*AXES, *self._extra_letters)]
        if all(offset is None for offset in offsets):
            self.modes.base_position = list(self.last_position)
            return
        for axis, offset in enumerate(offsets):
            if offset is not None:
                scaled = offset * self.modes.extrude_factor if axis == 3 else offset
                self.modes.base_position[axis] = self.last_position[axis] - scaled

    def cmd_M114(self, gcmd: GCodeCommand) -> None:
        """Report the position."""
        gcmd.respond_raw("X:{:.3f} Y:{:.3f} Z:{:.3f} E:{:.3f}".format(*self.get_gcode_position()))

    def cmd_M220(self, gcmd: GCodeCommand) -> None:
        """M220 S<percent>: speed factor."""
        self.modes.speed_factor = gcmd.get_float("S", 100.0, **PERCENT) / 100.0

    def cmd_M221(self, gcmd: GCodeCommand) -> None:
        """M221 S<percent>: extrusion factor."""
        factor = gcmd.get_float("S", 100.0, **PERCENT) / 100.0
        modes = self.modes
        e_value = (self.last_position[3] - modes.base_position[3]) / modes.extrude_factor
        modes.base_position[3] = self.last_position[3] - e_value * factor
        modes.extrude_factor = factor

    def cmd_SET_GCODE_OFFSET(self, gcmd: GCodeCommand) -> None:
        """SET_GCODE_OFFSET [X|X_ADJUST|Y|…=mm] [MOVE=1 [MOVE_SPEED=mm/s]]."""
        modes = self.modes
        deltas = [0.0] * 4
        for axis, letter in enumerate(AXES):
            offset = gcmd.get_float(letter, None, **POSITION)
            if offset is None:
                adjust = gcmd.get_float(f"{letter}_ADJUST", None, **POSITION)
                if adjust is None:
                    continue
                offset = modes.homing_position[axis] + adjust
            deltas[axis] = offset - modes.homing_position[axis]
        move = gcmd.get_int("MOVE", 0)
        speed = gcmd.get_float("MOVE_SPEED", modes.speed, **SPEED)
        if move:
            target = [p + d for p, d in zip(self.last_position, deltas, strict=False)]
            target += self.last_position[4:]
            self._move(target, speed)
            self.last_position = target
        for axis, delta in enumerate(deltas):
            modes.base_position[axis] += delta
            modes.homing_position[axis] += delta

    def cmd_SAVE_GCODE_STATE(self, gcmd: GCodeCommand) -> None:
        """SAVE_GCODE_STATE [NAME=]."""
        modes = self.modes
        self.saved_states[gcmd.get("NAME", "default")] = {
            "absolute_coord": modes.absolute_coord,
            "absolute_extrude": modes.absolute_extrude,
            "base_position": list(modes.base_position),
            "last_position": list(self.last_position),
            "homing_position": list(modes.homing_position),
            "speed": modes.speed,
            "speed_factor": modes.speed_factor,
            "extrude_factor": modes.extrude_factor,
        }

    def cmd_RESTORE_GCODE_STATE(self, gcmd: GCodeCommand) -> None:
        """RESTORE_GCODE_STATE [NAME=] [MOVE=1 [MOVE_SPEED=mm/s]]."""
        name = gcmd.get("NAME", "default")
        state = self.saved_states.get(name)
        if state is None:
            raise gcmd.error(f"Unknown g-code state: {name}")
        modes, move = self.modes, gcmd.get_int("MOVE", 0)
        speed = gcmd.get_float("MOVE_SPEED", state["speed"], **SPEED)
        target = [*state["last_position"][:3], *self.last_position[3:]]
        if move:
            self._move(target, speed)
        # the extruder is not moved back: its origin moves with what has been extruded since
        e_diff = self.last_position[3] - state["last_position"][3]
        self.modes = _Modes(
            state["absolute_coord"],
            state["absolute_extrude"],
            state["speed"],
            state["speed_factor"],
            state["extrude_factor"],
            [*state["base_position"][:3], state["base_position"][3] + e_diff, *modes.base_position[4:]],
            list(state["homing_position"]),
            modes.plan_speed_factor,
        )
        if move:
            self.last_position = target

    # -- report --

    def cmd_GET_POSITION(self, gcmd: GCodeCommand) -> None:
        """Positions at every stage from steps to G-code."""
        toolhead = self.printer.lookup_object("toolhead", None)
        if toolhead is None:
            raise gcmd.error("Printer not ready")
        toolhead.flush_step_generation()
        kin = toolhead.get_kinematics()
        steppers = kin.get_steppers()
        spos = {s.get_name(): s.get_commanded_position() for s in steppers}
        modes = self.modes

        def row(names: Sequence[str], values: Sequence[float], form: str = "{}:{:.6f}") -> str:
            return " ".join(form.format(name, value) for name, value in zip(names, values, strict=False))

        gcmd.respond_info(
            "\n".join(
                (
                    "mcu: "
                    + row(
                        [s.get_name() for s in steppers], [s.get_mcu_position() for s in steppers], "{}:{}"
                    ),
                    "stepper: " + row(list(spos), list(spos.values())),
                    "kinematic: " + row(AXES[:3], kin.calc_position(spos)),
                    "toolhead: " + row(AXES, toolhead.get_position()),
                    "gcode: " + row(AXES, self.last_position),
                    "gcode base: " + row(AXES, modes.base_position),
                    "gcode homing: " + row(AXES[:3], modes.homing_position),
                )
            )
        )

    # -- names that other modules read --

    @property
    def Coord(self) -> type[Coord]:
        return Coord


class MoveRows:
    """Rows of G0 and G1 for GCodeDispatch.run_next, as far as the C helper can carry them out (gcode_rows.h)."""

    # the doubles of struct row_state, and those of them that come back
    _STATE = struct.Struct("=40d")
    _LAST, _SPEED, _COMMANDED = slice(0, 4), 4, slice(14, 18)

    def __init__(self, gcode: Any, gcode_move: GCodeMove, toolhead: Any) -> None:
        self._gcode = gcode
        self._gcode_move = gcode_move
        self._toolhead = toolhead
        self._ffi, self._lib = chelper.get_ffi()
        self._state = self._ffi.new("struct row_state *")
        self._state_bytes = self._ffi.buffer(self._state, self._STATE.size)

    def _is_plain(self) -> bool:
        """Whether C does just what Python would: no plugin has replaced one of the methods that C stands for."""
        toolhead, gcode = self._toolhead, self._gcode
        if not is_done_in_c(toolhead.move):
            return False
        extruder = toolhead.extruder
        return not toolhead.extra_axes and is_done_in_c(
            gcode.get_handler("G0"), gcode.get_handler("G1"), toolhead.lookahead.add_move,
            toolhead.kin.check_move, extruder.check_move, extruder.calc_junction, extruder.process_move,
        )  # fmt: skip

    def _stages(self) -> list[tuple[Any, Any]] | None:
        """Transforms between G-code and toolhead that have something to do, with their stages in C (path_stage.h).
        None: one of them must see every move."""
        found: list[tuple[Any, Any]] = []
        transform = self._gcode_move.transform
        while transform is not self._toolhead:
            if not is_done_in_c(transform.move):
                return None
            following = getattr(transform, "passes_to", None)
            if following is None:
                stage = transform.row_stage()
                if stage is None:
                    return None
                found.append((transform, stage))
                following = transform.next_transform
            transform = following
        return found

    def _pack(self, stages: Sequence[tuple[Any, Any]]) -> None:
        """Modal state, limits of the machine and of the extruder into the C structure."""
        toolhead = self._toolhead
        last, speed, base, *factors = self._gcode_move.modal_state()
        low, high, z_velocity, z_accel = toolhead.kin.box()
        self._STATE.pack_into(
            self._state_bytes, 0, *last, speed, *base, *factors, *toolhead.commanded_pos, 0.0, 0.0,
            self._gcode.has_comment_listeners(), *limits_of(toolhead), *low, *high, z_velocity, z_accel,
            *toolhead.extruder.filament_limits(),
        )  # fmt: skip
        self._state.lookahead = toolhead.lookahead.row
        following = self._ffi.NULL
        for _, stage in reversed(stages):
            stage.next = following
            following = stage
        self._state.path = following

    def run(self, text: bytes, start: int, end: int) -> int:
        """Queue the moves of whole lines of text[start:end], until it is time to plan or a line is not for C."""
        stages = self._stages() if self._is_plain() else None
        if stages is None:
            return start
        self._pack(stages)
        buffer = self._ffi.from_buffer(text)
        start += self._lib.rows_run(self._state, buffer + start, end - start)
        state = self._STATE.unpack_from(self._state_bytes)
        self._gcode_move.last_position = list(state[self._LAST])
        self._gcode_move.modes.speed = state[self._SPEED]
        self._toolhead.commanded_pos[:] = state[self._COMMANDED]
        for transform, stage in stages:
            transform.take_row(stage)
        return start

    def settle(self) -> None:
        """Make the toolhead plan the queued moves."""
        if self._state.queued:
            self._toolhead.note_queued(bool(self._state.due))


def load_config(config: ConfigWrapper) -> GCodeMove:
    move = GCodeMove(config.get_printer())
    move.register_commands()
    return move


__all__: Sequence[str] = ("GCodeMove", "load_config")
