"""Filters of second-order sections for the firmware (src/sos_filter.h): designed here, sent in fixed point.

Butterworth filters of order 1 and 2 and notches by the bilinear transform, with the frequency prewarped:
k = tan(pi f / rate). Coefficients are b0, b1, b2, a1, a2; a0 is 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

Section = tuple[float, float, float, float, float]
COEFFICIENT_BITS = 29  # coefficients lie within -2 and 2
SCALE_MAX = 1 << 30


def low_pass(cutoff_hz: float, rate_hz: float, order: int) -> Section:
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    if order == 1:
        return k / (1.0 + k), k / (1.0 + k), 0.0, (k - 1.0) / (k + 1.0), 0.0
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    return b0, 2.0 * b0, b0, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm


def high_pass(cutoff_hz: float, rate_hz: float, order: int) -> Section:
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    if order == 1:
        return 1.0 / (1.0 + k), -1.0 / (1.0 + k), 0.0, (k - 1.0) / (k + 1.0), 0.0
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return norm, -2.0 * norm, norm, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm


def notch(frequency_hz: float, rate_hz: float, quality: float) -> Section:
    w0 = 2.0 * math.pi * frequency_hz / rate_hz
    alpha, cosine = math.sin(w0) / (2.0 * quality), math.cos(w0)
    norm = 1.0 / (1.0 + alpha)
    return norm, -2.0 * cosine * norm, norm, -2.0 * cosine * norm, (1.0 - alpha) * norm


def fixed(section: Section) -> list[int]:
    """As the firmware takes it."""
    return [round(coefficient * (1 << COEFFICIENT_BITS)) for coefficient in section]


@dataclass(slots=True)
class Scale:
    """(raw - offset) * factor: whole numbers of what the trigger compares."""

    offset: int = 0
    factor: float = 1.0
    auto_offset: bool = False

    def fixed(self) -> tuple[int, int]:
        """Scale and its bits after the point, as fine as 32 bits allow."""
        bits = 0
        while bits < 31 and abs(self.factor) * (1 << bits + 1) < SCALE_MAX:
            bits += 1
        return round(self.factor * (1 << bits)), bits


@dataclass(slots=True)
class McuFilter:
    """The filter of one sensor on its board."""

    mcu: Any
    max_sections: int
    oid: int = field(init=False)
    _commands: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.oid = self.mcu.create_oid()

    def build(self, queue: Any) -> None:
        """Called when the board's commands are known."""
        self.mcu.add_config_cmd(f"config_sos_filter oid={self.oid} max_sections={self.max_sections}")
        look_up = self.mcu.lookup_command
        self._commands = {
            "section": look_up(
                "sos_filter_set_section oid=%c section_idx=%c sos0=%i sos1=%i sos2=%i sos3=%i sos4=%i",
                cq=queue,
            ),
            "scale": look_up(
                "sos_filter_set_offset_scale oid=%c offset=%i scale=%i scale_frac_bits=%c auto_offset=%c",
                cq=queue,
            ),
            "active": look_up("sos_filter_set_active oid=%c n_sections=%c coeff_frac_bits=%c", cq=queue),
        }

    def send(self, sections: Sequence[Section], scale: Scale) -> None:
        """Takes effect with the next homing move; states are those of a signal that was always at the offset."""
        factor, bits = scale.fixed()
        self._commands["scale"].send([self.oid, scale.offset, factor, bits, int(scale.auto_offset)])
        for number, section in enumerate(sections):
            self._commands["section"].send([self.oid, number, *fixed(section)])
        self._commands["active"].send([self.oid, len(sections), COEFFICIENT_BITS])
