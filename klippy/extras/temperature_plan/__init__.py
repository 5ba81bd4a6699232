"""[temperature_plan]: every segment at the temperature that makes it weld.

    path_events ─► session (thermal/plan/session.py) ─► heater.loop.set_reference

While the look-ahead hands out moves they are only copied; all else is done in a timer. M104/M109, a fault or
`TEMPERATURE_PLAN ENABLE=0` win over the plan at once.
"""

from __future__ import annotations

import csv
import logging
import math
from dataclasses import replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.plan.layer_time import LayerSpeed
from thermal.plan.materials import MATERIALS, Material
from thermal.plan.planner import Deposited, Summary
from thermal.plan.session import Session, Turn

from .path_events import PathEvents
from .settings import HEADROOM_C, Settings, nozzle_limits, read_settings

__all__ = ["Settings", "TemperaturePlanner", "load_config", "nozzle_limits", "read_settings", "report_line"]

WORK_S = 1.0  # longest interval of the timer
SOON_S = 0.05  # and the shortest, except for new motion


class TemperaturePlanner(PathEvents):
    """One heater's plan."""

    def __init__(self, printer: Printer, settings: Settings) -> None:
        super().__init__(printer, settings)
        self._reactor = printer.get_reactor()
        self._print_stats: Any = None
        self._timer: Any = None
        self._record: Any = None  # a file, and its csv writer
        self._rows: Any = None
        self._printing = False
        self._has_reported = False  # of this print, that it is slowed down

    def _on_connect(self) -> None:
        """All sections are read: find the heater."""
        settings = self.settings
        self.heater = self.printer.lookup_object("heaters").lookup_heater(settings.heater)
        if not hasattr(self.heater, "loop"):
            raise self.printer.config_error(
                f"[temperature_plan]: heater '{settings.heater}' is no [induction_heater], no other is quick enough."
                " For other printers scripts/plan_temperature.py --emit writes M104 commands into the file"
            )
        self.min_extrude_c = self.heater.min_extrude_c
        self._check_table()
        try:
            limits = nozzle_limits(settings, self.heater.parameters, self.min_extrude_c)
            self.session = Session(settings, limits, keeps_rows=settings.record is not None)
        except ValueError as e:
            raise self.printer.config_error(f"[temperature_plan]: {e}") from None
        self.heater.planner = self

    def _check_table(self) -> None:
        """Can the heater make the requested temperatures? The melt is never hotter than the nozzle."""
        low_c, high_c = self.min_extrude_c, self.heater.max_temp - HEADROOM_C
        for option, place, temp_c in self.settings.table.entries():
            if not low_c <= temp_c <= high_c:
                raise self.printer.config_error(
                    f"Option '{option}' in section 'temperature_plan': '{place}: {temp_c:g}' is no melt that heater"
                    f" '{self.settings.heater}' can give: {low_c:g} C (min_extrude_temp) to {high_c:g} C"
                    f" ({HEADROOM_C:g} below max_temp) are ({self.settings.written_at[option]})."
                )

    def renew(self) -> None:
        """The heater has new parameters: plan with them. A print in progress keeps the old ones."""
        if self.session.plan.summary().pieces == 0 and not self.is_on_path():
            self._begin()

    def _begin(self) -> None:
        """Begin a plan for an empty bed."""
        limits = nozzle_limits(self.settings, self.heater.parameters, self.min_extrude_c)
        self.session.begin(limits, self.heater.now_s() if self.session.lead.reference is not None else 0.0)
        self._has_reported = False
        self.set_speed(1.0)

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._on_connect)
        self.printer.register_event_handler("klippy:ready", self._on_ready)
        self.printer.register_event_handler("klippy:shutdown", self._stop)
        self.printer.register_event_handler("klippy:disconnect", self._settle)
        self.printer.register_event_handler("print_stats:begin", self._begin_print)
        self.register_requests()
        self._gcode.register_command(
            "TEMPERATURE_PLAN",
            self.cmd_TEMPERATURE_PLAN,
            desc="Switch, set up or report the temperature plan",
        )

    def _on_ready(self) -> None:
        self.find_devices()
        self._print_stats = self.printer.lookup_object("print_stats", None)
        if self.heater.batch:
            return
        if self.settings.record is not None:
            stream = open(self.settings.record, "w", newline="", encoding="utf-8")  # noqa: SIM115  # until the end
            self.printer.register_event_handler("klippy:disconnect", self._close_record)
            self._record, self._rows = stream, csv.writer(stream)
            self._rows.writerow(Deposited._fields)
        self.listen()
        first = self._reactor.NOW if self.enabled else self._reactor.NEVER
        self._timer = self._reactor.register_timer(self._on_timer, first)

    def _stop(self) -> None:
        self._is_listening = False
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None
        self._printing = False

    def on_due(self) -> None:
        self._reactor.update_timer(self._timer, self._reactor.NOW)

    def on_speed(self, speed: LayerSpeed) -> None:
        if speed.factor < 1.0 and not self._has_reported:
            self._has_reported = True
            interface_c = self.session.plan.speed_interface_c
            self._gcode.respond_info(
                f"A hot layer is deposited at {100 * speed.factor:.0f} % of the file's speed, so that its weld stays"
                f" near {interface_c:.0f} C. A higher interface_temp, more fan or minimum_speed_factor: 1 keeps it"
            )

    # The plan

    def _on_timer(self, eventtime: float) -> float:
        now_s, loop, session = self.heater.now_s(), self.heater.loop, self.session
        self._watch_print(now_s)
        session.follow(loop.reference, loop.state.target_c, now_s)
        self.watch_bed(eventtime)
        turn = session.work(now_s)
        self._give(turn, now_s)
        self._write_rows()
        if turn.replanned and session.is_round():
            self.choose_speed()
        if not self.enabled and session.lead.reference is None:
            return float(self._reactor.NEVER)
        return eventtime + max(SOON_S, min(WORK_S, turn.next_s - now_s))

    def _give(self, turn: Turn, now_s: float) -> None:
        """Pass the turn's result to the heater."""
        if turn.reference is not None:
            self.heater.loop.set_reference(turn.reference, now_s)
        if turn.released:
            self.heater.loop.set_reference([], now_s)

    def is_on_path(self) -> bool:
        """Does the plan hold the heater? Asked by the heater: M109 waits until it is back at the user's target."""
        reference = self.session.lead.reference
        return reference is not None and self.heater.loop.reference is reference

    def melt_target_c(self) -> float:
        """The requested melt temperature of this moment; NaN without extrusion."""
        return self.session.plan.melt_at(self.heater.now_s())

    def user_target_c(self) -> float:
        """The target of M104/M109, on which the plan lies."""
        return self.session.target.base_c if self.heater.loop.state.target_c else 0.0

    def take_target(self, target_c: float) -> bool:
        """The user's M104. True: a path is under way, and the plan has taken the target."""
        if not self.enabled or not self.is_on_path():
            return False
        now_s = self.heater.now_s()
        turn = self.session.move_target(target_c, now_s)
        if turn is not None:
            self._give(turn, now_s)
        return turn is not None

    # The record

    def _write_rows(self) -> None:
        """Write to the file what has been deposited since the last call."""
        rows = self.session.take_rows()
        if self._rows is not None:
            try:
                self._rows.writerows(rows)
            except OSError as e:
                self._close_record(e)

    def _close_record(self, problem: OSError | None = None) -> None:
        """Close the file. A full disk ends the record, not the print."""
        stream, self._record, self._rows = self._record, None, None
        self.session.keeps_rows = False
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
        """Before the first line of the file, so that its requests count."""
        self._settle()
        self._begin()
        self.session.forget_requests()
        self._printing = True

    def _watch_print(self, now_s: float) -> None:
        """A print is over when all moves queued at the end of its file are deposited."""
        over = self._printing and self._print_stats.state not in ("printing", "paused")
        if over and now_s > self.session.lead.end_s and not self.session.path.facts().waiting:
            self._settle()
            self.session.full_speed()
            self.set_speed(1.0)

    def _settle(self) -> None:
        """Record and report the rest of a print, if there is one."""
        if not self._printing:
            return
        self._printing = False
        self.session.record(math.inf)
        self._write_rows()
        if self.enabled and self.session.plan.summary().pieces:
            self._gcode.respond_info(report_line(self.session.plan.summary(), self.session.material))

    # Commands

    def cmd_TEMPERATURE_PLAN(self, gcmd: GCodeCommand) -> None:
        session, own = self.session, self.settings.material
        enable = gcmd.get_int("ENABLE", None, minval=0, maxval=1)
        name = gcmd.get("MATERIAL", None)
        interface_c = gcmd.get_float("INTERFACE", None, minval=0.0, maxval=500.0)
        material, options = session.material, session.options
        if name is not None:
            if name.upper() not in MATERIALS:
                raise gcmd.error(f"Material '{name.upper()}' is not known; known are {', '.join(MATERIALS)}")
            # the section's own with the window that it gave it
            material = own if name.upper() == own.name else MATERIALS[name.upper()]
        if interface_c is not None:
            options = replace(options, interface_c=interface_c or None, follow_mm=0.0)
        if name is not None or interface_c is not None:
            session.change(material, options)
        if enable is not None:
            self._enable(bool(enable))
        if gcmd.get_int("REPORT", 0) or (enable, name, interface_c) == (None, None, None):
            gcmd.respond_info(report_line(session.plan.summary(), session.material))

    def _enable(self, enable: bool) -> None:
        if enable == self.enabled:
            return
        self.enabled = enable
        if self._is_listening:
            self.keep_ahead()
        if not enable:
            self.session.full_speed()
            self.set_speed(1.0)
            if self.session.lead.reference is not None:
                now_s = self.heater.now_s()
                self.session.cut(now_s)
                if self.is_on_path():
                    self._give(self.session.go_back(now_s), now_s)
        if self._timer is not None:
            self._reactor.update_timer(self._timer, self._reactor.NOW)
        logging.info("Temperature plan %s", "enabled" if enable else "disabled")

    # Status

    def get_status(self, eventtime: float) -> dict[str, Any]:
        session, now_s = self.session, self.heater.now_s() if self._timer is not None else 0.0
        totals, base_c = session.plan.summary(), session.target.base_c
        active = session.lead.reference is not None
        return {
            "enabled": self.enabled,
            "active": active,
            "material": session.material.name,
            "planned_temperature": round(session.plan.at(now_s, base_c), 2) if active else None,
            "base_target": base_c,
            "planned_until": round(session.lead.end_s, 3) if active else None,
            "layer": int(session.path.facts().layer),
            "feature": session.requested.state.feature,
            "speed_factor": round(session.speed_factor, 3),
            "length": round(totals.length_mm, 1),
            "bonded_share": round(totals.bonded_share[0], 4),
            "bonded_share_fixed": round(totals.bonded_share[1], 4),
        }


def report_line(totals: Summary, material: Material) -> str:
    """What was deposited, with the plan and as one fixed temperature would have deposited it."""
    if not totals.pieces:
        return f"Temperature plan ({material.name}): nothing deposited yet"
    (low, _, high), (low_fixed, _, high_fixed) = totals.interface_5_50_95_c
    planned, fixed = totals.bonded_share
    slowed = ""
    if totals.slowed_s >= 1.0:
        slowed = f"; hot layers were slowed down, {totals.slowed_s:.0f} s longer"
    return (
        f"Temperature plan ({material.name}, welds above {material.bonding_c:.0f} C): {totals.length_mm / 1000:.1f} m"
        f" deposited, {100 * planned:.1f} % welded, {100 * fixed:.1f} % without the plan;"
        f" interface {low:.0f}..{high:.0f} C (5..95 %), {low_fixed:.0f}..{high_fixed:.0f} C without{slowed}"
    )


def load_config(config: ConfigWrapper) -> TemperaturePlanner:
    planner = TemperaturePlanner(config.get_printer(), read_settings(config))
    planner.register()
    return planner
