"""[bed_mesh]: the shape of the bed, probed at a grid of points, is followed by the nozzle.

    G-code ─► gcode_move ─► BedMesh.move: z + correction(x, y, z), long lines in pieces ─► toolhead

`bed_mesh_points` says where to probe, `bed_mesh_config` reads, `meshmath` has the surface and its use.
Without a mesh the transform does nothing, and says so (`passes_to`); with one, rows of moves go by it in the C helper
(`row_stage`, path_stage.h).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from lookahead import done_in_c

from ..probing import surface_fit
from ..probing.points import ProbePointsHelper
from .calibration_names import CalibrationNames
from .config import (
    MeshOptions,
    Profile,
    changed_shape,
    profile_options,
    read_options,
    read_profiles,
    read_shape,
)
from .points import Layout, MeshError, MeshShape
from .zmesh import ZMesh

BedMeshError = MeshError  # the name plugins know
ADAPTIVE_PROFILE = "adaptive"


class BedMesh:
    """Printer object 'bed_mesh'."""

    def __init__(
        self, config: ConfigWrapper, shape: MeshShape, options: MeshOptions, profiles: dict[str, Profile]
    ) -> None:
        self.printer = config.get_printer()
        self.shape = shape  # as configured
        self.options = options
        self.profiles = profiles
        self.points = ProbePointsHelper(config, self._finish_probing, default_points=[])
        self.points.use_xy_offsets(True)
        self.points.scan_overshoot = options.scan_overshoot
        self.profile_name = ""
        self.current: Profile | None = None
        self.surface: surface_fit.Surface | None = None
        self.fade = surface_fit.Fade()
        self.shift = (0.0, 0.0, 0.0)  # x, y and fade of BED_MESH_OFFSET
        self.next_transform: Any = None
        self._last = [0.0, 0.0, 0.0, 0.0]
        ffi, lib = chelper.get_ffi()
        self._stage = ffi.new("struct path_stage *", {"kind": lib.PATH_BED})
        self._status: dict[str, Any] = {}
        self.bmc = CalibrationNames(self)
        # of the run under way
        self._layout = Layout(shape, ())
        self._profile_to_be = "default"
        self._note_status()

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("BED_MESH_CALIBRATE", "Perform Mesh Bed Leveling"),
            ("BED_MESH_OUTPUT", "Retrieve interpolated grid of probed z-points"),
            ("BED_MESH_MAP", "Serialize mesh and output to terminal"),
            ("BED_MESH_CLEAR", "Clear the Mesh so no z-adjustment is made"),
            ("BED_MESH_OFFSET", "Add X/Y offsets to the mesh lookup"),
            ("BED_MESH_PROFILE", "Bed Mesh Persistent Storage management"),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)
        webhooks = self.printer.lookup_object("webhooks", None)
        if webhooks is not None:
            webhooks.register_endpoint("bed_mesh/dump_mesh", self._handle_dump)

    def _handle_connect(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move")
        self.next_transform = gcode_move.set_move_transform(self, force=True)
        if self.next_transform is None:
            self.next_transform = self.printer.lookup_object("toolhead")

    # -- the transform --

    @property
    def passes_to(self) -> Any:
        """Who gets every move unchanged; None while there is a mesh."""
        return self.next_transform if self.surface is None else None

    def row_stage(self) -> Any:
        """This transform for a row of moves that starts where the last one ended."""
        assert self.surface is not None
        self._stage.bed = self.surface.record
        self._stage.last = self._last[:4]
        return self._stage

    def take_row(self, stage: Any) -> None:
        """Such a row has been run."""
        self._last[:4] = stage.last

    def get_position(self) -> list[float]:
        """Where the toolhead is, correction taken off."""
        position = list(self.next_transform.get_position())
        if self.surface is not None:
            surface_z = self.surface.z(position[0] + self.shift[0], position[1] + self.shift[1])
            position[2] = self.fade.undo(position[2], surface_z, self.shift[2])
        self._last = position
        return list(position)

    @done_in_c
    def move(self, newpos: Sequence[float], speed: float) -> None:
        if self.surface is None:
            self.next_transform.move(newpos, speed)
            return
        for corner in surface_fit.split_line(self.surface, self._last, newpos):
            self.next_transform.move(corner, speed)
        self._last = list(newpos)

    # -- taking a mesh --

    def _fade_for(self, surface: surface_fit.Surface) -> surface_fit.Fade:
        """The fade by the options. Raises MeshError if the surface is too uneven for it."""
        options = self.options
        if options.fade_end <= options.fade_start:
            return surface_fit.Fade()
        low, high = surface.range()
        target = options.fade_target
        if target is None:
            target = surface.mean()
        elif target and not low <= target <= high:
            raise MeshError(
                f"fade_target {target:.4f} lies outside of the mesh's range, {low:.4f} to {high:.4f}"
            )
        fade = surface_fit.Fade(options.fade_start, options.fade_end, target)
        if not fade.allows(low, high):
            raise MeshError(
                f"the mesh ({low:.4f} to {high:.4f}) is too uneven to fade out between fade_start "
                f"{options.fade_start:g} and fade_end {options.fade_end:g}"
            )
        return fade

    def use(self, mesh: Profile | None, name: str) -> None:
        """Follow a mesh from now on; None: none. Raises command_error and changes nothing then."""
        surface, fade = None, surface_fit.Fade()
        if mesh is not None:
            surface = mesh.shape.surface(mesh.rows)
            try:
                fade = self._fade_for(surface)
            except MeshError as e:
                raise self.printer.command_error(f"bed_mesh: {e}") from None
        self.current, self.surface, self.fade = mesh, surface, fade
        self._set_out()
        self.profile_name = name
        self._note_status()
        self.printer.lookup_object("gcode_move").reset_last_position()

    def _set_out(self) -> None:
        """Pass the surface how it is followed."""
        if self.surface is not None:
            options = self.options
            self.surface.follow(self.fade, self.shift, options.check_distance, options.split_delta_z)

    def set_mesh(self, mesh: Profile | ZMesh | None) -> None:
        """For other modules."""
        if isinstance(mesh, ZMesh):
            self.use(mesh.profile, mesh.name)
        else:
            self.use(mesh, self.profile_name if mesh is not None else "")

    def get_mesh(self) -> Profile | None:
        return self.current

    def _note_status(self) -> None:
        mesh, surface = self.current, self.surface
        status: dict[str, Any] = {
            "profile_name": self.profile_name,
            "mesh_min": (0.0, 0.0),
            "mesh_max": (0.0, 0.0),
            "probed_matrix": [[]],
            "mesh_matrix": [[]],
            "profiles": {
                name: {"points": profile.rows, "mesh_params": profile.mesh_params()}
                for name, profile in self.profiles.items()
            },
        }
        if mesh is not None and surface is not None:
            status.update(
                mesh_min=mesh.shape.low,
                mesh_max=mesh.shape.high,
                probed_matrix=mesh.rows,
                mesh_matrix=surface.heights,
            )
        self._status = status

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status

    # -- probing --

    def _object_corners(self) -> list[tuple[float, float]]:
        """Corners of all objects the slicer has defined."""
        exclude = self.printer.lookup_object("exclude_object", None)
        objects = exclude.get_status(0.0)["objects"] if exclude is not None else []
        return [(float(x), float(y)) for known in objects for x, y in known.get("polygon", ())]

    def _choose_shape(self, gcmd: GCodeCommand) -> tuple[MeshShape, bool]:
        """What a command asks for, and whether it goes by the objects. Raises MeshError."""
        shape = changed_shape(self.shape, gcmd)
        if not gcmd.get_int("ADAPTIVE", 0):
            return shape, False
        margin = gcmd.get_float("ADAPTIVE_MARGIN", self.options.adaptive_margin, minval=0.0)
        corners = self._object_corners()
        if not corners:
            gcmd.respond_info("No objects are defined: the default mesh is probed")
            return shape, False
        shape = shape.adapted(corners, margin)
        gcmd.respond_info(
            f"Adapted mesh bounds: ({shape.low[0]:.2f}, {shape.low[1]:.2f}) to ({shape.high[0]:.2f}, "
            f"{shape.high[1]:.2f}), {shape.counts[0]} x {shape.counts[1]} points"
        )
        return shape, True

    def plan(self, shape: MeshShape) -> Layout:
        """What to probe for a shape. Raises MeshError."""
        return shape.plan(self.options.faulty, self.options.zero_reference)

    def cmd_BED_MESH_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """BED_MESH_CALIBRATE [PROFILE=] [METHOD=automatic|manual|scan|rapid_scan] [ADAPTIVE=1] ..."""
        name = gcmd.get("PROFILE", "default")
        if not name.strip():
            raise gcmd.error("PROFILE needs a name")
        try:
            shape, adaptive = self._choose_shape(gcmd)
            layout = self.plan(shape)
        except MeshError as e:
            raise gcmd.error(f"bed_mesh: {e}") from None
        self.points.update_probe_points(layout.places(), 3)
        self._layout, self._profile_to_be = layout, ADAPTIVE_PROFILE if adaptive else name
        self.use(None, "")
        self.points.start_probe(gcmd)

    def _finish_probing(self, offsets: Sequence[float], places: list[list[float]]) -> None:
        layout, name = self._layout, self._profile_to_be
        shape, reference = layout.shape, self.options.zero_reference
        heights = [place[2] - offsets[2] for place in places]
        zero = heights.pop() if layout.reference is not None else 0.0
        rows = shape.rows(layout.cells, heights)
        if reference is not None and layout.reference is None:
            zero = shape.surface(rows).z(*reference)
        mesh = Profile(shape, tuple(tuple(z - zero for z in row) for row in rows))
        self.use(mesh, name)
        gcode = self.printer.lookup_object("gcode")
        gcode.respond_info("Mesh Bed Leveling Complete")
        if name != ADAPTIVE_PROFILE:  # that one is for this print only
            self._save(name)

    # -- profiles --

    def save_profile(self, name: str) -> None:
        """Keep the mesh in force, for this session and for SAVE_CONFIG. Raises command_error without one."""
        if self.current is None:
            raise self.printer.command_error("Unable to save to profile, the bed has not been probed")
        self._save(name)

    def _save(self, name: str) -> None:
        assert self.current is not None
        configfile = self.printer.lookup_object("configfile")
        for option, value in profile_options(self.current).items():
            configfile.set(f"bed_mesh {name}", option, value)
        # what is saved and what is in force have the same digits
        rows = tuple(tuple(round(z, 6) for z in row) for row in self.current.rows)
        self.profiles = {**self.profiles, name: replace(self.current, rows=rows)}
        self.profile_name = name
        self._note_status()
        self.printer.lookup_object("gcode").respond_info(
            f"Bed Mesh state has been saved to profile [{name}]\n"
            "for the current session.  The SAVE_CONFIG command will\n"
            "update the printer config file and restart the printer."
        )

    def cmd_BED_MESH_PROFILE(self, gcmd: GCodeCommand) -> None:
        """BED_MESH_PROFILE LOAD=<name>|SAVE=<name>|REMOVE=<name>."""
        action = next((a for a in ("LOAD", "SAVE", "REMOVE") if gcmd.get(a, None) is not None), None)
        if action is None:
            raise gcmd.error("BED_MESH_PROFILE needs LOAD=, SAVE= or REMOVE= with the name of a profile")
        name = gcmd.get(action)
        if not name.strip():
            raise gcmd.error(f"Value for parameter '{action}' must be specified")
        if action == "SAVE":
            self.save_profile(name)
        elif name not in self.profiles:
            raise gcmd.error(f"bed_mesh: Unknown profile [{name}]")
        elif action == "LOAD":
            self.use(self.profiles[name], name)
        else:
            self._remove(gcmd, name)

    def _remove(self, gcmd: GCodeCommand, name: str) -> None:
        self.profiles = {other: profile for other, profile in self.profiles.items() if other != name}
        self.printer.lookup_object("configfile").remove_section(f"bed_mesh {name}")
        self._note_status()
        gcmd.respond_info(
            f"Profile [{name}] removed from storage for this session.\n"
            "The SAVE_CONFIG command will update the printer\nconfiguration and restart the printer"
        )

    # -- other commands --

    def cmd_BED_MESH_CLEAR(self, gcmd: GCodeCommand) -> None:
        """No mesh from now on."""
        self.use(None, "")

    def cmd_BED_MESH_OFFSET(self, gcmd: GCodeCommand) -> None:
        """BED_MESH_OFFSET [X=mm] [Y=mm] [ZFADE=mm]: of a further nozzle, against the first."""
        if self.surface is None:
            gcmd.respond_info("No mesh loaded to offset")
            return
        self.shift = (
            gcmd.get_float("X", self.shift[0]),
            gcmd.get_float("Y", self.shift[1]),
            gcmd.get_float("ZFADE", self.shift[2]),
        )
        self._set_out()
        self.printer.lookup_object("gcode_move").reset_last_position()

    def cmd_BED_MESH_OUTPUT(self, gcmd: GCodeCommand) -> None:
        """BED_MESH_OUTPUT [PGP=1]: the mesh for people; PGP=1 the places that would be probed, too."""
        if gcmd.get_int("PGP", 0):
            self._report_points(gcmd)
        mesh, surface = self.current, self.surface
        if mesh is None or surface is None:
            gcmd.respond_info("Bed has not been probed")
            return
        low, high = surface.range()
        gcmd.respond_info(f"Mesh Leveling Probed Z positions:\n{_table(mesh.rows)}")
        gcmd.respond_info(
            f"Mesh X,Y: {len(surface.heights[0])},{len(surface.heights)}\n"
            f"Search Height: {self.points.default_horizontal_move_z:g}\n"
            f"Mesh Offsets: X={self.shift[0]:.4f}, Y={self.shift[1]:.4f}, ZFADE={self.shift[2]:.4f}\n"
            f"Mesh Average: {surface.mean():.4f}\nMesh Range: min={low:.4f} max={high:.4f}\n"
            f"Interpolation Algorithm: {mesh.mesh_params()['algo']}\nMeasured points:\n{_table(surface.heights)}"
        )

    def _report_points(self, gcmd: GCodeCommand) -> None:
        probe = self.printer.lookup_object("probe", None)
        x_offset, y_offset = probe.get_offsets()[:2] if probe is not None else (0.0, 0.0)
        try:
            places = self.plan(self.shape).places()
        except MeshError as e:
            raise gcmd.error(f"bed_mesh: {e}") from None
        lines = ["bed_mesh: generated points", "Index | Tool Adjusted | Probe"]
        for number, (x, y) in enumerate(places):
            lines.append(f"{number} | ({x - x_offset:.1f}, {y - y_offset:.1f}) | ({x:.1f}, {y:.1f})")
        gcmd.respond_info("\n".join(lines))

    def cmd_BED_MESH_MAP(self, gcmd: GCodeCommand) -> None:
        """The mesh for programs."""
        if self.current is None:
            gcmd.respond_info("Bed has not been probed")
            return
        shape = self.current.shape
        what = {"mesh_min": shape.low, "mesh_max": shape.high, "z_positions": self.current.rows}
        gcmd.respond_raw(f"mesh_map_output {json.dumps(what)}")

    def _handle_dump(self, web_request: Any) -> None:
        """Endpoint bed_mesh/dump_mesh [mesh_args]."""
        args = {str(k).upper(): str(v) for k, v in (web_request.get_dict("mesh_args", {}) or {}).items()}
        gcode = self.printer.lookup_object("gcode")
        gcmd = gcode.create_gcode_command("BED_MESH_CALIBRATE", "BED_MESH_CALIBRATE", args)
        try:
            shape, _ = self._choose_shape(gcmd)
            places = self.plan(shape).places()
        except MeshError as e:
            raise gcode.error(f"bed_mesh: {e}") from None
        current = {}
        if self.current is not None and self.surface is not None:
            current = {
                "name": self.profile_name,
                "probed_matrix": self.current.rows,
                "mesh_matrix": self.surface.heights,
                "mesh_params": self.current.mesh_params(),
            }
        probe = self.printer.lookup_object("probe", None)
        web_request.send(
            {
                "current_mesh": current,
                "profiles": self._status["profiles"],
                "calibration": {
                    "points": places,
                    "probe_path": places,
                    "rapid_path": [],
                    "config": Profile(shape, ()).mesh_params(),
                },
                "probe_offsets": list(probe.get_offsets()) if probe is not None else None,
            }
        )


def _table(rows: Sequence[Sequence[float]]) -> str:
    return "\n".join(" ".join(f"{z:9.6f}" for z in row) for row in rows)


def _reference_by_index(config: ConfigWrapper, shape: MeshShape, options: MeshOptions) -> MeshOptions:
    """The older relative_reference_index: a number among the points instead of a place."""
    index = config.getint("relative_reference_index", None)
    if index is None or options.zero_reference is not None:
        return options
    config.deprecate("relative_reference_index")
    cells = shape.plan().cells
    if not 0 <= index < len(cells):
        raise config.error(
            f"Option 'relative_reference_index' in section '{config.get_name()}' is {index}; "
            f"there are {len(cells)} points"
        )
    place = cells[index].places[0]
    logging.info("bed_mesh: relative_reference_index %d is (%.2f, %.2f)", index, *place)
    return replace(options, zero_reference=place)


def load_config(config: ConfigWrapper) -> BedMesh:
    printer = config.get_printer()
    printer.load_object(config, "gcode_move")
    shape = read_shape(config)
    options = _reference_by_index(config, shape, read_options(config))
    mesh = BedMesh(config, shape, options, read_profiles(config))
    mesh.register()
    return mesh
