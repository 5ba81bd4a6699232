"""[exclude_object]: leaves out single objects of a running print.

    G-code ─► gcode_move ─► ObjectFilter ─► (what was there before: mesh, toolhead)

The slicer marks where each object begins and ends. Moves of an excluded object only change the *commanded*
position; the toolhead stays. The first move after them goes straight to its place. Filament is the difficulty:
skipped retractions and skipped primes must not add up to a nozzle that starts empty or oozing. So how deep the
filament is drawn back is followed for both sides, commanded and real, and evened out where the print goes on.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from lookahead import done_in_c
from roles import Printer

_E = 3
_EVEN_OUT_MM_S = (
    30.0  # speed of the retraction or prime that evens out; the extruder's own limits hold as well
)


class ObjectFilter:
    """Position transform that swallows moves while `skipping`.

    Commanded and real extruder position differ by what was left out: real = commanded - `_left_out_mm`.
    """

    def __init__(self, following: Any) -> None:
        self.next_transform = following
        self.skipping = False
        self._stopped_at: list[float] | None = None  # real position while moves are left out
        self._commanded = list(following.get_position())
        self._left_out_mm = 0.0
        self._peak_mm = self._commanded[
            _E
        ]  # highest commanded extruder position: retraction is counted from it
        self._real_depth_mm = 0.0
        self._prime_mm = 0.0  # to be pushed forward before the next extrusion
        ffi, lib = chelper.get_ffi()
        self._stage = ffi.new("struct path_stage *", {"kind": lib.PATH_SHIFT})

    def get_position(self) -> list[float]:
        """The commanded position; if the toolhead was moved past us (homing), where it is now."""
        real = list(self.next_transform.get_position())
        if self._stopped_at is not None and real == self._stopped_at:
            return list(self._commanded)
        commanded = [*real[:_E], real[_E] + self._left_out_mm + self._prime_mm, *real[_E + 1 :]]
        self._commanded = list(commanded)
        self._peak_mm = max(self._peak_mm, commanded[_E])
        return commanded

    def row_stage(self) -> Any:
        """For a row of moves (path_stage.h); None while moves or a prime are left out."""
        if self.skipping or self._stopped_at is not None or self._prime_mm:
            return None
        stage = self._stage
        stage.peak_e, stage.left_out_e = self._peak_mm, self._left_out_mm
        stage.last = self._commanded[:4]
        return stage

    def take_row(self, stage: Any) -> None:
        """Such a row has been run."""
        self._peak_mm = stage.peak_e
        self._commanded[:4] = stage.last

    @done_in_c
    def move(self, newpos: Sequence[float], speed: float) -> None:
        """One move of the G-code."""
        before_mm = self._commanded[_E]
        depth_before_mm = self._peak_mm - before_mm
        self._peak_mm = max(self._peak_mm, newpos[_E])
        if self.skipping:
            if self._stopped_at is None:
                self._stopped_at = list(self.next_transform.get_position())
                self._real_depth_mm = depth_before_mm + self._prime_mm
                self._prime_mm = 0.0
            self._commanded = list(newpos)
            return
        if self._stopped_at is not None:
            self._go_on(before_mm, depth_before_mm)
        if self._prime_mm and newpos[_E] > before_mm:
            self._push(self._prime_mm)
            self._prime_mm = 0.0
        self._commanded = list(newpos)
        real_e_mm = newpos[_E] - self._left_out_mm - self._prime_mm
        self.next_transform.move([*newpos[:_E], real_e_mm, *newpos[_E + 1 :]], speed)

    def _go_on(self, commanded_e_mm: float, depth_mm: float) -> None:
        """The first move after an excluded object: make the real retraction that of the G-code."""
        self._stopped_at = None
        real_e_mm = self.next_transform.get_position()[_E]
        missing_mm = self._real_depth_mm - depth_mm  # > 0: drawn back farther than in the G-code
        self._left_out_mm = commanded_e_mm - real_e_mm - missing_mm
        if missing_mm > 0.0:
            self._prime_mm = missing_mm
        elif missing_mm < 0.0:
            self._push(missing_mm)

    def _push(self, distance_mm: float) -> None:
        position = list(self.next_transform.get_position())
        position[_E] += distance_mm
        self.next_transform.move(position, _EVEN_OUT_MM_S)


class ExcludeObject:
    """The object `exclude_object`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.gcode = printer.lookup_object("gcode")
        self.objects: list[dict[str, Any]] = []
        self.excluded_objects: list[str] = []
        self.current_object: str | None = None
        self._filter: ObjectFilter | None = None
        self._before: Any = None

    def register(self) -> None:
        """Make commands and events known."""
        self.printer.register_event_handler("virtual_sdcard:reset_file", self._forget)
        for name, text in (
            ("EXCLUDE_OBJECT_START", "Marks the beginning the current object as labeled"),
            ("EXCLUDE_OBJECT_END", "Marks the end the current object"),
            ("EXCLUDE_OBJECT", "Cancel moves inside a specified objects"),
            ("EXCLUDE_OBJECT_DEFINE", "Provides a summary of an object"),
        ):
            self.gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def get_status(self, eventtime: float = 0.0) -> dict[str, Any]:
        """Known objects with what the slicer said of them, names of the excluded ones, the one being printed."""
        return {
            "objects": self.objects,
            "excluded_objects": self.excluded_objects,
            "current_object": self.current_object,
        }

    # --- filter ---
    def _install(self) -> None:
        """From the first object on, so that retractions before an exclusion are known."""
        if self._filter is not None:
            return
        gcode_move = self.printer.lookup_object("gcode_move")
        self._before = gcode_move.transform
        self._filter = ObjectFilter(self._before)
        gcode_move.set_move_transform(self._filter, force=True)
        gcode_move.reset_last_position()

    def _remove(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move", None)
        if self._filter is None or gcode_move is None:
            return
        self._filter.skipping = False
        if gcode_move.transform is not self._filter:
            return  # another transform is on top: stay, and pass everything on
        gcode_move.set_move_transform(self._before, force=True)
        gcode_move.reset_last_position()
        self._filter = None

    def _forget(self) -> None:
        self.objects, self.excluded_objects, self.current_object = [], [], None
        self._remove()

    def _decide(self) -> None:
        if self._filter is not None:
            self._filter.skipping = self.current_object in self.excluded_objects

    # --- commands ---
    def _add(self, name: str, facts: dict[str, Any]) -> None:
        kept = [entry for entry in self.objects if entry["name"] != name]
        self.objects = sorted([*kept, {"name": name, **facts}], key=lambda entry: str(entry["name"]))
        self._install()

    def _is_known(self, name: str) -> bool:
        return any(entry["name"] == name for entry in self.objects)

    def cmd_EXCLUDE_OBJECT_DEFINE(self, gcmd: GCodeCommand) -> None:
        """An object of the file: NAME, CENTER=X,Y, POLYGON=[[x,y],...] and whatever else the slicer adds."""
        if gcmd.get("RESET", None):
            self._forget()
        name = gcmd.get("NAME", None)
        if name is None:
            if not gcmd.get("RESET", None):
                self._list_objects(gcmd)
            return
        facts: dict[str, Any] = {
            key.lower(): value
            for key, value in gcmd.get_command_parameters().items()
            if key not in ("NAME", "CENTER", "POLYGON", "RESET", "JSON")
        }
        center, polygon = gcmd.get("CENTER", None), gcmd.get("POLYGON", None)
        try:
            if center is not None:
                facts["center"] = _numbers(json.loads(f"[{center}]"))
            if polygon is not None:
                facts["polygon"] = [_numbers(point) for point in json.loads(polygon)]
        except (ValueError, TypeError, RecursionError):
            raise gcmd.error(
                "EXCLUDE_OBJECT_DEFINE: expected CENTER=X,Y and POLYGON=[[x,y],[x,y],...] without blanks"
            ) from None
        self._add(name.upper(), facts)

    def _list_objects(self, gcmd: GCodeCommand) -> None:
        if gcmd.get("JSON", None) is not None:
            gcmd.respond_info(f"Known objects: {json.dumps(self.objects)}")
        else:
            gcmd.respond_info("Known objects: " + " ".join(str(entry["name"]) for entry in self.objects))

    def _enter(self, name: str | None) -> None:
        self.current_object = name
        self._decide()
        self.printer.send_event("exclude_object:current", name)

    def cmd_EXCLUDE_OBJECT_START(self, gcmd: GCodeCommand) -> None:
        """What follows belongs to the object NAME."""
        name = gcmd.get("NAME").upper()
        if not self._is_known(name):
            self._add(name, {})
        self._enter(name)

    def cmd_EXCLUDE_OBJECT_END(self, gcmd: GCodeCommand) -> None:
        """The current object ends."""
        name = gcmd.get("NAME", None)
        if self.current_object is None:
            gcmd.respond_info("EXCLUDE_OBJECT_END called, but no object is currently active")
            return
        if name is not None and name.upper() != self.current_object:
            gcmd.respond_info(
                f"EXCLUDE_OBJECT_END NAME={name.upper()} does not match the current object {self.current_object}"
            )
        self._enter(None)

    def cmd_EXCLUDE_OBJECT(self, gcmd: GCodeCommand) -> None:
        """Exclude NAME or the CURRENT one; RESET=1 takes one or all exclusions back; without parameters: list."""
        name = gcmd.get("NAME", None)
        if gcmd.get("RESET", None):
            back = self.excluded_objects if name is None else [name.upper()]
            self.excluded_objects = [entry for entry in self.excluded_objects if entry not in back]
        elif name is not None:
            self._exclude(name.upper())
        elif gcmd.get("CURRENT", None):
            if self.current_object is None:
                raise gcmd.error("There is no current object to cancel")
            self._exclude(self.current_object)
        else:
            gcmd.respond_info("Excluded objects: " + " ".join(self.excluded_objects))
        self._decide()

    def _exclude(self, name: str) -> None:
        self._install()
        if name not in self.excluded_objects:
            self.gcode.respond_info(f"Excluding object {name}")
            self.excluded_objects = sorted([*self.excluded_objects, name])


def _numbers(values: Any) -> list[float]:
    """A list of numbers; ValueError otherwise."""
    if not isinstance(values, list) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    ):
        raise ValueError("expected numbers")
    return values


def load_config(config: ConfigWrapper) -> ExcludeObject:
    """Section [exclude_object]."""
    config.get_printer().load_object(config, "gcode_move")
    module = ExcludeObject(config.get_printer())
    module.register()
    return module
