"""The toolhead: takes moves, plans them, and keeps every MCU supplied with steps in time.

    move() -> look-ahead queue -> plan -> trapq (head), trapq (extruder) -> StepStreams -> MCUs
                                     \\-> move listeners (flow for the thermal plan, reports)

Three times matter, all in print_time (seconds of the main MCU's clock):

    now (estimated)            done_time                 print_time
    ----|===== at the MCU ======|==== planned moves =======|.... look-ahead queue ....

print_time runs ahead of now by up to BUFFER_FULL_S, then move() waits. If too little is ahead and nothing
more comes, the timer `_watch` plans what there is, to a stop, so that the head never halts in mid-move.
In batch mode there is no now: nothing ever waits.
"""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import chelper
import motionlimits
import stepstream
from lookahead import AllAxesMove, Coord, LookAheadQueue, Move, done_in_c, is_done_in_c
from motionlimits import VelocityLimited

__all__ = ["Coord", "LookAheadQueue", "Move", "ToolHead", "add_printer_objects"]

# From standstill the first step is planned this far ahead: time to work out and send the first commands.
START_LEAD_S = 0.250
# move() waits while more than this is planned ahead. With what is queued a pause or a speed change acts within 1 s, and
# a host that is late by 0.8 s still finds the motors moving.
BUFFER_FULL_S = 0.88
# Below this the look-ahead queue is planned to a stop rather than risk running dry.
BUFFER_LOW_S = 0.25
# A first move waits this long (host time) for company before it is planned alone.
GATHER_S = 0.100
# Steps are worked out in batches of this much motion.
STEP_BATCH_S = 0.200
# A stop forced by a low buffer followed by a new move within this time counts as a stall.
STALL_WINDOW_S = 1.0
STALL_REPORT_S = 60.0
WAIT_POLL_S = 0.100
TIME_ROUNDING_S = 1e-6
# Names that plugins read for toolheads of their own.
BUFFER_TIME_HIGH = BUFFER_FULL_S
SDS_CHECK_TIME = stepstream.BORDER_S
# Motion beside the head's while it rests: worked out this far ahead, this often.
OTHERS_AHEAD_S = 0.200
OTHERS_PERIOD_S = 0.050


class DripModeEndSignal(Exception):
    """Kept for plugins that catch it; homing ends a drip move by its completion."""


class ToolHead(VelocityLimited):
    """Printer object 'toolhead'."""

    def __init__(self, config: Any) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.mcu = self.printer.lookup_object("mcu")
        self.can_pause = not self.mcu.is_fileoutput()
        self.commanded_pos = [0.0, 0.0, 0.0, 0.0]  # and of further axes
        self.extra_axes: list[Any] = []  # of G1 beside x, y, z, e; their positions follow those four
        self.lookahead = LookAheadQueue(self)
        self._set_limits(motionlimits.read_velocity_limits(config))
        self._set_up_motion()
        self.trapq = self._streams.new_trapq()
        self.print_time = 0.0
        self.print_stall = 0

        from kinematics.extruder import DummyExtruder  # the extruder module needs this one

        self.extruder: Any = DummyExtruder(self.printer)
        self.kin = self._load_kinematics(config)
        self._register(config)

    # -- set-up --

    def _set_up_motion(self) -> None:
        """What motion needs beside the public attributes."""
        self._streams = stepstream.lookup_streams(self.printer)
        ffi, lib = chelper.get_ffi()
        self._commit_in_c = lib.lookahead_commit
        self._filament_mm = ffi.new("double *")
        self._lib, self._cut_xyz, self._cut_speed = lib, ffi.new("double[3]"), ffi.new("double *")
        self._no_trapq = ffi.NULL
        self._trapq_append = lib.trapq_append
        self._trapq_set_position = lib.trapq_set_position
        self._listeners: list[Callable[[Sequence[Move]], None]] = []
        self._record_listeners: list[Callable[[Any, int, float], None]] = []
        self._at_rest = True  # nothing planned runs on: print_time may have passed
        self._ahead_s = BUFFER_FULL_S  # of motion, in a print
        self._motion_end = 0.0  # print_time at which the head's last motion ends
        self._forced_stop = False
        self._others_end = 0.0  # print_time up to which others move beside the head
        self._next_stall_report = 0.0
        self._watch_timer, self._watching = self.reactor.register_timer(self._watch), False

    def __getattr__(self, name: str) -> Any:
        """A plugin's toolhead sets only public attributes: the others are made when the first of them is missing."""
        if name.startswith("__") or "_streams" in self.__dict__ or "reactor" not in self.__dict__:
            raise AttributeError(f"A toolhead has no attribute '{name}'")
        self.extra_axes = []
        self._set_up_motion()
        return getattr(self, name)

    def _load_kinematics(self, config: Any) -> Any:
        name = config.get("kinematics")
        try:
            module = importlib.import_module(f"kinematics.{name}")
            loader = module.load_kinematics
        except (ImportError, AttributeError):
            raise config.error(
                f"Option 'kinematics' in section 'printer': there is no kinematics called '{name}'"
            ) from None
        return loader(self, config)

    def _register(self, config: Any) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("G4", self.cmd_G4)
        gcode.register_command("M400", self.cmd_M400)
        gcode.register_command("M204", self.cmd_M204)
        gcode.register_command("SET_VELOCITY_LIMIT", self.cmd_SET_VELOCITY_LIMIT, desc="Set velocity limits")
        self.printer.register_event_handler("klippy:shutdown", self._handle_shutdown)
        for module in ("gcode_move", "homing"):
            self.printer.load_object(config, module)

    # -- planned motion to steps --

    def _estimated_print_time(self) -> float:
        return self.mcu.estimated_print_time(self.reactor.monotonic())

    def _start_motion(self) -> None:
        """Out of rest: the next move begins a little after now."""
        self._at_rest = False
        earliest = START_LEAD_S
        if self.can_pause:
            now = self._estimated_print_time()
            earliest += now
            if self._forced_stop and 0.0 < now - self.print_time < STALL_WINDOW_S:
                self.print_stall += 1
                self._report_stall(now)
        self._forced_stop = False
        earliest = max(earliest, self._streams.done_time)
        if self.print_time < earliest:
            self.print_time = earliest
            self.printer.send_event(
                "toolhead:sync_print_time", self.reactor.monotonic(), earliest, self.print_time
            )

    def _report_stall(self, now: float) -> None:
        """Report, not too often, that the head had to stop in mid-print, and what helps."""
        if now < self._next_stall_report:
            return
        self._next_stall_report = now + STALL_REPORT_S
        self.printer.lookup_object("gcode").respond_info(
            f"The head had to stop because the next moves came too late (stall {self.print_stall}). The computer is "
            "too busy, or what sends the G-code is too slow. Print from the printer's own storage (virtual_sdcard), "
            "end other programs, or use fewer and longer lines or a lower speed (M220)."
        )

    def _go_on(self) -> None:
        """Motion comes: print_time is where it may begin."""
        if self._at_rest:
            self._start_motion()
        elif (
            self.print_time < self._streams.done_time - TIME_ROUNDING_S
        ):  # a drip move, or another toolhead's motion
            self.print_time = self._streams.done_time

    def _commit(self, count: int) -> None:
        """The first `count` moves, whose speeds are fixed, get their times and go to the motion queues. Python handles
        each of them only for listeners."""
        extruder, filament, queue = self.extruder, self._filament_mm, self.lookahead
        by_hand = bool(self.extra_axes) or not is_done_in_c(extruder.process_move)
        moves = queue.planned(count) if by_hand or self._listeners else []
        extruder_trapq = self._no_trapq if by_hand else getattr(extruder, "trapq", self._no_trapq)
        filament[0] = start = getattr(extruder, "last_position", 0.0)
        time = self.print_time
        due: list[tuple[Callable[[float], None], float]] = []
        parts = [(1, move.timing_callbacks or []) for move in moves] or queue.callbacks(count)
        for number, (part, callbacks) in enumerate(parts):
            end = self._commit_in_c(queue.row, part, time, self.trapq, extruder_trapq, filament)
            if moves:
                moves[number].print_time = time
            if by_hand:
                self._commit_others(time, moves[number])
            time = end
            due += [(callback, time) for callback in callbacks]
        if filament[0] != start:
            extruder.last_position = filament[0]
        self.print_time = self._motion_end = time
        for callback, end in due:
            callback(end)
        self._report(self._listeners, moves)
        self._make_steps()

    def _commit_others(self, print_time: float, move: Move) -> None:
        """The parts of a move that the C helper does not know: further axes, another extruder's."""
        if move.axes_d[3]:
            self.extruder.process_move(print_time, move)
        for number, way in enumerate(move.extra_d):
            if way:
                self.extra_axes[number].process_move(print_time, AllAxesMove(move), 4 + number)

    def _make_steps(self, batch_s: float = STEP_BATCH_S) -> None:
        """Work out steps as far as the plan reaches, once they are so much motion."""
        reach = self.print_time - self._streams.look_ahead_s()
        if reach - self._streams.worked_out_time > batch_s:
            self._streams.advance(reach)

    def _flush_lookahead(self, lazy: bool = False) -> None:
        count = self.lookahead.plan(lazy)
        if not count:
            return
        self._go_on()
        self._report(self._record_listeners, self.lookahead.row, count, self.print_time)
        self._commit(count)

    def _report(self, listeners: list[Any], *news: Any) -> None:
        """Call listeners. One that fails is called no more: the moves are planned and go on without it."""
        for listener in tuple(listeners):
            try:
                listener(*news)
            except self.printer.command_error:
                raise
            except Exception as e:
                logging.exception("A listener to moves failed")
                listeners.remove(listener)
                name = getattr(listener, "__module__", None) or "a plugin"
                self.printer.lookup_object("gcode").respond_error(
                    f"Internal error of {name}, left out from now on: {e}"
                )

    def _settle(self) -> None:
        """Everything known becomes steps and goes out; afterwards the head is at rest."""
        self._flush_lookahead()
        if self._at_rest:
            return
        # what is shaped or smoothed runs on after the motion; after a mere rest nothing does
        end = max(self.print_time, self._motion_end + self._streams.look_ahead_s())
        self._streams.advance(end, hold_back=False)
        self.print_time = end
        self._at_rest = True

    # -- pacing --

    def _watch(self, eventtime: float) -> float:
        """Timer: while motion is under way, plan to a stop what would otherwise run dry."""
        try:
            ahead = self.print_time - self.mcu.estimated_print_time(eventtime)
            if self.lookahead or not self._at_rest:
                if not self._at_rest and ahead > BUFFER_LOW_S:
                    return eventtime + (ahead - BUFFER_LOW_S)
                self._forced_stop = bool(self.lookahead)
                self._settle()
            if self._attend_others(eventtime):
                return eventtime + OTHERS_PERIOD_S
        except Exception as problem:
            logging.exception("Exception in the toolhead's timer")
            self.printer.invoke_shutdown(f"Motion stopped: {problem}")
        self._watching = False
        return self.reactor.NEVER

    def _attend_others(self, eventtime: float) -> bool:
        """While the head rests, steps of motion beside it are worked out just in time; True while there are any."""
        if self._streams.done_time >= self._others_end:
            self._others_end = 0.0
            return False
        reach = self.mcu.estimated_print_time(eventtime) + OTHERS_AHEAD_S
        self._streams.advance(min(self._others_end, reach), hold_back=False)
        return True

    def _start_watch(self) -> None:
        self._watching = True
        if self.can_pause:
            self.reactor.update_timer(self._watch_timer, self.reactor.monotonic() + GATHER_S)

    def keep_ahead(self, seconds: float) -> None:
        """For who must know motion earlier: at least so much of it is ahead (s); 0: no more than otherwise."""
        self._ahead_s = max(BUFFER_FULL_S, seconds)

    def _wait_for_room(self) -> None:
        """Hold the caller back while enough motion is planned ahead."""
        while self.can_pause and not self._at_rest:
            eventtime = self.reactor.monotonic()
            ahead = self.print_time - self.mcu.estimated_print_time(eventtime)
            surplus = ahead - self._ahead_s
            if surplus <= 0.0:
                break
            self._make_steps(0.0)  # a host that is late must have sent them
            self.reactor.pause(eventtime + min(1.0, max(0.005, surplus)))

    # -- moves --

    def get_position(self) -> list[float]:
        """Commanded x, y, z, e after everything queued (mm)."""
        return list(self.commanded_pos)

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        """The head is at newpos from now on, without moving; homing_axes count as homed."""
        if not math.isfinite(sum(newpos)):
            raise self.printer.command_error(f"Position that is no number: {tuple(newpos)}")
        self.flush_step_generation()
        self._trapq_set_position(self.trapq, self.print_time, newpos[0], newpos[1], newpos[2])
        self.commanded_pos[:4] = newpos[:4]
        self.kin.set_position(newpos, homing_axes)
        self.printer.send_event("toolhead:set_position")

    def limit_next_junction_speed(self, speed: float) -> None:
        """The next move may not be entered faster than this (mm/s)."""
        self.lookahead.limit_last_cruise(speed)

    @done_in_c
    def move(self, newpos: Sequence[float], speed: float) -> None:
        """Queue a straight move to (x, y, z, e) at `speed` mm/s. Raises command_error; then nothing has changed."""
        move = Move(self, self.commanded_pos, newpos, speed)
        if not move.move_d:
            return
        if move.is_kinematic_move:
            self.kin.check_move(move)
        if move.axes_d[3]:
            self.extruder.check_move(move)
        for number, way in enumerate(move.extra_d):
            if way:
                self.extra_axes[number].check_move(AllAxesMove(move), 4 + number)
        self.commanded_pos[:4] = move.end_pos
        if move.extra_d:
            self.commanded_pos[4:] = newpos[4:]
        self.note_queued(self.lookahead.add_move(move, self.extruder))

    def note_queued(self, due: bool) -> None:
        """A move has come into the look-ahead queue; if due, it is time to plan."""
        if not self._watching:
            self._start_watch()
        if due:
            self._flush_lookahead(lazy=True)
            self._wait_for_room()

    def manual_move(self, coord: Sequence[float | None], speed: float) -> None:
        """Move the given coordinates (None: stay)."""
        curpos = self.get_position()
        for i, value in enumerate(coord):
            if value is not None:
                curpos[i] = value
        self.move(curpos, speed)
        self.printer.send_event("toolhead:manual_move")

    def dwell(self, delay: float) -> None:
        """Rest for `delay` seconds after the queued moves."""
        self.get_last_move_time()
        self._advance_print_time(self.print_time + max(0.0, delay))
        self._wait_for_room()

    def _advance_print_time(self, print_time: float) -> None:
        self.print_time = max(self.print_time, print_time)
        reach = self.print_time - self._streams.look_ahead_s()
        if reach - self._streams.done_time >= STEP_BATCH_S:
            self._streams.advance(reach, hold_back=False)

    def wait_moves(self) -> None:
        """Return when all that is queued has been done."""
        if not self.can_pause:  # nothing to wait for: the next line follows at once
            self._flush_lookahead()
            return
        self._settle()
        eventtime = self.reactor.monotonic()
        while not self.printer.is_shutdown() and self.print_time >= self.mcu.estimated_print_time(eventtime):
            eventtime = self.reactor.pause(eventtime + WAIT_POLL_S)

    def flush_step_generation(self) -> None:
        """All that is queued becomes steps and goes to the MCUs."""
        self._settle()

    def get_last_move_time(self) -> float:
        """print_time at which the queued moves end; the next move begins there."""
        self._flush_lookahead()
        if self._at_rest:
            self._start_motion()
            if not self._watching:
                self._start_watch()
        return self.print_time

    def drip_move(self, newpos: Sequence[float], speed: float, drip_completion: Any) -> None:
        """A move whose steps are worked out only just in time, until done or until the completion is set."""
        self.flush_step_generation()
        move = Move(self, self.commanded_pos, newpos, speed)
        if not move.move_d:
            return
        if move.is_kinematic_move:
            self.kin.check_move(move)
        if move.axes_d[3]:
            self.extruder.check_move(move)
        self.lookahead.add_move(move, self.extruder)
        start = self._begin_drip(move)
        self.commanded_pos[:4] = move.end_pos
        self._drip(start, drip_completion)

    def _begin_drip(self, move: Move) -> float:
        """Plan the lone queued move into the head's motion queue without making steps of it; returns its start."""
        self._go_on()
        self.lookahead.flush()
        self._trapq_append(
            self.trapq, self.print_time, move.accel_t, move.cruise_t, move.decel_t,
            *move.start_pos[:3], *move.axes_r[:3], move.start_v, move.cruise_v, move.accel,
        )  # fmt: skip
        start = self.print_time
        self.print_time += move.accel_t + move.cruise_t + move.decel_t
        self._motion_end = self.print_time
        return start

    def _drip(self, start: float, completion: Any) -> None:
        """Work out the steps of the queued drip move, just in time."""
        # shaping and smoothing spread the motion over this much after its end
        end = self.print_time + self._streams.look_ahead_s()
        time = self._streams.drip(self.mcu, start, end, completion) if self.can_pause else end
        if time < end:  # stopped by the trigger: the rest of the plan is void
            self._cut_plan(min(self.print_time, time + self._streams.look_ahead_s()))
        # all of it now: once the motors have reported where they halted, no step of this move may follow
        self._streams.advance(self.print_time + self._streams.look_ahead_s(), hold_back=False)
        self._start_watch()  # the timer may have gone to sleep until the end of the whole, uninterrupted move

    def _cut_plan(self, print_time: float) -> None:
        """The head rests from print_time on, at its planned place. Shaped and smoothed motion runs out without a
        jump (the motors have been halted already; homing finds out where)."""
        self.print_time = self._motion_end = print_time
        self._lib.trapq_state_at(self.trapq, print_time, self._cut_xyz, self._cut_speed)
        self._trapq_set_position(self.trapq, print_time, *self._cut_xyz)

    # -- who else wants to know --

    def register_move_listener(self, listener: Callable[..., None], as_records: bool = False) -> None:
        """Call listener(moves) with every batch of moves whose times are fixed (print_time, speeds, accel). As records:
        listener(row, count, print_time), for the first moves of the look-ahead's row, the first from print_time on."""
        (self._record_listeners if as_records else self._listeners).append(listener)

    def register_lookahead_callback(self, callback: Callable[[float], None]) -> None:
        """Call callback(print_time) with the end of the last queued move, as soon as that is known."""
        last = self.lookahead.get_last()
        if last is None:
            callback(self.get_last_move_time())
        elif last.timing_callbacks is None:
            last.timing_callbacks = [callback]
        else:
            last.timing_callbacks.append(callback)

    @property
    def step_generators(self) -> stepstream.Generators:
        return self._streams.generators

    @step_generators.setter
    def step_generators(self, generators: list[Callable[[float], None]]) -> None:
        """Plugins begin with an empty list. There is one for all toolheads."""

    def _flush_handler(self, *times: float) -> float:
        """Plugins hand it to a timer or to motion_queuing. `_watch` does the work."""
        return self.reactor.NEVER

    _handle_step_flush = _check_flush_lookahead = _flush_handler

    def register_step_generator(self, handler: Callable[[float], None]) -> None:
        """Call handler(print_time) whenever steps up to print_time are being worked out."""
        self._streams.generators.append(handler)

    def unregister_step_generator(self, handler: Callable[[float], None]) -> None:
        self._streams.generators.remove(handler)

    def note_mcu_movequeue_activity(self, mq_time: float, set_step_gen_time: bool = False) -> None:
        """Something else than a stepper uses an MCU's move queue up to mq_time: steps must not lag behind it.

        set_step_gen_time: there is motion beside the head's, in a queue of its own, until mq_time."""
        if set_step_gen_time:
            self._others_end = max(self._others_end, mq_time)
            if not self._watching:
                self._start_watch()

    # -- parts --

    def get_trapq(self) -> Any:
        return self.trapq

    def get_kinematics(self) -> Any:
        return self.kin

    def get_extruder(self) -> Any:
        return self.extruder

    def set_extruder(self, extruder: Any, extrude_pos: float) -> None:
        """Another extruder takes part in the moves from now on; extrude_pos is its position."""
        self._flush_lookahead()
        self.extruder = extruder
        self.commanded_pos[3] = extrude_pos

    def add_extra_axis(self, extra_axis: Any, axis_pos: float) -> None:
        """One more axis for G1 (see extras/manual_stepper.py); it stands at axis_pos."""
        self.flush_step_generation()
        self.extra_axes.append(extra_axis)
        self.commanded_pos.append(axis_pos)
        self.printer.send_event("toolhead:update_extra_axes")

    def remove_extra_axis(self, extra_axis: Any) -> None:
        if extra_axis in self.extra_axes:
            self.flush_step_generation()
            number = self.extra_axes.index(extra_axis)
            del self.extra_axes[number], self.commanded_pos[4 + number]
            self.printer.send_event("toolhead:update_extra_axes")

    def get_extra_axes(self) -> list[Any]:
        """What stands behind each number of a position: nothing for x, y, z, then the extruder and further axes."""
        return [None, None, None, self.extruder, *self.extra_axes]

    # -- reports --

    def check_busy(self, eventtime: float) -> tuple[float, float, bool]:
        """(print_time, estimated now, nothing waits in the look-ahead queue)."""
        return self.print_time, self.mcu.estimated_print_time(eventtime), not self.lookahead

    def stats(self, eventtime: float) -> tuple[bool, str]:
        now = self.mcu.estimated_print_time(eventtime)
        buffer_time = max(0.0, self.print_time - now)
        active = buffer_time > -10.0 and (bool(self.lookahead) or not self._at_rest)
        return active, (
            f"print_time={self.print_time:.3f} buffer_time={buffer_time:.3f} print_stall={self.print_stall}"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        status = dict(self.kin.get_status(eventtime))
        status.update(
            print_time=self.print_time,
            stalls=self.print_stall,
            estimated_print_time=self.mcu.estimated_print_time(eventtime),
            extruder=self.extruder.get_name(),
            position=Coord(*self.commanded_pos[:4]),
            max_velocity=self.max_velocity,
            max_accel=self.max_accel,
            minimum_cruise_ratio=self.min_cruise_ratio,
            square_corner_velocity=self.square_corner_velocity,
            extra_axes={
                axis.get_name(): number
                for number, axis in enumerate(self.get_extra_axes())
                if hasattr(axis, "get_name")
            },
        )
        return status

    def _handle_shutdown(self) -> None:
        self.can_pause = False
        self.lookahead.reset()

    # -- commands --

    def cmd_G4(self, gcmd: Any) -> None:
        """G4 P<milliseconds>."""
        self.dwell(gcmd.get_float("P", 0.0, **motionlimits.DWELL_MS) / 1000.0)

    def cmd_M400(self, gcmd: Any) -> None:
        """Wait for the moves to end."""
        self.wait_moves()


def add_printer_objects(config: Any) -> None:
    """Called once at start: the toolhead and its extruders."""
    printer = config.get_printer()
    printer.add_object("toolhead", ToolHead(config.getsection("printer")))
    from kinematics import extruder

    extruder.add_printer_objects(config)
