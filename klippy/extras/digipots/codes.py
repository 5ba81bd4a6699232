"""Values of digital potentiometers and DACs: written once at each start, for instance the reference of a driver."""

from __future__ import annotations

from collections.abc import Sequence

from configfile import ConfigWrapper


def read_codes(config: ConfigWrapper, options: Sequence[str], full_code: int) -> dict[int, int]:
    """Code of each channel that has a value, by number: 0 to `full_code` for 0 to option scale."""
    scale = config.getfloat("scale", 1.0, above=0.0)
    codes = {}
    for number, option in enumerate(options):
        value = config.getfloat(option, None, minval=0.0, maxval=scale)
        if value is not None:
            codes[number] = int(value / scale * full_code + 0.5)
    return codes
