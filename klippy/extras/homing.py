"""Homing: drive to an endstop, learn where it is, come back slowly to learn it well. G28.

HomingMove      one move towards endstops: arms them, runs the move just in time, and works out where the
                head was when they triggered
Homing          the state of one G28, handed to the kinematics
PrinterHoming   printer object 'homing'
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

# An endstop is looked at this often at least while homing (s); also bounded to about a step.
ENDSTOP_SAMPLE_S = 0.000015
ENDSTOP_SAMPLE_COUNT = 4
ENDSTOP_REST_MAX_S = 0.001
# From arming the endstops to the start of the move.
HOMING_START_DELAY_S = 0.001
AXES = "XYZ"


@dataclass(slots=True)
class StepperPosition:
    """One stepper over one homing move; positions in steps."""

    stepper: Any
    endstop_name: str
    start_pos: int
    start_cmd_pos: float
    halt_pos: int = 0
    trig_pos: int = 0

    @property
    def stepper_name(self) -> str:
        return self.stepper.get_name()

    def note_home_end(self, trigger_time: float) -> None:
        self.halt_pos = self.stepper.get_mcu_position()
        self.trig_pos = self.halt_pos
        if not self.stepper.get_mcu().is_fileoutput():  # there the trigger is the end of the move
            self.trig_pos = self.stepper.get_past_mcu_position(trigger_time)

    def moved(self, steps: int) -> float:
        """mm (rad) from the start to a position in steps."""
        return (steps - self.start_pos) * self.stepper.get_step_dist()


class HomingMove:
    """A move towards one or more endstops."""

    def __init__(self, printer: Printer, endstops: Sequence[tuple[Any, str]], toolhead: Any = None) -> None:
        self.printer = printer
        self.endstops = [(e, n) for e, n in endstops if e.get_steppers()]
        self.toolhead = toolhead or printer.lookup_object("toolhead")
        self.stepper_positions: list[StepperPosition] = []

    def get_mcu_endstops(self) -> list[Any]:
        return [endstop for endstop, _name in self.endstops]

    def _rest_time(self, endstop: Any, movepos: Sequence[float], speed: float) -> float:
        """Time between two looks at the endstop: the fastest stepper's time for a step."""
        startpos = self.toolhead.get_position()
        distance = math.dist(startpos[:3], movepos[:3])
        kin = self.toolhead.get_kinematics()
        steps = [
            abs(s.calc_position_from_coord(movepos) - s.calc_position_from_coord(startpos))
            / s.get_step_dist()
            for s in endstop.get_steppers()
            if s in kin.get_steppers()
        ]
        max_steps = max(steps, default=0.0)
        if max_steps <= 0.0 or distance <= 0.0:
            return ENDSTOP_REST_MAX_S
        return min(ENDSTOP_REST_MAX_S, distance / speed / max_steps)

    def _calc_toolhead_pos(self, moved: dict[str, float]) -> list[float]:
        """Position of the head when each stepper has gone `moved` mm from the start of the move."""
        kin = self.toolhead.get_kinematics()
        for position in self.stepper_positions:
            name = position.stepper_name
            self._kin_spos[name] = position.start_cmd_pos + moved.get(name, 0.0)
        xyz = kin.calc_position(self._kin_spos)
        old = self.toolhead.get_position()
        return [new if new is not None else was for new, was in zip(xyz, old[:3], strict=False)] + old[3:]

    def homing_move(
        self,
        movepos: Sequence[float],
        speed: float,
        probe_pos: bool = False,
        triggered: bool = True,
        check_triggered: bool = True,
    ) -> list[float]:
        """Move until every endstop has triggered; returns where the head was then (probe_pos) or stands now."""
        self.printer.send_event("homing:homing_move_begin", self)
        toolhead = self.toolhead
        toolhead.flush_step_generation()
        kin = toolhead.get_kinematics()
        self._kin_spos = {s.get_name(): s.get_commanded_position() for s in kin.get_steppers()}
        self.stepper_positions = [
            StepperPosition(s, name, s.get_mcu_position(), s.get_commanded_position())
            for endstop, name in self.endstops
            for s in endstop.get_steppers()
        ]
        completion = self._arm(movepos, speed, triggered)
        toolhead.dwell(HOMING_START_DELAY_S)
        problem = None
        try:
            toolhead.drip_move(movepos, speed, completion)
        except self.printer.command_error as e:
            problem = f"Error during homing move: {e}"
        trigger_times, missing = self._wait(
            toolhead.get_last_move_time(), problem is None and check_triggered
        )
        toolhead.flush_step_generation()
        for position in self.stepper_positions:
            position.note_home_end(trigger_times.get(position.endstop_name, toolhead.get_last_move_time()))
        result = self._set_position(movepos, probe_pos)
        for name in missing:
            problem = problem or f"No trigger on {name} after full movement"
        try:
            self.printer.send_event("homing:homing_move_end", self)
        except self.printer.command_error as e:
            problem = problem or str(e)
        if problem is not None:
            raise self.printer.command_error(problem)
        return result

    def _arm(self, movepos: Sequence[float], speed: float, triggered: bool) -> Any:
        """Start watching; returns a completion for "all have triggered"."""
        print_time = self.toolhead.get_last_move_time()
        completions = [
            endstop.home_start(
                print_time,
                ENDSTOP_SAMPLE_S,
                ENDSTOP_SAMPLE_COUNT,
                self._rest_time(endstop, movepos, speed),
                triggered=triggered,
            )
            for endstop, _name in self.endstops
        ]
        if len(completions) == 1:
            return completions[0]
        reactor = self.printer.get_reactor()

        def wait_for_all(eventtime: float) -> bool:
            for completion in completions:
                completion.wait()
            return True

        return reactor.register_callback(wait_for_all)

    def _wait(self, end_time: float, check_triggered: bool) -> tuple[dict[str, float], list[str]]:
        """(trigger time by endstop name, names of endstops that did not trigger)."""
        times: dict[str, float] = {}
        missing = []
        for endstop, name in self.endstops:
            trigger_time = endstop.home_wait(end_time)
            if trigger_time > 0.0:
                times[name] = trigger_time
            elif check_triggered:
                missing.append(name)
        return times, missing

    def _set_position(self, movepos: Sequence[float], probe_pos: bool) -> list[float]:
        """Set the toolhead's position to where it really stopped."""
        if not probe_pos:
            # homing: the trigger *is* the place the move was to end at; what was run on after it comes on top
            halt_pos = self._place_by_overrun(movepos)
            self.toolhead.set_position(halt_pos)
            return halt_pos
        halted = {p.stepper_name: p.moved(p.halt_pos) for p in self.stepper_positions}
        triggered = {p.stepper_name: p.moved(p.trig_pos) for p in self.stepper_positions}
        trigger_pos = self._calc_toolhead_pos(triggered)
        self.toolhead.set_position(self._calc_toolhead_pos(halted))
        return trigger_pos

    def _place_by_overrun(self, trigger_pos: Sequence[float]) -> list[float]:
        """Where the head stands if it was at trigger_pos at the trigger."""
        overrun = {p.stepper_name: p.moved(p.halt_pos) - p.moved(p.trig_pos) for p in self.stepper_positions}
        if self.toolhead.mcu.is_fileoutput() or not any(overrun.values()):
            return list(trigger_pos)
        kin = self.toolhead.get_kinematics()
        spos = {
            s.get_name(): s.calc_position_from_coord(trigger_pos) + overrun.get(s.get_name(), 0.0)
            for s in kin.get_steppers()
        }
        xyz = kin.calc_position(spos)
        return [was if new is None else new for new, was in zip(xyz, trigger_pos[:3], strict=False)] + list(
            trigger_pos[3:]
        )

    def check_no_movement(self) -> str | None:
        """Name of an endstop that was triggered before the move began, if any."""
        if self.printer.get_start_args().get("debuginput") is not None:
            return None
        for position in self.stepper_positions:
            if position.start_pos == position.trig_pos:
                return position.endstop_name
        return None


class Homing:
    """What a kinematics needs to home its rails."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.toolhead = printer.lookup_object("toolhead")
        self.changed_axes: list[int] = []
        self.trigger_mcu_pos: dict[str, int] = {}
        self.adjust_pos: dict[str, float] = {}

    def set_axes(self, axes: list[int]) -> None:
        self.changed_axes = axes

    def get_axes(self) -> list[int]:
        return self.changed_axes

    def get_trigger_position(self, stepper_name: str) -> int:
        """Steps of a stepper at the last trigger."""
        return self.trigger_mcu_pos[stepper_name]

    def set_stepper_adjustment(self, stepper_name: str, adjustment: float) -> None:
        """A listener of home_rails_end knows better: shift this stepper's position by mm."""
        self.adjust_pos[stepper_name] = adjustment

    def _fill_coord(self, coord: Sequence[float | None]) -> list[float]:
        """Set the position of each axis; None keeps it."""
        current = self.toolhead.get_position()
        return [was if new is None else new for new, was in zip(coord, current, strict=False)]

    def set_homed_position(self, pos: Sequence[float | None]) -> None:
        self.toolhead.set_position(self._fill_coord(pos))

    def home_rails(
        self, rails: Sequence[Any], forcepos: Sequence[float | None], movepos: Sequence[float | None]
    ) -> None:
        """Home rails together: from forcepos (assumed) to movepos (where the endstop is)."""
        self.printer.send_event("homing:home_rails_begin", self, rails)
        homing_axes = [axis for axis in range(3) if forcepos[axis] is not None]
        startpos = self._fill_coord(forcepos)
        homepos = self._fill_coord(movepos)
        self.toolhead.set_position(startpos, homing_axes=homing_axes)
        endstops = [endstop for rail in rails for endstop in rail.get_endstops()]
        info = rails[0].get_homing_info()
        move = HomingMove(self.printer, endstops)
        self._rest()
        move.homing_move(homepos, info.speed)
        if info.retract_dist:
            move = self._approach_again(info, endstops, startpos, homepos)
        self._finish(rails, move, homepos, homing_axes)

    def _rest(self) -> None:
        """Separate motion before and after: all steps are sent, and the next move begins a little later."""
        self.toolhead.get_last_move_time()
        self.toolhead.flush_step_generation()

    def _approach_again(
        self, info: Any, endstops: Any, startpos: list[float], homepos: list[float]
    ) -> HomingMove:
        """Back off and come again at the second speed."""
        start, home = list(startpos), list(homepos)
        # motors that turn several axes do not halt at the same step: the other axes stay where that has put them
        for axis, place in enumerate(self.toolhead.get_position()[:3]):
            if start[axis] == home[axis]:
                start[axis] = home[axis] = place
        axes_d = [h - s for h, s in zip(home, start, strict=True)]
        move_d = math.dist(home[:3], start[:3])
        share = min(1.0, info.retract_dist / move_d)
        retractpos = [h - d * share for h, d in zip(home, axes_d, strict=True)]
        self.toolhead.move(retractpos, info.retract_speed)
        again = [r - d * share for r, d in zip(retractpos, axes_d, strict=True)]
        self.toolhead.set_position(again)
        move = HomingMove(self.printer, endstops)
        self._rest()
        move.homing_move(home, info.second_homing_speed)
        name = move.check_no_movement()
        if name is not None:
            raise self.printer.command_error(f"Endstop {name} still triggered after retract")
        return move

    def _finish(
        self, rails: Sequence[Any], move: HomingMove, homepos: list[float], homing_axes: list[int]
    ) -> None:
        """The trigger happened at homepos: place the head by how far each stepper ran on after it."""
        self._rest()
        self.trigger_mcu_pos = {p.stepper_name: p.trig_pos for p in move.stepper_positions}
        self.adjust_pos = {}
        self.printer.send_event("homing:home_rails_end", self, rails)
        kin = self.toolhead.get_kinematics()
        homed = self._fill_coord(homepos)
        overrun = {
            p.stepper_name: (p.halt_pos - p.trig_pos) * p.stepper.get_step_dist()
            for p in move.stepper_positions
        }
        if not any(overrun.values()) and not any(self.adjust_pos.values()):
            self.toolhead.set_position(homed, homing_axes=homing_axes)
            return
        spos = {
            s.get_name(): s.calc_position_from_coord(homed)
            + overrun.get(s.get_name(), 0.0)
            + self.adjust_pos.get(s.get_name(), 0.0)
            for s in kin.get_steppers()
        }
        place = kin.calc_position(spos)
        homed[:3] = [was if new is None else new for new, was in zip(place, homed[:3], strict=False)]
        self.toolhead.set_position(homed, homing_axes=homing_axes)


class PrinterHoming:
    """Printer object 'homing'."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer

    def register_commands(self) -> None:
        self.printer.lookup_object("gcode").register_command("G28", self.cmd_G28)

    def manual_home(
        self,
        toolhead: Any,
        endstops: Sequence[tuple[Any, str]],
        pos: Sequence[float],
        speed: float,
        triggered: bool,
        check_triggered: bool,
    ) -> None:
        """A homing move of something other than the kinematics' rails."""
        HomingMove(self.printer, endstops, toolhead).homing_move(
            pos, speed, triggered=triggered, check_triggered=check_triggered
        )

    def probing_move(self, mcu_probe: Any, pos: Sequence[float], speed: float) -> list[float]:
        """Move until the probe triggers; returns where the head was then."""
        move = HomingMove(self.printer, [(mcu_probe, "probe")])
        result = move.homing_move(pos, speed, probe_pos=True)
        if move.check_no_movement() is not None:
            raise self.printer.command_error("Probe triggered prior to movement")
        return result

    def cmd_G28(self, gcmd: GCodeCommand) -> None:
        """G28 [X] [Y] [Z]: home these axes, all without any."""
        params = gcmd.get_command_parameters()
        axes = [number for number, name in enumerate(AXES) if name in params] or [0, 1, 2]
        homing = Homing(self.printer)
        homing.set_axes(axes)
        kin = self.printer.lookup_object("toolhead").get_kinematics()
        try:
            kin.home(homing)
        except self.printer.command_error as e:
            if self.printer.is_shutdown():
                raise self.printer.command_error("Homing failed due to printer shutdown") from e
            self.printer.lookup_object("stepper_enable").motor_off()
            raise


def load_config(config: ConfigWrapper) -> PrinterHoming:
    homing = PrinterHoming(config.get_printer())
    homing.register_commands()
    return homing
