"""Registers of Trinamic stepper drivers as named fields, and what is common to them: currents, speeds, microsteps.

Pure tables and arithmetic; tmc2209.py puts them to use. Source of the fields: datasheet of the TMC2209, rev. 1.09,
chapter 5; of the formulas: chapters 9 (sense resistors) and 5.2 (TSTEP).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

CLOCK_HZ = 12_000_000  # internal clock
FULL_SCALE_V = (0.325, 0.180)  # at the sense resistor, by vsense
INNER_OHM = 0.020  # of the chip, in series with the sense resistor
CURRENT_STEPS = 32
TSTEP_MAX = 0xFFFFF
MICROSTEPS_MAX = 256


@dataclass(frozen=True, slots=True)
class Field:
    """Bits `low` .. `low` + `width` - 1 of a register."""

    register: str
    low: int
    width: int

    def insert(self, word: int, value: int) -> int:
        mask = ((1 << self.width) - 1) << self.low
        return (word & ~mask) | (value << self.low & mask)

    def extract(self, word: int) -> int:
        return word >> self.low & ((1 << self.width) - 1)


def table(layout: str) -> dict[str, Field]:
    """Fields by name, from lines 'REGISTER: name low width, ...' (width 1 if left out)."""
    fields = {}
    for line in layout.strip().splitlines():
        register, _, rest = line.strip().partition(":")
        for entry in rest.split(","):
            name, low, *width = entry.split()
            fields[name] = Field(register, int(low), int(width[0]) if width else 1)
    return fields


class Fields:
    """The values of all registers that are written."""

    def __init__(self, fields: Mapping[str, Field]) -> None:
        self.fields = fields
        self.words: dict[str, int] = {}

    def set(self, name: str, value: int) -> str:
        """Set a field; returns its register. ValueError if the value does not fit."""
        field = self.fields[name]
        if not 0 <= value < 1 << field.width:
            raise ValueError(f"{name} is a number of {field.width} bits, 0 to {(1 << field.width) - 1}")
        self.words[field.register] = field.insert(self.words.get(field.register, 0), value)
        return field.register

    def get(self, name: str) -> int:
        field = self.fields[name]
        return field.extract(self.words.get(field.register, 0))

    def describe(self, register: str, word: int) -> str:
        """'CHOPCONF: 10000053 toff=3 hstrt=5 ...', without fields that are 0."""
        parts = [
            f"{name}={field.extract(word)}"
            for name, field in self.fields.items()
            if field.register == register and field.extract(word)
        ]
        return f"{register + ':':<11} {word:08x} {' '.join(parts)}".rstrip()


def largest_current_a(sense_ohm: float) -> float:
    """RMS, at full scale."""
    return FULL_SCALE_V[0] / (sense_ohm + INNER_OHM) / math.sqrt(2.0)


def current_bits(current_a: float, sense_ohm: float) -> tuple[int, int]:
    """(vsense, current scale 0..31) for an RMS current: the finer range if it reaches."""
    for vsense in (1, 0):
        full_a = FULL_SCALE_V[vsense] / (sense_ohm + INNER_OHM) / math.sqrt(2.0)
        scale = round(current_a / full_a * CURRENT_STEPS) - 1
        if scale < CURRENT_STEPS or not vsense:
            break
    return vsense, min(CURRENT_STEPS - 1, max(0, scale))


def scale_current_a(vsense: int, scale: int, sense_ohm: float) -> float:
    """RMS current of a scale."""
    return (scale + 1) / CURRENT_STEPS * FULL_SCALE_V[vsense] / (sense_ohm + INNER_OHM) / math.sqrt(2.0)


def speed_threshold(speed_mm_s: float, step_mm: float, microsteps: int) -> int:
    """TSTEP (clocks per 1/256 step) at a speed; 0 mm/s: never reached (the largest)."""
    if speed_mm_s <= 0.0:
        return TSTEP_MAX
    fine_step_mm = step_mm * microsteps / MICROSTEPS_MAX
    return min(TSTEP_MAX, round(CLOCK_HZ * fine_step_mm / speed_mm_s))


def microstep_bits(microsteps: int) -> int:
    """MRES: 0 for 256, 8 for full steps. ValueError for what the chip can not do."""
    if microsteps < 1 or microsteps > MICROSTEPS_MAX or microsteps & (microsteps - 1):
        raise ValueError("the driver knows 1, 2, 4, ... 256 microsteps")
    return 8 - (microsteps.bit_length() - 1)
