"""[extrusion]: what leaves the nozzle: die swell, and the ooze after a stop or a cold time (HydraRaptor 2007).

    EXTRUSION_CALIBRATE SPEEDS=1,2,4 [LENGTH=15] [PAUSE=10]          strands into the air, one for each filament speed
    EXTRUSION_CALIBRATE SPEEDS=1,2,4 WIDTHS=0.45,0.49,0.55           fit what was measured on them; SAVE_CONFIG keeps it
    PRIME_OOZE                                                       push what has oozed since the last extrusion

d = hole + gain * v: the strand is wider than the hole, and wider still at a higher speed (thermal/plan/extrusion.py).
"""

from __future__ import annotations

import math
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.plan.extrusion import DieSwell, Overrun, exit_diameter, fit_die_swell, oozed_mm

WATCH_S = 0.25
MOVING_MM_S = 1e-3
AIR_MM = 20.0  # below the nozzle, for a strand to hang in


class Extrusion:
    """The object `extrusion`."""

    def __init__(
        self,
        printer: Printer,
        swell: DieSwell | None,
        overrun: Overrun | None,
        filament_mm: float,
        prime_mm_s: float,
    ) -> None:
        self.printer = printer
        self.swell = swell
        self.overrun = overrun
        self.filament_mm = filament_mm
        self.prime_mm_s = prime_mm_s
        self._gcode = printer.lookup_object("gcode")
        self._reactor = printer.get_reactor()
        self._extruded_s = math.nan  # when filament last went forward
        self._was_cold = False  # since then

    def register(self) -> None:
        self._gcode.register_command(
            "EXTRUSION_CALIBRATE", self.cmd_EXTRUSION_CALIBRATE, desc="Measure and fit the die swell"
        )
        self._gcode.register_command("PRIME_OOZE", self.cmd_PRIME_OOZE, desc="Push what has oozed")
        if self.overrun is not None:
            self.printer.register_event_handler("klippy:ready", self._on_ready)

    def _on_ready(self) -> None:
        self._reactor.register_timer(self._watch, self._reactor.NOW)

    def _watch(self, eventtime: float) -> float:
        """Filament in motion is remembered; a print of nothing but waiting oozes."""
        motion = self.printer.lookup_object("motion_report").get_status(eventtime)
        if motion["live_extruder_velocity"] > MOVING_MM_S:
            self._extruded_s, self._was_cold = eventtime, False
        elif not self._hot(eventtime):
            self._was_cold = True
        return eventtime + WATCH_S

    def _hot(self, eventtime: float) -> bool:
        extruder = self.printer.lookup_object("toolhead").get_extruder()
        return bool(extruder.get_status(eventtime).get("can_extrude", False))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        swell = self.swell
        return {
            "die_swell_hole": swell.hole_mm if swell else None,
            "die_swell_gain": swell.gain_s if swell else None,
            "oozed": round(self._oozed_mm(eventtime), 4),
        }

    def _oozed_mm(self, eventtime: float) -> float:
        if self.overrun is None or math.isnan(self._extruded_s):
            return 0.0
        reheated = self._was_cold and self._hot(eventtime)
        return oozed_mm(self.overrun, eventtime - self._extruded_s, reheated)

    def cmd_EXTRUSION_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        speeds = _numbers(gcmd, "SPEEDS")
        if gcmd.get("WIDTHS", None) is None:
            self._strands(gcmd, speeds)
            return
        widths = _numbers(gcmd, "WIDTHS")
        try:
            swell = fit_die_swell(speeds, widths, self.filament_mm)
        except ValueError as e:
            raise gcmd.error(f"EXTRUSION_CALIBRATE: {e}") from None
        self.swell = swell
        configfile = self.printer.lookup_object("configfile")
        configfile.set("extrusion", "die_swell_hole", f"{swell.hole_mm:.5f}")
        configfile.set("extrusion", "die_swell_gain", f"{swell.gain_s:.6g}")
        lines = [f"Die swell: {swell.hole_mm:.4f} mm + {swell.gain_s:.5g} s * exit speed"]
        for speed, width in zip(speeds, widths, strict=True):
            model = exit_diameter(swell, speed, self.filament_mm)
            lines.append(f"  {speed:g} mm/s: measured {width:.4f} mm, model {model:.4f} mm")
        lines.append("SAVE_CONFIG keeps it.")
        gcmd.respond_info("\n".join(lines))

    def _strands(self, gcmd: GCodeCommand, speeds: list[float]) -> None:
        """One strand for each speed, with a rest between to take it off."""
        length_mm = gcmd.get_float("LENGTH", 15.0, above=0.0, maxval=100.0)
        pause_s = gcmd.get_float("PAUSE", 10.0, minval=0.0, maxval=120.0)
        self._check_strands(gcmd, max(speeds), length_mm)
        script = []
        for speed in speeds:
            script += [f"G1 E{length_mm:g} F{60.0 * speed:g}", "M400", f"G4 P{1000.0 * pause_s:.0f}"]
        self._extrude(script)
        shown = ",".join(f"{speed:g}" for speed in speeds)
        gcmd.respond_info(
            f"Measure each strand some cm below the nozzle, then EXTRUSION_CALIBRATE SPEEDS={shown} WIDTHS=..."
        )

    def _check_strands(self, gcmd: GCodeCommand, speed_mm_s: float, length_mm: float) -> None:
        """What would spoil the strands, before any filament is spent."""
        toolhead = self.printer.lookup_object("toolhead")
        eventtime, extruder = self._reactor.monotonic(), toolhead.get_extruder()
        if not self._hot(eventtime):
            raise gcmd.error(
                "EXTRUSION_CALIBRATE: the nozzle is too cold to extrude; heat it first, as with M109"
            )
        if speed_mm_s > extruder.max_e_velocity:
            raise gcmd.error(
                f"EXTRUSION_CALIBRATE: {speed_mm_s:g} mm/s of filament is more than max_extrude_only_velocity of"
                f" [extruder] allows ({extruder.max_e_velocity:.1f} mm/s): the strand would come slower than asked for"
            )
        if length_mm > extruder.max_e_dist:
            raise gcmd.error(
                f"EXTRUSION_CALIBRATE: LENGTH={length_mm:g} is more than max_extrude_only_distance of [extruder]"
                f" allows ({extruder.max_e_dist:g} mm)"
            )
        height_mm = toolhead.get_position()[2]
        if "z" in toolhead.get_status(eventtime)["homed_axes"] and height_mm < AIR_MM:
            raise gcmd.error(
                f"EXTRUSION_CALIBRATE: the strands need {AIR_MM:g} mm of air below the nozzle, and it is at Z"
                f" {height_mm:.1f}; move it up first, as with G1 Z{2.0 * AIR_MM:g}"
            )

    def _extrude(self, script: list[str]) -> None:
        """Relative extrusion at 100 %, whatever M82, M220 and M221 say; after it, or an error, they are as before."""
        run = self._gcode.run_script_from_command
        run("SAVE_GCODE_STATE NAME=extrusion_test")
        try:
            run("\n".join(["M83", "M220 S100", "M221 S100", *script]))
        finally:
            run("RESTORE_GCODE_STATE NAME=extrusion_test")

    def cmd_PRIME_OOZE(self, gcmd: GCodeCommand) -> None:
        if self.overrun is None:
            raise gcmd.error("PRIME_OOZE needs the options overrun_length and overrun_time in [extrusion]")
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.wait_moves()  # a wait that is still queued has not let anything ooze yet
        length_mm = self._oozed_mm(self._reactor.monotonic())
        if length_mm < 1e-3:
            gcmd.respond_info("Nothing has oozed")
            return
        self._extrude([f"G1 E{length_mm:.4f} F{60.0 * self.prime_mm_s:g}", "M400"])
        self._extruded_s, self._was_cold = self._reactor.monotonic(), False
        gcmd.respond_info(f"Pushed {length_mm:.3f} mm for what has oozed")


def _numbers(gcmd: GCodeCommand, name: str) -> list[float]:
    text = gcmd.get(name)
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise gcmd.error(f"{name}={text}: numbers with commas between them, as in {name}=1,2,4") from None
    if not all(math.isfinite(v) and v > 0.0 for v in values):
        raise gcmd.error(f"{name}={text}: every number has to be above zero")
    return values


def load_config(config: ConfigWrapper) -> Extrusion:
    printer = config.get_printer()
    hole_mm = config.getfloat("die_swell_hole", None, above=0.0)
    gain_s = config.getfloat("die_swell_gain", 0.0, minval=0.0)
    length_mm = config.getfloat("overrun_length", None, above=0.0)
    time_s = config.getfloat("overrun_time", 2.0, above=0.0)
    reheat_mm = config.getfloat("overrun_reheat", 0.0, minval=0.0)
    filament_mm = config.getsection("extruder").getfloat("filament_diameter", 1.75, above=0.0)
    extrusion = Extrusion(
        printer,
        None if hole_mm is None else DieSwell(hole_mm, gain_s),
        None if length_mm is None else Overrun(length_mm, time_s, reheat_mm),
        filament_mm,
        config.getfloat("prime_speed", 2.0, above=0.0),
    )
    printer.load_object(config, "motion_report")
    extrusion.register()
    return extrusion
