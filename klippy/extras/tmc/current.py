"""From amperes to what a stepper driver's registers want: three ways that Trinamic's chips scale their current.

TMC2208 and 2209: compared with the datasheet's table of sense resistors (2209, rev. 1.03, chapter 8; vsense 0).
TMC2240: ranges as an independent library (TMCStepper) has them, the largest as on the datasheet's first page. Not
compared with a document: 0.32 V of the TMC2130, 0.31 and 0.165 V of the TMC2660, 0.325 V and the rule for GLOBALSCALER
of the TMC5160.

Pure. A scale of CS gives (CS + 1) / 32 of the full current; `fields(run, hold)` are the register fields for these
currents (A, rms), `largest_a` is what the chip can be set to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

SCALES = 32
SCALER_STEPS, SCALER_MIN = 256, 32  # GLOBALSCALER: 0 stands for 256, below 32 it must not be


class CurrentModel(Protocol):
    """What a driver asks of it."""

    @property
    def largest_a(self) -> float: ...

    def fields(self, run_a: float, hold_a: float) -> dict[str, int]: ...


def scale_of(share: float) -> int:
    """CS, 0 to 31, nearest to a share of the full current."""
    return min(SCALES - 1, max(0, round(share * SCALES) - 1))


@dataclass(frozen=True, slots=True)
class TwoRanges:
    """TMC2130, 2208, 2209: vsense chooses the voltage over the sense resistor at full scale; 20 mohm of the chip are in
    series with it (datasheets, chapter on sense resistors)."""

    sense_ohm: float
    full_scale_v: tuple[float, float]  # vsense 0, vsense 1
    inner_ohm: float = 0.020

    def full_a(self, vsense: int) -> float:
        return self.full_scale_v[vsense] / (self.sense_ohm + self.inner_ohm) / math.sqrt(2.0)

    @property
    def largest_a(self) -> float:
        return self.full_a(0)

    def fields(self, run_a: float, hold_a: float) -> dict[str, int]:
        """The finer range if it reaches."""
        vsense = int(round(run_a / self.full_a(1) * SCALES) <= SCALES)
        full_a = self.full_a(vsense)
        return {
            "vsense": vsense,
            "irun": scale_of(run_a / full_a),
            "ihold": scale_of(min(hold_a, run_a) / full_a),
        }


@dataclass(frozen=True, slots=True)
class OneScale(TwoRanges):
    """TMC2660: one scale, no holding current."""

    full_scale_v: tuple[float, float] = (0.310, 0.165)
    inner_ohm: float = 0.0

    def fields(self, run_a: float, hold_a: float) -> dict[str, int]:
        """Of the running motor."""
        fields = TwoRanges.fields(self, run_a, hold_a)
        return {"vsense": fields["vsense"], "cs": fields["irun"]}


@dataclass(frozen=True, slots=True)
class GlobalScaler:
    """A factor for both coils, and CS below it: TMC5160 (`full_a` by its sense resistor), TMC2240 (by its range)."""

    full_a: float

    @property
    def largest_a(self) -> float:
        return self.full_a

    def fields(self, run_a: float, hold_a: float) -> dict[str, int]:
        """CS of the running motor as high as can be (its microsteps are finest then), the rest by the factor."""
        scaler = max(SCALER_MIN, min(SCALER_STEPS, round(run_a / self.full_a * SCALER_STEPS)))
        scaled_a = self.full_a * scaler / SCALER_STEPS
        return {
            "globalscaler": scaler % SCALER_STEPS,
            "irun": scale_of(run_a / scaled_a),
            "ihold": scale_of(min(hold_a, run_a) / scaled_a),
        }


def tmc5160_current(sense_ohm: float) -> GlobalScaler:
    """Datasheet of the TMC5160, chapter 9: 325 mV at full scale."""
    return GlobalScaler(0.325 / sense_ohm / math.sqrt(2.0))


@dataclass(frozen=True, slots=True)
class ReferenceResistor:
    """TMC2240: no sense resistors; the peak at full scale is K / R(REF), K by range (datasheet, current range)."""

    reference_ohm: float
    range_av: tuple[float, ...] = (11750.0, 24000.0, 36000.0)  # A*ohm

    def _range(self, number: int) -> GlobalScaler:
        return GlobalScaler(self.range_av[number] / self.reference_ohm / math.sqrt(2.0))

    @property
    def largest_a(self) -> float:
        return self._range(len(self.range_av) - 1).full_a

    def fields(self, run_a: float, hold_a: float) -> dict[str, int]:
        """The smallest range that reaches."""
        last = len(self.range_av) - 1
        number = next((n for n in range(last) if run_a <= self._range(n).full_a), last)
        return {"current_range": number, **self._range(number).fields(run_a, hold_a)}
