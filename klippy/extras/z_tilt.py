"""[z_tilt]: Z_TILT_ADJUST takes the tilt of the bed out by turning Z motors one against the other."""

from __future__ import annotations

from configfile import ConfigWrapper

from .probing import surface_fit
from .probing.z_level import ZLevel


def load_config(config: ConfigWrapper) -> ZLevel:
    positions = config.getlists("z_positions", seps=(",", "\n"), parser=float, count=2)
    if len(positions) < 2:
        raise config.error(
            f"Section '{config.get_name()}': z_positions needs a place for each Z motor, two at least"
        )

    def heights(places: list[list[float]]) -> list[float]:
        plane = surface_fit.fit_plane(places, [place[2] for place in places])
        return [plane.z(x, y) for x, y in positions]

    level = ZLevel(config, len(positions), heights, bed_is_zero=True)
    level.points.minimum_points(2)
    for name, places in (("z_positions", positions), ("points", level.points.probe_points or ())):
        if len(positions) > 2 and surface_fit.on_a_line(places):
            raise config.error(
                f"Section '{config.get_name()}': {name} lie on a line; with {len(positions)} motors they must not"
            )
    level.register("Z_TILT_ADJUST", "Adjust the Z tilt")
    return level
