"""[safe_z_home]: G28 Z happens at one place of the bed, after x and y, with the head lifted before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


@dataclass(frozen=True, slots=True)
class SafeHome:
    """mm and mm/s."""

    x: float
    y: float
    z_hop: float
    z_hop_speed: float
    speed: float
    move_to_previous: bool


class SafeZHoming:
    """Replaces G28; the plain one is called for each axis."""

    def __init__(self, printer: Printer, options: SafeHome) -> None:
        self.printer = printer
        self.options = options
        self.home_x_pos, self.home_y_pos = options.x, options.y  # plugins look them up
        self.prev_G28: Any = None

    def register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        self.prev_G28 = gcode.register_command("G28", None)
        gcode.register_command("G28", self.cmd_G28)

    def _home(self, axes: str) -> None:
        gcode = self.printer.lookup_object("gcode")
        self.prev_G28(gcode.create_gcode_command("G28", "G28", dict.fromkeys(axes, "0")))

    def _homed(self, toolhead: Any) -> str:
        return toolhead.get_status(self.printer.get_reactor().monotonic())["homed_axes"]

    def _hop(self, toolhead: Any) -> None:
        """Move up, unless the head is known to be high enough; an unknown height counts as 0 for that."""
        options = self.options
        if options.z_hop == 0.0:
            return
        if "z" not in self._homed(toolhead):
            toolhead.set_position(
                [*toolhead.get_position()[:2], 0.0, toolhead.get_position()[3]], homing_axes="z"
            )
            toolhead.manual_move([None, None, options.z_hop], options.z_hop_speed)
            toolhead.get_kinematics().clear_homing_state("z")
        elif toolhead.get_position()[2] < options.z_hop:
            toolhead.manual_move([None, None, options.z_hop], options.z_hop_speed)

    def cmd_G28(self, gcmd: GCodeCommand) -> None:
        """G28 [X] [Y] [Z]: x and y first, z at the safe place."""
        toolhead, options = self.printer.lookup_object("toolhead"), self.options
        wanted = [a for a in "XYZ" if gcmd.get(a, None) is not None] or list("XYZ")
        self._hop(toolhead)
        flat = "".join(a for a in wanted if a != "Z")
        if flat:
            self._home(flat)
        if "Z" not in wanted:
            return
        if not {"x", "y"} <= set(self._homed(toolhead)):
            raise gcmd.error("Must home X and Y axes first")
        before = toolhead.get_position()
        toolhead.manual_move([options.x, options.y], options.speed)
        self._home("Z")
        if options.z_hop and toolhead.get_position()[2] < options.z_hop:
            toolhead.manual_move([None, None, options.z_hop], options.z_hop_speed)
        if options.move_to_previous:
            toolhead.manual_move(before[:2], options.speed)


def load_config(config: ConfigWrapper) -> SafeZHoming:
    if config.has_section("homing_override"):
        raise config.error("homing_override and safe_z_home cannot be used simultaneously")
    x, y = config.getfloatlist("home_xy_position", count=2)
    config.get_printer().load_object(config, "homing")
    options = SafeHome(
        x,
        y,
        config.getfloat("z_hop", 0.0),
        config.getfloat("z_hop_speed", 15.0, above=0.0),
        config.getfloat("speed", 50.0, above=0.0),
        config.getboolean("move_to_previous", False),
    )
    homing = SafeZHoming(config.get_printer(), options)
    homing.register_commands()
    return homing
