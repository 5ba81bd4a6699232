"""[print_recovery]: after a crash of the host or a shutdown, go on with the print where the head stopped.

    while printing, every interval      checkpoint that has been carried out ─► journal (two slots, checksums)
    shutdown, or start after a crash    step counts of the boards ─────────────► journal
    ready                               place of the head ─► its place in the file ─► offered or refused
    ready after the reset of a board    X and Y are homed: how far the head goes says where it stood ─► as above

The boards keep their step counts while they have power and are not reset. So the place where the head stopped is
read, not estimated. After a board's reset it is measured: the counts begin at 0 where the head stood, and homing says
where 0 is. That needs a host that saw the reset, and motor drivers that kept their power: one that starts again
turns its motor by up to two full steps.
"""

from __future__ import annotations

import json
import logging
import os
import zlib
from dataclasses import asdict, dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

from .recovery import path
from .recovery.journal import Journal
from .recovery.path import Refusal

NOTHING = "there is no print to resume"
PA_FLOW_MM_S = 15.0  # pressure advance moves the filament by that much times its seconds [assumed peak]
SETTLE_POLL_S, SETTLE_S = 0.25, 5.0  # of motors that still run when a crashed host comes back
RESET = "spontaneous restart"  # what a board's end is called that has reset itself
MARGIN_S = 0.1  # of the times of a reset: shapers move the head that much sooner or later than the path


@dataclass(frozen=True, slots=True)
class Settings:
    """`lift_mm`, `speed_mm_s`: of the way back; `z_stays`: Z does not sink without current; `drivers_stay_on`: motor
    drivers keep their power while their board is reset."""

    file: str
    interval_s: float
    lift_mm: float
    speed_mm_s: float
    z_stays: bool
    drivers_stay_on: bool


class PrintRecovery:
    """The object `print_recovery`."""

    def __init__(self, printer: Printer, settings: Settings) -> None:
        self.printer = printer
        self.settings = settings
        self.reactor = printer.get_reactor()
        self.gcode: Any = printer.lookup_object("gcode")
        self.journal = Journal(os.path.expanduser(settings.file))
        self._waiting: list[
            tuple[float, dict[str, Any]]
        ] = []  # checkpoints not carried out yet, with their times
        self._done: dict[str, Any] | None = None  # the newest that has been
        self._certain: list[
            tuple[float, dict[str, Any]]
        ] = []  # those since the board's last answer, and the one before
        self._homed: set[int] = set()
        self._place: path.Place | None = None
        self._reason = NOTHING
        self._state = "none"
        self._printing_s = 0.0

    def register(self) -> None:
        """Make commands and events known."""
        self.journal.read()
        for name in ("RECOVER_PRINT", "RECOVER_DISCARD"):
            command = getattr(self, f"cmd_{name}")
            self.gcode.register_command(name, command, desc=getattr(self, f"cmd_{name}_help"))
        for event, handler in (
            ("mcu:left_over", self._note_left_over),
            ("klippy:ready", self._handle_ready),
            ("klippy:shutdown", self._handle_shutdown),
            ("toolhead:set_position", self._forget),
            ("mcu:explain_shutdown", self._note_reset),
            ("homing:home_rails_end", self._note_homing),
        ):
            self.printer.register_event_handler(event, handler)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """What front ends offer."""
        minutes = self._printing_s / 60.0
        return {
            "state": self._state,
            "reason": self._reason,
            "file": self.journal.record.get("file", {}).get("path", "") if self._state != "none" else "",
            "position": list(self._place.point) if self._place else None,
            "file_position": self._place.segment.offset if self._place else None,
            "bytes_per_minute": self.journal.bytes_written / minutes if minutes else 0.0,
        }

    # --- while printing ---
    def _handle_ready(self) -> None:
        self._look()
        timer = self.reactor.register_timer(self._on_timer)
        self.reactor.update_timer(timer, self.reactor.monotonic() + self.settings.interval_s)

    def _on_timer(self, eventtime: float) -> float:
        try:
            if not self.gcode.get_mutex().test():  # else homing may be half done
                self._measure()
            state = self.printer.lookup_object("print_stats").state
            if state == "printing":
                self._printing_s += self.settings.interval_s
                if self._done is None and self.journal.record:  # of a print before this one
                    self._discard()
                self._keep()
            elif state != "paused" and self._done is not None:
                self._forget()
        except Exception as e:  # the print goes on without a record
            logging.exception("print_recovery")
            self.gcode.respond_error(
                f"print_recovery: no record is kept from now on: {self.journal.path}: {e}"
            )
            return self.reactor.NEVER
        return self.reactor.monotonic() + self.settings.interval_s

    def _keep(self) -> None:
        """A checkpoint of now, between two lines; what has been carried out goes into the journal."""
        sdcard, toolhead = (self.printer.lookup_object(name) for name in ("virtual_sdcard", "toolhead"))
        with self.gcode.get_mutex():
            if not sdcard.is_active() or self.printer.is_shutdown() or "span_s" in self.journal.record:
                return
            checkpoint = self._checkpoint(sdcard, toolhead)
            if toolhead.lookahead:
                toolhead.register_lookahead_callback(lambda end: self._waiting.append((end, checkpoint)))
            else:
                self._waiting.append((toolhead.print_time, checkpoint))
        now = toolhead.mcu.estimated_print_time(self.reactor.monotonic())
        while self._waiting and self._waiting[0][0] <= now:
            self._certain.append(self._waiting.pop(0))
            self._done = self._certain[-1][1]
            self.journal.write(self._done)
        reported = toolhead.mcu.reported_print_time()
        while len(self._certain) > 1 and self._certain[1][0] + MARGIN_S <= reported:
            del self._certain[0]

    def _checkpoint(self, sdcard: Any, toolhead: Any) -> dict[str, Any]:
        move, eventtime = self.printer.lookup_object("gcode_move"), self.reactor.monotonic()
        modes = move.modes
        state = path.State(
            list(move.last_position[:4]), list(modes.base_position[:4]), list(modes.homing_position[:4]),
            modes.absolute_coord, modes.absolute_extrude, modes.speed, modes.speed_factor, modes.extrude_factor,
        )  # fmt: skip
        heaters = self.printer.lookup_object("heaters")
        targets = {
            name: heaters.lookup_heater(name).get_temp(eventtime)[1] for name in heaters.get_all_heaters()
        }
        shift = max(abs(a - b) for a, b in zip(state.position, toolhead.get_position(), strict=False))
        return {
            "file": _identity(sdcard.file_path()),
            "config": self._config_sum(),
            "offset": sdcard.file_position,
            "state": asdict(state),
            "shifted": shift > 1e-6,
            "extruder": toolhead.get_extruder().get_name(),
            "origins": {s.get_name(): s.mcu_to_commanded_position(0) for s in self._steppers()},
            "targets": {name: target for name, target in targets.items() if target},
            "pressure_advance": toolhead.get_extruder().get_status(eventtime).get("pressure_advance", 0.0),
            "commands": self._commands(toolhead, eventtime),
        }

    def _commands(self, toolhead: Any, eventtime: float) -> list[str]:
        """What sets limits, pressure advance and fan as they are."""
        limits = toolhead.get_status(eventtime)
        commands = [
            f"SET_VELOCITY_LIMIT VELOCITY={limits['max_velocity']} ACCEL={limits['max_accel']} "
            f"MINIMUM_CRUISE_RATIO={limits['minimum_cruise_ratio']} "
            f"SQUARE_CORNER_VELOCITY={limits['square_corner_velocity']}"
        ]
        extruder, fan = toolhead.get_extruder().get_status(eventtime), self.printer.lookup_object("fan", None)
        if "pressure_advance" in extruder:
            advance, smooth_s = extruder["pressure_advance"], extruder["smooth_time"]
            commands.append(f"SET_PRESSURE_ADVANCE ADVANCE={advance} SMOOTH_TIME={smooth_s}")
        if fan is not None:
            commands.append(f"M106 S{fan.get_status(eventtime)['speed'] * 255.0:.3f}")
        return commands

    def _forget(self) -> None:
        """Nothing to resume: the print has ended, or coordinates have changed."""
        self._waiting.clear()
        self._certain.clear()
        if self._done is not None:
            self._done = None
            self.journal.write({})

    def _config_sum(self) -> int:
        return zlib.crc32(
            json.dumps(self.printer.lookup_object("configfile").get_status(0.0)["config"]).encode()
        )

    def _steppers(self) -> list[Any]:
        toolhead = self.printer.lookup_object("toolhead")
        motor = getattr(toolhead.get_extruder(), "extruder_stepper", None)
        return [*toolhead.get_kinematics().get_steppers(), *([motor.stepper] if motor else [])]

    # --- after the stop ---
    def _note_reset(self, mcu: Any, reason: str) -> None:
        """The board has reset itself: its motors stopped between its last answer and now."""
        steppers, now = self._steppers(), self.reactor.monotonic()
        if reason != RESET or not self._certain or any(s.get_mcu() is not mcu for s in steppers):
            return
        end, checkpoint = self._certain[0]
        if end + MARGIN_S > mcu.reported_print_time():
            return
        span_s = mcu.estimated_print_time(now) - end + MARGIN_S
        try:
            self.journal.write({**checkpoint, "span_s": span_s})
        except OSError as e:
            logging.warning("print_recovery: the place of the head is not known: %s", e)

    def _handle_shutdown(self) -> None:
        if self._done is not None and "span_s" not in self.journal.record:
            # the answers come through the reactor, which is in the middle of the shutdown
            self.reactor.register_callback(lambda eventtime: self._note_steps(self._steppers()))

    def _note_left_over(self, mcu: Any) -> None:
        """A board still has the steps of a host that has ended."""
        if not self.journal.record or "steps" in self.journal.record:
            return
        steppers = [stepper for stepper in self._steppers() if stepper.get_mcu() is mcu]
        until = self.reactor.monotonic() + SETTLE_S
        before: list[int] = []
        while self.reactor.monotonic() < until:
            try:
                steps = [stepper.ask_steps() for stepper in steppers]
            except self.printer.command_error:
                break
            if steps == before:
                break
            before = steps
            self.reactor.pause(self.reactor.monotonic() + SETTLE_POLL_S)
        self._note_steps(steppers)

    def _note_steps(self, steppers: list[Any]) -> None:
        record = dict(self.journal.record)
        try:
            found = {stepper.get_name(): stepper.ask_steps() for stepper in steppers}
            self.journal.write({**record, "steps": {**record.get("steps", {}), **found}})
        except (OSError, self.printer.command_error) as e:
            logging.warning("print_recovery: the place of the head is not known: %s", e)

    def _look(self) -> None:
        """Offer to resume the print in the journal, or say why not."""
        record = self.journal.record
        if not record:
            return
        try:
            if self._can_measure(record):
                self._check_unchanged(record)
                self._state, self._reason = "home_first", "X and Y are not homed"
                for stepper in self._steppers():
                    stepper.add_active_callback(self._note_motion)
            else:
                self._place = self.find(record)
                self._state, self._reason = "offered", ""
        except Refusal as e:
            self._state, self._reason = "refused", str(e)
        self._announce(record)

    def _announce(self, record: dict[str, Any]) -> None:
        offers = {
            "offered": "RECOVER_PRINT resumes it where it stopped; RECOVER_DISCARD forgets it.",
            "home_first": "A board was reset. RECOVER_PRINT homes X and Y to measure where the head stood, and resumes "
            "if that is one place of the file; RECOVER_DISCARD forgets it.",
        }
        name = os.path.basename(record["file"]["path"])
        offer = offers.get(self._state, f"It cannot be resumed: {self._reason}.")
        self.gcode.respond_info(f"The print of {name} was interrupted. {offer}")

    # --- after the reset of a board ---
    def _can_measure(self, record: dict[str, Any]) -> bool:
        return self.settings.drivers_stay_on and "span_s" in record and "moved" not in record

    def _note_motion(self, print_time: float) -> None:
        """From now on the counts of a further start do not begin where the head stood."""
        if self._state == "home_first" and "moved" not in self.journal.record:
            self.journal.write({**self.journal.record, "moved": True})

    def _note_homing(self, homing_state: Any, rails: Any) -> None:
        self._homed.update(homing_state.get_axes())

    def _measure(self) -> None:
        """X and Y have been homed: the place of step count 0 is where the head stood."""
        homed_axes = self.printer.lookup_object("toolhead").get_status(self.reactor.monotonic())["homed_axes"]
        if self._state != "home_first" or not self._homed >= {0, 1} or not set(homed_axes) >= {"x", "y"}:
            return
        record = self.journal.record
        other: list[str] = []

        def is_known(command: str) -> bool:
            if not self._is_known(command):
                return False
            other.append(command)
            return True

        try:
            origins = {s.get_name(): s.mcu_to_commanded_position(0) for s in self._steppers()}
            head = self.printer.lookup_object("toolhead").get_kinematics().calc_position(origins)
            full = list(self.full_steps_mm().values())
            tolerance = path.Tolerance(max(full[:-1]), full[-1])
            place = path.locate_flat(self._moves(record, is_known), head, record["span_s"], tolerance)
            if other:
                raise Refusal(f"{other[0]} may have moved the head")
            self._place, self._state, self._reason = place, "offered", ""
        except Refusal as e:
            self._state, self._reason = "refused", str(e)
            self._announce(record)

    # --- the place ---
    def _check_unchanged(self, record: dict[str, Any]) -> None:
        file = record["file"]
        if record["config"] != self._config_sum():
            raise Refusal("the configuration has changed since")
        if _identity(file["path"]) != file:
            raise Refusal(f"the file {file['path']} has changed since, or is gone")
        if record["shifted"]:
            raise Refusal("a bed mesh, a skew correction or the like was in force")
        toolhead = self.printer.lookup_object("toolhead")
        if toolhead.get_extruder().get_name() != record["extruder"]:
            raise Refusal(f"the active extruder was '{record['extruder']}'")

    def _moves(self, record: dict[str, Any], is_known: Any) -> Any:
        with open(record["file"]["path"], "rb") as source:
            source.seek(record["offset"])
            return path.moves(source.read(), record["offset"], path.State(**record["state"]), is_known)

    def _why_lost(self, record: dict[str, Any]) -> str:
        if "moved" in record:
            return "; motors have moved since"
        if "span_s" in record:
            return "; with drivers_stay_on: True in [print_recovery] homing measures where the head stood"
        return ""

    def find(self, record: dict[str, Any]) -> path.Place:
        """The place in the file where the head stopped, by the boards' step counts. Raises Refusal."""
        self._check_unchanged(record)
        toolhead = self.printer.lookup_object("toolhead")
        steppers, steps = self._steppers(), record.get("steps", {})
        missing = [s.get_name() for s in steppers if s.get_name() not in steps]
        if missing:
            raise Refusal(
                f"the step counts of {', '.join(missing)} are lost: a board was reset or lost its power"
                + self._why_lost(record)
            )
        places = {
            s.get_name(): record["origins"][s.get_name()] + steps[s.get_name()] * s.get_step_dist()
            for s in steppers
        }
        e_mm = places.get(steppers[-1].get_name(), 0.0)
        head = [*toolhead.get_kinematics().calc_position(places), e_mm]
        return path.locate(
            self._moves(record, self._is_known), head, self._tolerance(record["pressure_advance"])
        )

    def _is_known(self, command: str) -> bool:
        return self.gcode.get_handler(command) is not None

    def full_steps_mm(self) -> dict[str, float]:
        """Way of a full step of each motor of the print; the extruder's comes last."""
        settings = self.printer.lookup_object("configfile").get_status(0.0)["settings"]
        return {
            s.get_name(): s.get_step_dist() * settings[s.get_name()].get("microsteps", 1)
            for s in self._steppers()
        }

    def _tolerance(self, advance_s: float) -> path.Tolerance:
        full = list(self.full_steps_mm().values())
        return path.Tolerance(max(full[:-1]), full[-1] + advance_s * PA_FLOW_MM_S)

    # --- commands ---
    cmd_RECOVER_DISCARD_help = "Forget the interrupted print"

    def cmd_RECOVER_DISCARD(self, gcmd: GCodeCommand) -> None:
        """RECOVER_DISCARD."""
        self._discard()

    def _discard(self) -> None:
        try:
            self.journal.write({})
        except OSError as e:
            raise self.printer.command_error(f"{self.journal.path} cannot be written: {e}") from None
        self._place, self._state, self._reason = None, "none", NOTHING

    cmd_RECOVER_PRINT_help = "Resume the interrupted print where the head stopped"

    def cmd_RECOVER_PRINT(self, gcmd: GCodeCommand) -> None:
        """RECOVER_PRINT."""
        record = self.journal.record
        if self._state not in ("offered", "home_first"):
            raise gcmd.error(f"RECOVER_PRINT: the print cannot be resumed: {self._reason}")
        if _identity(record["file"]["path"]) != record["file"]:
            raise gcmd.error(f"RECOVER_PRINT: the file {record['file']['path']} has changed since")
        if self.printer.lookup_object("virtual_sdcard").is_active():
            raise gcmd.error("RECOVER_PRINT: a file is being printed")
        self._check_z(gcmd)
        self._heat(record)
        place = self._go_back(gcmd)
        self._discard()  # from here on more is printed than the record says
        self._go_on(record, place)

    def _is_z_homed(self) -> bool:
        toolhead = self.printer.lookup_object("toolhead")
        return "z" in toolhead.get_status(self.reactor.monotonic())["homed_axes"]

    def _check_z(self, gcmd: GCodeCommand) -> None:
        """Z is where it was, or has been homed."""
        if not self._is_z_homed() and not self.settings.z_stays:
            raise gcmd.error(
                "RECOVER_PRINT: the height of the nozzle is not known. Home Z beside the part, or, if the Z axis does "
                "not sink without current, set z_stays: True in [print_recovery]."
            )

    def _set_z(self, z: float) -> None:
        toolhead = self.printer.lookup_object("toolhead")
        position = toolhead.get_position()
        toolhead.set_position([*position[:2], z, *position[3:]], homing_axes="z")

    def _heat(self, record: dict[str, Any]) -> None:
        heaters = self.printer.lookup_object("heaters")
        for wait in (False, True):
            for name, target_c in record["targets"].items():
                heaters.set_temperature(heaters.lookup_heater(name), target_c, wait)

    def _go_back(self, gcmd: GCodeCommand) -> path.Place:
        """Up, home X and Y, over the place, down."""
        toolhead, speed = self.printer.lookup_object("toolhead"), self.settings.speed_mm_s
        is_z_homed = self._is_z_homed()
        if not is_z_homed:
            self._set_z(self._place.point[2] if self._place else self.journal.record["state"]["position"][2])
        below = toolhead.get_position()[2]
        toolhead.manual_move([None, None, below + self.settings.lift_mm], speed)
        self.gcode.run_script_from_command("G28 X Y")
        self._measure()
        if self._place is None:
            raise gcmd.error(f"RECOVER_PRINT: the print cannot be resumed: {self._reason}")
        x, y, z = self._place.point[:3]
        if not is_z_homed:
            self._set_z(toolhead.get_position()[2] - below + z)
        toolhead.manual_move([x, y, None], speed)
        toolhead.manual_move([x, y, z], speed)
        return self._place

    def _go_on(self, record: dict[str, Any], place: path.Place) -> None:
        """The modes as they were, the rest of the interrupted move, then the file."""
        sdcard, move = (self.printer.lookup_object(name) for name in ("virtual_sdcard", "gcode_move"))
        with open(record["file"]["path"], "rb") as source:
            source.seek(record["offset"])
            between = source.read(place.segment.offset - record["offset"])
        folder = sdcard.sdcard_dirname
        self.gcode.run_script_from_command(f"M23 {os.path.relpath(record['file']['path'], folder)}")
        for line in [*record["commands"], *path.skipped(between)]:
            self.gcode.run_script_from_command(line)
        self._restore_modes(move, place)
        sdcard.set_file_position(place.segment.offset)
        sdcard.do_resume()

    def _restore_modes(self, move: Any, place: path.Place) -> None:
        state, modes = place.segment.state, move.modes
        move.reset_last_position()
        e_shift = move.last_position[3] - place.point[3]
        modes.absolute_coord, modes.absolute_extrude = state.absolute_coord, state.absolute_extrude
        modes.speed, modes.speed_factor = state.speed, state.speed_factor
        modes.extrude_factor = state.extrude_factor
        modes.homing_position = list(state.homing)
        modes.base_position[:4] = [*state.base[:3], state.base[3] + e_shift]
        target = [*state.position[:3], state.position[3] + e_shift]
        move.transform.move([*target, *move.last_position[4:]], state.velocity)
        move.reset_last_position()


def _identity(file: str) -> dict[str, Any]:
    """A file that is the same has the same of these."""
    try:
        facts = os.stat(file)
    except OSError:
        return {}
    return {"path": os.path.realpath(file), "size": facts.st_size, "mtime_ns": facts.st_mtime_ns}


def load_config(config: ConfigWrapper) -> PrintRecovery:
    """Section [print_recovery]."""
    printer = config.get_printer()
    for name in ("virtual_sdcard", "gcode_move", "print_stats"):
        printer.load_object(config, name)
    recovery = PrintRecovery(
        printer,
        Settings(
            config.get("filename"),
            config.getfloat("interval", 1.0, minval=0.1, maxval=60.0),
            config.getfloat("lift", 2.0, minval=0.0),
            config.getfloat("speed", 50.0, above=0.0),
            config.getboolean("z_stays", False),
            config.getboolean("drivers_stay_on", False),
        ),
    )
    recovery.register()
    return recovery
