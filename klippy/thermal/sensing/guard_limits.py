"""The table the MCU's guard trips on: raw codes a healthy nozzle can read, for each bridge phase.

The guard must work with the host dead, so it knows no law, only numbers: from `temp_low_c` to `temp_high_c`
the law says which signal to expect at a phase, the front end which codes those are; noise of a whole
block is far below the margin. At full drive the law is flatter, so the same margin in degrees is fewer codes;
that is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .block_temperature import SENSING_PHASE_TICKS
from .features import FeatureParameters
from .laws import Law

# Spaced so that the law's slope changes by under 10 % from row to row (0.2 5 10 20 30 ... 100 % power).
_POWER_PERCENT = (0.2, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0)


STEP_C = 5.0  # a target that moves along a plan, or a correction, is not worth a message for less


def stepped(temp_c: float) -> float:
    """The next step from this temperature on."""
    return STEP_C * math.ceil(temp_c / STEP_C) if temp_c < math.inf else math.inf


@dataclass(frozen=True, slots=True)
class LimitRow:
    """Raw codes between which a healthy nozzle reads at this phase."""

    phase_ticks: int
    low_raw: int
    high_raw: int


def _raw(law: Law, front: FeatureParameters, temp_c: float, phase: float) -> float:
    """Code the law predicts."""
    return front.adc_zero_raw + law.error(temp_c, phase) / front.units_per_lsb


@dataclass(frozen=True, slots=True)
class Ceiling:
    """How far up a row a nozzle may read that is driven with `phase_ticks` or more: its target, and a margin."""

    phase_ticks: int
    law: Law
    front: FeatureParameters
    rows: tuple[LimitRow, ...]
    margin_c: float

    def share(self, target_c: float, drift_c: float = 0.0) -> int:
        """In 1/65536 of the way from a row's low limit to its high one, the highest of all rows; 65535: all of it.

        `drift_c`: what the law is corrected by.
        """
        if target_c == math.inf:
            return 0xFFFF
        temp_c = stepped(target_c) + self.margin_c
        law = self.law.drifted(stepped(drift_c))
        rows = [row for row in self.rows if row.phase_ticks >= self.phase_ticks]
        reach = max(
            (_raw(law, self.front, temp_c, r.phase_ticks) - r.low_raw) / (r.high_raw - r.low_raw)
            for r in rows
        )
        return min(0xFFFF, max(0, math.ceil(0x10000 * reach)))


def guard_limits(
    law: Law,
    front: FeatureParameters,
    temp_low_c: float,
    temp_high_c: float,
    phase_low_ticks: int = SENSING_PHASE_TICKS,
) -> list[LimitRow]:
    """Rows of ascending phase, from `phase_low_ticks` on. Raises ValueError if the front end cannot show these
    temperatures at all.

    The guard takes a row from its phase up to the next row's, so a row holds the wider of the limits at its
    ends.
    """
    phases = [round(front.phase_max_ticks * math.sqrt(percent / 100.0)) for percent in _POWER_PERCENT]
    phases = sorted({phase_low_ticks, *(phase for phase in phases if phase > phase_low_ticks)})
    rows = []
    for phase, end in zip(phases, [*phases[1:], phases[-1]], strict=True):
        low = min(_raw(law, front, temp_low_c, phase), _raw(law, front, temp_low_c, end))
        high = max(_raw(law, front, temp_high_c, phase), _raw(law, front, temp_high_c, end))
        if not low < high or high < 0.0 or low > front.adc_max_raw:
            raise ValueError(f"the ADC cannot show {temp_low_c:.0f}..{temp_high_c:.0f} C at phase {phase}")
        rows.append(LimitRow(phase, max(0, math.floor(low)), min(front.adc_max_raw, math.ceil(high))))
    return rows
