"""[temperature_plan]: every segment at the temperature that makes it weld.

    toolhead ── moves with times ─► pathpieces ─► tempplan (substrate, wanted melt, ramps) ─► heater.loop.set_reference
    G-code ─── names of places ──► wishes ────────┘

While the look-ahead hands out moves they are only copied; all else is done in a timer.

The plan lies on top of the user's own target: M104/M109, a fault or `TEMPERATURE_PLAN ENABLE=0` win at once. It is made
again whenever enough new motion has come (path_pieces.c), from `COMMIT_S` ahead of now on; what lies before that is
not touched.
"""

from __future__ import annotations

import csv
import logging
import math
from collections import deque
from dataclasses import replace
from typing import Any

from thermal.control.control_api import Reference
from thermal.models.melt_exchange import NozzleLimits, idle_way
from thermal.plan import requests
from thermal.plan.layer_time import Pace, Pacer, Place
from thermal.plan.materials import MATERIALS, Material
from thermal.plan.path_pieces import Asked, PathPieces
from thermal.plan.planner import Laid, Summary, TemperaturePlan

from .settings import HEADROOM_C, Settings, nozzle_limits, read_settings

__all__ = ["Settings", "TemperaturePlanner", "load_config", "nozzle_limits", "read_settings", "report_line"]

COMMIT_S = 0.20  # the plan nearer than this stays: commands for it may be on their way
WORK_S = 1.0  # how often it is looked, at least
SOON_S = 0.05  # and at most, but for new motion
BOOK_BEHIND_S = 0.5  # pieces are booked when they are surely laid
RETURN_S = 0.5  # so long after the last piece the nozzle goes back to the user's target
ROWS_AT_ONCE = 4096
WITHIN_C = 0.02  # a straight line for corners that are so near it: far below what the thermometer sees
SAME_TIME_S = 1e-6  # a mark and the move behind it


class TemperaturePlanner:
    """One heater's plan."""

    plan: TemperaturePlan
    _nozzle: NozzleLimits

    def __init__(self, printer: Any, settings: Settings) -> None:
        self.printer = printer
        self.settings = settings
        self.material = settings.material
        self.craft = settings.craft
        self.around = settings.surroundings
        self.enabled = settings.enabled
        self.heater: Any = None
        self._reactor = printer.get_reactor()
        self._gcode = printer.lookup_object("gcode")
        self._toolhead: Any = None
        self._print_stats: Any = None
        self._timer: Any = None
        self._record: Any = None  # a file, and its csv writer
        self._rows: Any = None
        self._state = requests.Wishes()
        self._marks: deque[requests.Wishes] = deque([self._state])
        self._reference: Any = None  # as we set it: another one means that the user has spoken
        self._base_c = 0.0
        self._end_s = -math.inf
        self._going_home = False  # nothing more came: the reference leads back to the user's target
        self._printing = False
        self._path = PathPieces(0.0)
        self._pacer = Pacer(1.0, 0.0)
        self._has_told = False  # of this print, that it is slowed down
        self._paced_s = -math.inf  # end of what was planned at the newest pace
        self._moved_c = 0.0  # by so much the user moved the target within the print
        self._fan_device: Any = None
        self._bed: Any = None
        self._fan = 0.0
        self._extruder: Any = None  # that the look-ahead moves, and is it ours?
        self._is_ours = True
        self._asks: tuple[float | None, ...] = self._state.asks(settings.table)  # of the newest mark
        self._is_due = False  # so much new motion has come that it is worth another plan

    def _on_connect(self) -> None:
        """All sections are read: find the heater."""
        settings = self.settings
        self.heater = self.printer.lookup_object("heaters").lookup_heater(settings.heater)
        if not hasattr(self.heater, "loop"):
            raise self.printer.config_error(
                f"[temperature_plan]: heater '{settings.heater}' is no [induction_heater], no other is quick enough."
                " For other printers scripts/plan_temperature.py --emit writes M104 commands into the file"
            )
        self._check_table()
        try:
            self._begin()
        except ValueError as e:
            raise self.printer.config_error(f"[temperature_plan]: {e}") from None
        self.heater.planner = self

    def _check_table(self) -> None:
        """Can the heater make what is asked for by name? The melt is never hotter than the nozzle."""
        low_c, high_c = self.heater.min_extrude_c, self.heater.max_temp - HEADROOM_C
        for option, place, temp_c in self.settings.table.entries():
            if not low_c <= temp_c <= high_c:
                raise self.printer.config_error(
                    f"Option '{option}' in section 'temperature_plan': '{place}: {temp_c:g}' is no melt that heater"
                    f" '{self.settings.heater}' can lay: {low_c:g} C (min_extrude_temp) to {high_c:g} C ({HEADROOM_C:g}"
                    f" below max_temp) are ({self.settings.written_at[option]})."
                )

    def renew(self) -> None:
        """The heater works with other numbers: plan with them. What is being laid is laid with the ones before."""
        if self.plan.summary().pieces == 0 and not self.is_on_path():
            self._begin()

    def _begin(self) -> None:
        """An empty bed."""
        self._nozzle = nozzle_limits(self.settings, self.heater.parameters, self.heater.min_extrude_c)
        self.around = self.settings.surroundings
        self.plan = TemperaturePlan(self._nozzle, self.material, self.around, self.craft)
        self._path = PathPieces(math.pi / 4.0 * self.craft.filament_mm**2)
        self._pacer = Pacer(self.settings.slowest, self.settings.longest_pause_s)
        self._paced_s, self._moved_c = -math.inf, 0.0
        self._has_told = False
        self._set_factor(1.0)
        if self._reference is not None:  # the print before still lies ahead, or is on its way back
            now_s = self.heater.now_s()
            self.plan.lead([(s, self._reference.at(s)) for s in (now_s, now_s + COMMIT_S)])

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._on_connect)
        self.printer.register_event_handler("klippy:ready", self._on_ready)
        self.printer.register_event_handler("klippy:shutdown", self._stop)
        self.printer.register_event_handler("klippy:disconnect", self._close_books)
        self.printer.register_event_handler("exclude_object:current", self._on_object)
        self.printer.register_event_handler("print_stats:begin", self._begin_print)
        gcode = self._gcode
        gcode.register_command(
            "SET_SEGMENT_TEMPERATURE",
            self.cmd_SET_SEGMENT_TEMPERATURE,
            desc="Melt temperature of the path that follows",
        )
        gcode.register_command("M104.1", self.cmd_M104_1)
        gcode.register_command(
            "TEMPERATURE_PLAN",
            self.cmd_TEMPERATURE_PLAN,
            desc="Switch, set up or report the temperature plan",
        )

    def _on_ready(self) -> None:
        self._toolhead = self.printer.lookup_object("toolhead")
        self._print_stats = self.printer.lookup_object("print_stats", None)
        fan = self.printer.lookup_object("fan", None)
        self._fan_device = fan.fan if fan is not None else None
        self._bed = self.printer.lookup_object("heater_bed", None)
        if self.heater.batch:
            return
        if self.settings.record is not None:
            stream = open(self.settings.record, "w", newline="", encoding="utf-8")  # noqa: SIM115  # until the end
            self.printer.register_event_handler("klippy:disconnect", self._close_record)
            self._record, self._rows = stream, csv.writer(stream)
            self._rows.writerow(Laid._fields)
        self._gcode.register_comment_listener(self._on_comment)
        self._toolhead.register_move_listener(self._on_moves, as_records=True)
        first = self._reactor.NOW if self.enabled else self._reactor.NEVER
        self._timer = self._reactor.register_timer(self._on_timer, first)

    def _stop(self) -> None:
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None
        self._printing = False

    # Names of places, as the G-code comes by

    def _mark(self, state: requests.Wishes) -> None:
        """`state` holds from the end of what is queued now."""
        self._state = state
        asks = state.asks(self.settings.table)
        if self.enabled and self._timer is not None and asks != self._asks:
            self._asks = asks
            self._toolhead.register_lookahead_callback(
                lambda time_s: self._hold_from(replace(state, since_s=time_s))
            )

    def _hold_from(self, state: requests.Wishes) -> None:
        self._marks.append(state)
        self._path.forget(state.since_s - SAME_TIME_S)

    def _on_comment(self, line: str) -> None:
        found = requests.read_comment(line)
        if found is not None:
            self._mark(self._state.comment(found))
            if found.kind == "layer":
                self._begin_layer()

    def _on_object(self, name: str | None) -> None:
        self._mark(self._state.inside(name or ""))

    def _at(self, time_s: float) -> requests.Wishes:
        """What was asked for at a print time; marks of the past go."""
        marks = self._marks
        while len(marks) > 1 and marks[1].since_s <= time_s + SAME_TIME_S:
            marks.popleft()
        return marks[0]

    # Moves, as soon as their times are known

    def _on_moves(self, row: Any, count: int, print_time: float) -> None:
        if not self.enabled or self.heater.in_calibration:
            return
        serving = self._toolhead.get_extruder()
        if serving is not self._extruder:
            self._extruder = serving
            self._is_ours = not serving.get_name() or serving.get_heater() is self.heater
        if not self._is_ours:
            return  # another tool prints
        if self._fan_device is not None:
            self._fan = self._fan_device.last_fan_value
        if self._path.note_planned(row, count, print_time, self._fan, self._end_s):
            self._is_due = True
            self._reactor.update_timer(self._timer, self._reactor.NOW)

    def _ask(self, time_s: float, layer: int, z_mm: float) -> Asked:
        """What is asked for by name on the path from `time_s` on."""
        state, table = self._at(time_s), self.settings.table
        wish_c = state.wish_c(table, time_s, layer, z_mm)
        until_s = self._marks[1].since_s - SAME_TIME_S if len(self._marks) > 1 else math.inf
        over_s = state.since_s + state.duration_s
        if time_s < over_s:
            until_s = min(until_s, over_s)
        by_place = bool(table.layers or table.heights_mm)
        return Asked(wish_c, self._base_c, state.height_mm, state.pace, until_s, by_place)

    # Pace: what is left where even the coolest melt is too hot

    def _begin_layer(self) -> None:
        """The file says that a layer begins; called before its first move is queued."""
        if self.enabled and self._timer is not None and self._pacer.is_used:
            self._choose_pace()
            if self._pacer.pace.pause_s > 0.0:
                self._toolhead.dwell(self._pacer.pace.pause_s)

    def _choose_pace(self) -> None:
        facts = self._path.facts()
        place = Place(facts.z_mm, facts.height_mm, self._fan)
        pace = self._pacer.layer(
            self.plan.ages(), self.plan.pace_interface_c, self.material, self.around, place
        )
        self._set_factor(pace.factor)
        self._paced_s = self._end_s
        if pace.factor < 1.0 and not self._has_told:
            self._has_told = True
            self._gcode.respond_info(
                f"A hot layer is laid at {100 * pace.factor:.0f} % of the file's speed, so that its weld stays near"
                f" {self.plan.pace_interface_c:.0f} C. A higher interface_temp, more fan or minimum_speed_factor: 1"
                " keep the speed"
            )

    def _pace_without_layers(self) -> None:
        """The file tells no layers: another pace whenever about one has been laid."""
        if self._state.layer or not self._pacer.is_used:
            return
        if self._pacer.is_round(self.plan.ages(), self._end_s - self._paced_s):
            self._choose_pace()

    def _set_factor(self, factor: float) -> None:
        modes = self.printer.lookup_object("gcode_move").modes
        if factor != modes.pace:
            modes.pace = factor
            self._mark(replace(self._state, pace=factor))

    # The plan

    def _on_timer(self, eventtime: float) -> float:
        now_s = self.heater.now_s()
        self._watch_print(now_s)
        self._watch_target()
        self._watch_bed(eventtime)
        next_s = self._work(now_s)
        if not self.enabled and self._reference is None:
            return float(self._reactor.NEVER)
        return eventtime + max(SOON_S, min(WORK_S, next_s - now_s))

    def _work(self, now_s: float) -> float:
        """Plan, or go back, or neither. When to look again at the latest."""
        next_s = math.inf
        if self._is_due or self._path.facts().waiting:
            next_s = self._end_s - 2.0 * COMMIT_S
            if self._base_c <= 0.0:
                self._path.drop(now_s)  # laid without a target; what still lies ahead may get one
            elif self._is_due or now_s > next_s:
                self._replan(now_s)
                return math.inf
        elif self._reference is not None:
            next_s = self._end_s + RETURN_S
            if now_s > next_s:
                self._go_back(now_s)
        self._book(now_s - BOOK_BEHIND_S)
        return next_s

    def _watch_target(self) -> None:
        """Who set the heater's target last? Not the plan: then it is the user's, and counts from now on."""
        loop = self.heater.loop
        if loop.reference is not None and loop.reference is self._reference:
            if not loop.state.target_c:  # turned off
                self._let_go(0.0)
            return
        self._let_go(loop.state.target_c)

    def _watch_bed(self, eventtime: float) -> None:
        """The bed's target, or while it has none what was known before."""
        bed_c = self._bed.get_status(eventtime)["target"] if self._bed is not None else 0.0
        if bed_c > 0.0 and bed_c != self.around.bed_c:
            self.around = replace(self.around, bed_c=bed_c)
            self._use_craft()

    def is_on_path(self) -> bool:
        """Does the plan hold the heater? Asked by the heater: M109 waits until it is back at the user's target."""
        return self._reference is not None and self.heater.loop.reference is self._reference

    def user_target_c(self) -> float:
        """What M104/M109 asked for, on which the plan lies."""
        return self._base_c if self.heater.loop.state.target_c else 0.0

    def take_target(self, target_c: float) -> bool:
        """The user's M104 while path is under way. The plan moves with it and goes on; True: it has been done."""
        now_s = self.heater.now_s()
        ahead = not self._going_home and now_s + COMMIT_S < self._end_s
        if not self.enabled or not self.is_on_path() or not ahead:
            return False
        moved_c, self._base_c = target_c - self._base_c, target_c
        if not moved_c:
            return True  # slicers repeat themselves
        self._path.forget()
        self._moved_c += moved_c
        self._use_craft()
        from_s = now_s + COMMIT_S
        self.plan.shift(from_s, moved_c)
        self._set(self.plan.ahead(from_s, self._reference.at(from_s), WITHIN_C), now_s)
        return True

    def _use_craft(self) -> None:
        """Material and wishes as they are now; an interface told by name moves with the user's target."""
        craft = self.craft
        if craft.interface_c is not None and not craft.follow_mm:
            craft = replace(craft, interface_c=craft.interface_c + 0.5 * self._moved_c)
        self.plan.change(self.material, self.around, craft)

    def _let_go(self, base_c: float) -> None:
        if self._reference is not None and base_c <= 0.0:
            self._end_s = self.heater.now_s()
            self.plan.cut(self._end_s)
            self._path.drop()
        self._reference = None
        self._base_c = base_c
        self._path.forget()

    def _replan(self, now_s: float) -> None:
        from_s, booked_s = now_s + COMMIT_S, now_s - BOOK_BEHIND_S
        if self._reference is None:
            self.plan.lead([(now_s, self.heater.loop.state.target_c)])
        if self._rows is not None:
            self._book(booked_s)
        while (done := self.plan.turn(self._path, from_s, WITHIN_C, booked_s)) is None:
            self._path.inquire(self._ask)
        self._end_s, reference = done
        self._is_due = self._going_home = False
        self._set(reference, now_s)
        self._pace_without_layers()

    def _set(self, reference: Reference | None, now_s: float) -> None:
        if reference is not None:
            self.heater.loop.set_reference(reference, now_s)
            self._reference = reference

    def _go_back(self, now_s: float) -> None:
        """Nothing more comes: back to the user's target."""
        loop, from_c = self.heater.loop, self._reference.at(now_s)
        if loop.reference is not self._reference:
            return
        self._going_home = True
        holder_c = self.plan.holder_c(now_s, from_c)
        way = idle_way(self._nozzle, now_s, from_c, holder_c, self._base_c)
        self.plan.lead(way)
        self._set(Reference.of(way), now_s)
        self._end_s = way[-1][0] - RETURN_S
        if len(way) == 1:
            loop.set_reference([], now_s)
            self._reference = None

    def _book(self, until_s: float) -> None:
        rows = self.plan.finish(until_s, ROWS_AT_ONCE if self._rows is not None else 0)
        if self._rows is not None:
            try:
                self._rows.writerows(rows)
            except OSError as e:
                self._close_record(e)

    def _close_record(self, problem: OSError | None = None) -> None:
        """The file is over. A full disk ends the record, not the print."""
        stream, self._record, self._rows = self._record, None, None
        if stream is None:
            return
        try:
            stream.close()
        except OSError as e:
            problem = problem or e
        if problem is not None:
            self._gcode.respond_info(f"Temperature plan: the record {stream.name} ends: {problem.strerror}")

    # The print

    def _begin_print(self) -> None:
        """Before the first line of the file: what that asks for counts already."""
        self._close_books()
        self._begin()
        self._state = requests.Wishes()
        self._marks = deque([self._state])
        self._asks = self._state.asks(self.settings.table)
        self._printing = True

    def _watch_print(self, now_s: float) -> None:
        """A print is over when what was queued at the end of its file is laid."""
        over = self._printing and self._print_stats.state not in ("printing", "paused")
        if over and now_s > self._end_s and not self._path.facts().waiting:
            self._close_books()
            self._pacer.pace = Pace()
            self._set_factor(1.0)

    def _close_books(self) -> None:
        """Of this print, if there is one."""
        if not self._printing:
            return
        self._printing = False
        self._book(math.inf)
        if self.enabled and self.plan.summary().pieces:
            self._gcode.respond_info(report_line(self.plan.summary(), self.material))

    # Commands

    def cmd_SET_SEGMENT_TEMPERATURE(self, gcmd: Any) -> None:
        temp_c = gcmd.get_float("TEMP", minval=0.0, maxval=self.heater.max_temp)
        until = gcmd.get("UNTIL", "").lower()
        if until not in ("", "layer", "feature", "object"):
            raise gcmd.error(f"UNTIL is layer, feature or object, not '{until}'")
        duration_s = gcmd.get_float("DURATION", math.inf, above=0.0)
        self._ask_for(gcmd, temp_c, until, duration_s)

    def cmd_M104_1(self, gcmd: Any) -> None:
        """M104.1 S<degC>: the same, until the next one; S0 takes it back."""
        self._ask_for(gcmd, gcmd.get_float("S", minval=0.0, maxval=self.heater.max_temp), "", math.inf)

    def _ask_for(self, gcmd: Any, temp_c: float, until: str, duration_s: float) -> None:
        if temp_c and temp_c < self.heater.min_extrude_c:
            raise gcmd.error(
                f"A segment cannot be laid at {temp_c:.0f} C: min_extrude_temp is {self.heater.min_extrude_c:.0f} C"
            )
        if not self.enabled:
            gcmd.respond_info(
                "The temperature plan is disabled: this changes nothing until TEMPERATURE_PLAN ENABLE=1"
            )
        self._mark(self._state.explicitly(temp_c or math.nan, until, duration_s))

    def cmd_TEMPERATURE_PLAN(self, gcmd: Any) -> None:
        enable = gcmd.get_int("ENABLE", None, minval=0, maxval=1)
        material = gcmd.get("MATERIAL", None)
        interface_c = gcmd.get_float("INTERFACE", None, minval=0.0, maxval=500.0)
        if material is not None:
            material = material.upper()
            if material not in MATERIALS:
                raise gcmd.error(f"Material '{material}' is not known; known are {', '.join(MATERIALS)}")
            own = self.settings.material  # with the window that the section gave it
            self.material = own if material == own.name else MATERIALS[material]
        if interface_c is not None:
            self.craft = replace(self.craft, interface_c=interface_c or None, follow_mm=0.0)
        if material is not None or interface_c is not None:
            self._use_craft()
        if enable is not None:
            self._enable(bool(enable))
        if gcmd.get_int("REPORT", 0) or (enable, material, interface_c) == (None, None, None):
            gcmd.respond_info(report_line(self.plan.summary(), self.material))

    def _enable(self, enable: bool) -> None:
        if enable == self.enabled:
            return
        self.enabled = enable
        if not enable:
            self._pacer.pace = Pace()
            self._set_factor(1.0)
        if not enable and self._reference is not None:
            now_s = self.heater.now_s()
            self.plan.cut(now_s)
            self._path.drop()
            self._go_back(now_s)
        if self._timer is not None:
            self._reactor.update_timer(self._timer, self._reactor.NOW)
        logging.info("Temperature plan %s", "enabled" if enable else "disabled")

    # Status

    def get_status(self, eventtime: float) -> dict[str, Any]:
        now_s = self.heater.now_s() if self._timer is not None else 0.0
        books = self.plan.summary()
        active = self._reference is not None
        return {
            "enabled": self.enabled,
            "active": active,
            "material": self.material.name,
            "planned_temperature": round(self.plan.at(now_s, self._base_c), 2) if active else None,
            "base_target": self._base_c,
            "planned_until": round(self._end_s, 3) if active else None,
            "layer": int(self._path.facts().layer),
            "feature": self._state.feature,
            "speed_factor": round(self._pacer.pace.factor, 3),
            "length": round(books.length_mm, 1),
            "bonded_share": round(books.bonded_share[0], 4),
            "bonded_share_fixed": round(books.bonded_share[1], 4),
        }


def report_line(books: Summary, material: Material) -> str:
    """What was laid, with the plan and as one fixed temperature would have laid it."""
    if not books.pieces:
        return f"Temperature plan ({material.name}): nothing laid yet"
    (low, _, high), (low_fixed, _, high_fixed) = books.interface_5_50_95_c
    planned, fixed = books.bonded_share
    slowed = ""
    if books.slowed_s >= 1.0:
        slowed = f"; hot layers were slowed down, {books.slowed_s:.0f} s longer"
    return (
        f"Temperature plan ({material.name}, welds above {material.bonding_c:.0f} C): {books.length_mm / 1000:.1f} m"
        f" laid, {100 * planned:.1f} % welded, {100 * fixed:.1f} % without the plan;"
        f" interface {low:.0f}..{high:.0f} C (5..95 %), {low_fixed:.0f}..{high_fixed:.0f} C without{slowed}"
    )


def load_config(config: Any) -> TemperaturePlanner:
    planner = TemperaturePlanner(config.get_printer(), read_settings(config))
    planner.register()
    return planner
