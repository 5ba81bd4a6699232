"""[quad_gantry_level]: QUAD_GANTRY_LEVEL levels a gantry that hangs on four Z motors and may be twisted.

Z1 ────── Z2        gantry_corners: Z and Z2; points: probed near Z, Z1, Z2, Z3
Z  ────── Z3
"""

from __future__ import annotations

from configfile import ConfigWrapper

from .probing import surface_fit
from .probing.z_level import ZLevel


def load_config(config: ConfigWrapper) -> ZLevel:
    corners = config.getlists("gantry_corners", seps=(",", "\n"), parser=float, count=2)
    if len(corners) != 2:
        raise config.error(f"Section '{config.get_name()}': gantry_corners is two places, of Z and of Z2")
    (x0, y0), (x1, y1) = corners
    if x0 >= x1 or y0 >= y1:
        raise config.error(
            f"Section '{config.get_name()}': gantry_corners is the front left place, then the back right one"
        )

    def heights(places: list[list[float]]) -> list[float]:
        surface = surface_fit.fit_twisted(places, [place[2] for place in places])
        return [surface(x0, y0), surface(x0, y1), surface(x1, y1), surface(x1, y0)]

    level = ZLevel(config, 4, heights, config.getfloat("max_adjust", 4.0, above=0.0))
    points = level.points.probe_points or ()
    try:
        if len(points) != 4:
            raise ValueError(f"there are {len(points)} points")
        surface_fit.fit_twisted(points, [0.0] * 4)
    except ValueError as e:
        raise config.error(
            f"Section '{config.get_name()}': points is one place near each of Z, Z1, Z2, Z3; {e}"
        ) from None
    level.register("QUAD_GANTRY_LEVEL", "Conform a moving, twistable gantry to the shape of a stationary bed")
    return level
