"""Registers of Trinamic stepper drivers as named fields, and what is common to them: speeds, microsteps.

Pure; the tables are in chips.py. TSTEP: datasheet of the TMC2209, rev. 1.09, chapter 5.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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

    def parts(self, register: str, word: int) -> dict[str, int]:
        """The fields of a register's value that are not 0."""
        return {
            name: field.extract(word)
            for name, field in self.fields.items()
            if field.register == register and field.extract(word)
        }

    def describe(self, register: str, word: int) -> str:
        """'CHOPCONF: 10000053 toff=3 hstrt=5 ...', without fields that are 0."""
        parts = [f"{name}={value}" for name, value in self.parts(register, word).items()]
        return f"{register + ':':<11} {word:08x} {' '.join(parts)}".rstrip()


def speed_threshold(speed_mm_s: float, step_mm: float, microsteps: int, clock_hz: float) -> int:
    """TSTEP (clocks per 1/256 step) at a speed; 0 mm/s: never reached (the largest)."""
    if speed_mm_s <= 0.0:
        return TSTEP_MAX
    fine_step_mm = step_mm * microsteps / MICROSTEPS_MAX
    return min(TSTEP_MAX, round(clock_hz * fine_step_mm / speed_mm_s))


def microstep_bits(microsteps: int) -> int:
    """MRES: 0 for 256, 8 for full steps. ValueError for what the chip can not do."""
    if microsteps < 1 or microsteps > MICROSTEPS_MAX or microsteps & (microsteps - 1):
        raise ValueError("the driver knows 1, 2, 4, ... 256 microsteps")
    return 8 - (microsteps.bit_length() - 1)


def adc_temp_c(raw: int) -> float:
    """Temperature of a TMC2240 from its converter (datasheet, ADC_TEMP)."""
    return round((raw - 2038) / 7.7, 2)
