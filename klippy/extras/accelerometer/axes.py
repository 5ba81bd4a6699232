"""How an accelerometer is mounted: which of its axes, with which sign, lies along each of the printer's."""

from __future__ import annotations

from configfile import ConfigWrapper

AxesMap = tuple[int, int, int]  # 1, 2, 3 for x, y, z; negative: the other way


def parse_axes_map(text: str) -> AxesMap:
    """'-y, x, z' -> (-2, 1, 3). Raises ValueError."""
    words = [word.strip().lower() for word in text.split(",")]
    axes = [(-1 if word[:1] == "-" else 1) * (1 + "xyz".index(word.lstrip("-"))) for word in words if word]
    if len(axes) != 3 or {abs(a) for a in axes} != {1, 2, 3}:
        raise ValueError(text)
    return axes[0], axes[1], axes[2]


def read_axes_map(config: ConfigWrapper, option: str = "axes_map") -> AxesMap:
    """The option's map; x, y, z by default."""
    text = config.get(option, "x, y, z")
    try:
        return parse_axes_map(text)
    except ValueError:
        raise config.error(
            f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): '{text}' must name x, y and"
            " z once each, with a minus where the axis points the other way, such as -y, x, z."
        ) from None


def axis_number(config: ConfigWrapper, option: str, default: str) -> int:
    """0 to 2 of x, y or z."""
    return "xyz".index(config.getchoice(option, {axis: axis for axis in "xyz"}, default))


def mounted_as(axes_map: AxesMap) -> AxesMap:
    """The printer's axis that each of the sensor's own points along."""
    found = {abs(sensor): (axis if sensor > 0 else -axis) for axis, sensor in enumerate(axes_map, 1)}
    return found[1], found[2], found[3]
