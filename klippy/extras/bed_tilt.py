"""[bed_tilt]: the nozzle follows a bed that is a tilted plane: z + x * x_adjust + y * y_adjust + z_adjust."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import manual_probe
from .probing.points import ProbePointsHelper
from .probing.surface_fit import Plane, fit_plane, on_a_line


class BedTilt:
    """Printer object 'bed_tilt'; a transform between G-code and toolhead."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.plane = Plane(
            config.getfloat("z_adjust", 0.0),
            config.getfloat("x_adjust", 0.0),
            config.getfloat("y_adjust", 0.0),
        )
        if config.has_section("bed_mesh"):
            raise config.error(
                f"[bed_tilt] and [bed_mesh] can not be used together ({config.where()}): take one out"
            )
        self._gcmd: Any = None
        self.next_transform: Any = None
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self.points = ProbePointsHelper(config, self._finish_probing, default_points=())
        if self.points.probe_points:
            self.points.minimum_points(3)
            if on_a_line(self.points.probe_points or ()):
                raise config.error(
                    f"Option 'points' in section 'bed_tilt' are on a line ({config.where('points')})"
                )
            gcode = self.printer.lookup_object("gcode")
            gcode.register_command(
                "BED_TILT_CALIBRATE", self.cmd_BED_TILT_CALIBRATE, desc="Bed tilt calibration script"
            )

    def _handle_connect(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move")
        self.next_transform = gcode_move.set_move_transform(self, force=True)

    def get_position(self) -> list[float]:
        x, y, z, *further = self.next_transform.get_position()
        return [x, y, z - self.plane.z(x, y), *further]

    def move(self, newpos: Sequence[float], speed: float) -> None:
        x, y, z, *further = newpos
        self.next_transform.move([x, y, z + self.plane.z(x, y), *further], speed)

    def cmd_BED_TILT_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """BED_TILT_CALIBRATE [METHOD=manual] [HORIZONTAL_MOVE_Z=mm]."""
        self._gcmd = gcmd
        self.points.start_probe(gcmd)

    def _finish_probing(self, offsets: Sequence[float], places: list[list[float]]) -> None:
        """The probed heights are the machine's own, without any correction."""
        at = [(x + offsets[0], y + offsets[1]) for x, y, _ in places]
        self.plane = fit_plane(at, [z - offsets[2] for _, _, z in places])
        self.printer.lookup_object("gcode_move").reset_last_position()
        values = {
            "x_adjust": self.plane.slope_x,
            "y_adjust": self.plane.slope_y,
            "z_adjust": self.plane.height,
        }
        configfile = self.printer.lookup_object("configfile")
        for option, value in values.items():
            configfile.set(self.name, option, f"{value:.6f}")
        found = " ".join(f"{option}: {value:.6f}" for option, value in values.items())
        manual_probe.report_save_config(self._gcmd, f"{self.name}: {found}")


def load_config(config: ConfigWrapper) -> BedTilt:
    return BedTilt(config)
