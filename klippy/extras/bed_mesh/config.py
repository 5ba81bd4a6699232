"""Reading a bed mesh: from [bed_mesh], from the parameters of BED_MESH_CALIBRATE, from saved profiles."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .points import ALGORITHMS, MIN_COUNT, MeshError, MeshShape, Region

PROFILE_VERSION = 1
_REGION = re.compile(r"faulty_region_(\d+)_(min|max)")


@dataclass(frozen=True, slots=True)
class MeshOptions:
    """[bed_mesh] without the shape of the mesh; mm."""

    faulty: tuple[Region, ...]
    zero_reference: tuple[float, float] | None
    adaptive_margin: float
    check_distance: float
    split_delta_z: float
    fade_start: float
    fade_end: float
    fade_target: float | None
    scan_overshoot: float = 0.0


@dataclass(frozen=True, slots=True)
class Profile:
    """A mesh that can be loaded."""

    shape: MeshShape
    rows: tuple[tuple[float, ...], ...]

    def mesh_params(self) -> dict[str, Any]:
        """As printer.cfg and clients name them."""
        shape = self.shape
        return {
            "min_x": shape.low[0],
            "max_x": shape.high[0],
            "min_y": shape.low[1],
            "max_y": shape.high[1],
            "x_count": shape.counts[0],
            "y_count": shape.counts[1],
            "mesh_x_pps": shape.pps[0],
            "mesh_y_pps": shape.pps[1],
            "algo": "direct" if shape.pps == (0, 0) else shape.algorithm,
            "tension": shape.tension,
        }


def _pair(values: Sequence[int], what: str) -> tuple[int, int]:
    """One number counts for both axes."""
    if len(values) not in (1, 2):
        raise MeshError(f"{what} is one number, or two separated by a comma")
    return values[0], values[-1]


def read_shape(config: ConfigWrapper) -> MeshShape:
    try:
        return _read_shape(config).checked()
    except MeshError as e:
        raise config.error(f"Section '{config.get_name()}': {e}") from None


def _read_shape(config: ConfigWrapper) -> MeshShape:
    pps = _pair(config.getintlist("mesh_pps", (2,)), "mesh_pps")
    if min(pps) < 0:
        raise MeshError("mesh_pps cannot be negative")
    algorithm = config.getchoice("algorithm", ALGORITHMS, "lagrange")
    tension = config.getfloat("bicubic_tension", 0.2, minval=0.0, maxval=2.0)
    more = {"pps": pps, "algorithm": algorithm, "tension": tension}
    radius = config.getfloat("mesh_radius", None, above=0.0)
    if radius is not None:
        x, y = config.getfloatlist("mesh_origin", (0.0, 0.0), count=2)
        count = config.getint("round_probe_count", 5, minval=MIN_COUNT)
        return MeshShape.round((x, y), radius, count, **more)
    low, high = (config.getfloatlist(option, count=2) for option in ("mesh_min", "mesh_max"))
    counts = _pair(config.getintlist("probe_count", (3,)), "probe_count")
    return MeshShape((low[0], low[1]), (high[0], high[1]), counts, **more)


def read_options(config: ConfigWrapper) -> MeshOptions:
    start, end = config.getfloat("fade_start", 1.0), config.getfloat("fade_end", 0.0)
    zero = config.getfloatlist("zero_reference_position", None, count=2)
    return MeshOptions(
        _read_regions(config),
        None if zero is None else (zero[0], zero[1]),
        config.getfloat("adaptive_margin", 0.0, minval=0.0),
        config.getfloat("move_check_distance", 5.0, minval=3.0),
        config.getfloat("split_delta_z", 0.025, minval=0.01),
        start,
        end,
        config.getfloat("fade_target", None),
        config.getfloat("scan_overshoot", 0.0, minval=1.0),
    )


def _read_regions(config: ConfigWrapper) -> tuple[Region, ...]:
    found = (_REGION.fullmatch(name) for name in config.get_prefix_options("faulty_region_"))
    regions: list[Region] = []
    for number in sorted({int(match[1]) for match in found if match}):
        corners = [config.getfloatlist(f"faulty_region_{number}_{end}", count=2) for end in ("min", "max")]
        low, high = (tuple(pick(pair) for pair in zip(*corners, strict=True)) for pick in (min, max))
        region = Region((low[0], low[1]), (high[0], high[1]))
        if any(region.overlaps(other) for other in regions):
            raise config.error(
                f"Section '{config.get_name()}': faulty_region_{number} overlaps another faulty region"
            )
        regions.append(region)
    return tuple(regions)


def changed_shape(shape: MeshShape, gcmd: GCodeCommand) -> MeshShape:
    """With the parameters of a command. Raises MeshError."""

    def numbers(name: str, parser: Any) -> Any:
        return gcmd.get(name, None, lambda text: [parser(part) for part in text.split(",")])

    def place(name: str, default: tuple[float, float]) -> tuple[float, float]:
        found = numbers(name, float)
        if found is not None and len(found) != 2:
            raise MeshError(f"{name} is two numbers separated by a comma")
        return default if found is None else (found[0], found[1])

    pps, counts = numbers("MESH_PPS", int), numbers("PROBE_COUNT", int)
    algorithm = gcmd.get("ALGORITHM", shape.algorithm).lower()
    if algorithm not in ALGORITHMS:
        raise MeshError(f"ALGORITHM is '{algorithm}'; it can be {' or '.join(ALGORITHMS)}")
    more: dict[str, Any] = {
        "pps": shape.pps if pps is None else _pair(pps, "MESH_PPS"),
        "algorithm": algorithm,
        "tension": shape.tension,
    }
    if min(more["pps"]) < 0:
        raise MeshError("MESH_PPS cannot be negative")
    if shape.radius is not None:
        return MeshShape.round(
            place("MESH_ORIGIN", shape.origin),
            gcmd.get_float("MESH_RADIUS", shape.radius, above=0.0),
            gcmd.get_int("ROUND_PROBE_COUNT", shape.counts[0], minval=MIN_COUNT),
            **more,
        ).checked()
    return replace(
        shape,
        low=place("MESH_MIN", shape.low),
        high=place("MESH_MAX", shape.high),
        counts=shape.counts if counts is None else _pair(counts, "PROBE_COUNT"),
        **more,
    ).checked()


# ---- profiles --------------------------------------------------------------------------------------------------


def read_profiles(config: ConfigWrapper) -> dict[str, Profile]:
    """The sections [bed_mesh NAME]."""
    profiles = {}
    for section in config.get_prefix_sections("bed_mesh "):
        name = section.get_name().split(" ", 1)[1]
        version = section.getint("version", 0)
        if version != PROFILE_VERSION:
            config.get_printer().lookup_object("configfile").runtime_warning(
                f"Profile [bed_mesh {name}] has version {version}, not {PROFILE_VERSION}: it is left out. Probe anew."
            )
            for option in section.get_prefix_options(""):
                section.get(option)
            continue
        profiles[name] = _read_profile(section)
    return profiles


def _read_profile(section: Any) -> Profile:
    rows = section.getlists("points", seps=(",", "\n"), parser=float)
    low = section.getfloat("min_x"), section.getfloat("min_y")
    high = section.getfloat("max_x"), section.getfloat("max_y")
    counts = section.getint("x_count"), section.getint("y_count")
    pps = section.getint("mesh_x_pps"), section.getint("mesh_y_pps")
    algorithm = section.getchoice("algo", {name: name for name in (*ALGORITHMS, "direct")})
    shape = MeshShape(low, high, counts, pps, "lagrange" if algorithm == "direct" else algorithm,
                      section.getfloat("tension"))  # fmt: skip
    if len(rows) != counts[1] or any(len(row) != counts[0] for row in rows):
        raise section.error(
            f"Section '{section.get_name()}': points is not {counts[1]} rows of {counts[0]} heights"
        )
    try:
        return Profile(shape.checked(), rows)
    except MeshError as e:
        raise section.error(f"Section '{section.get_name()}': {e}") from None


def profile_options(profile: Profile) -> dict[str, Any]:
    """What SAVE_CONFIG writes of it."""
    rows = "".join("\n" + ", ".join(f"{z:.6f}" for z in row) for row in profile.rows)
    return {"version": PROFILE_VERSION, "points": rows, **profile.mesh_params()}
