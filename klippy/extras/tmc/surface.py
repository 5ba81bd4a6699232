"""A driver's registers and currents under the names that plugins use.

`printer.lookup_object("tmc2209 stepper_x")` has `fields`, `mcu_tmc` and `current_helper`; this module has
`TMCtstepHelper`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stepper import parse_step_distance

from .registers import MICROSTEPS_MAX, Fields, speed_threshold


class FieldView:
    """`fields`: values of register fields as they were last set."""

    def __init__(self, values: Fields) -> None:
        self._values = values

    @property
    def registers(self) -> dict[str, int]:
        """What was last written into each register."""
        return self._values.words

    @property
    def all_fields(self) -> dict[str, dict[str, int]]:
        """The fields of each register and the bits they take."""
        masks: dict[str, dict[str, int]] = {}
        for name, field in self._values.fields.items():
            masks.setdefault(field.register, {})[name] = field.insert(0, -1)
        return masks

    def lookup_register(self, field_name: str, default: Any = None) -> Any:
        """Name of the register that has the field."""
        field = self._values.fields.get(field_name)
        return default if field is None else field.register

    def get_field(self, field_name: str, reg_value: int | None = None, reg_name: str | None = None) -> int:
        """The field's value, or its part of a register's value."""
        if reg_value is None:
            return self._values.get(field_name)
        return self._values.fields[field_name].extract(reg_value)

    def set_field(
        self, field_name: str, field_value: int, reg_value: int | None = None, reg_name: str | None = None
    ) -> int:
        """The register's value with the field set; kept for later, unless a value is given."""
        field = self._values.fields[field_name]
        bits = int(field_value) & (1 << field.width) - 1  # negative numbers are their two's complement
        if reg_value is not None:
            return field.insert(reg_value, bits)
        return self._values.words[self._values.set(field_name, bits)]


class RegisterView:
    """`mcu_tmc`: the registers in the chip."""

    def __init__(
        self, fields: FieldView, clock_hz: float, read: Callable[[str], int], write: Callable[[str], None]
    ) -> None:
        self._fields, self._clock_hz, self._read, self._write = fields, clock_hz, read, write

    def get_fields(self) -> FieldView:
        return self._fields

    def get_register(self, reg_name: str) -> int:
        """Read from the chip."""
        return self._read(reg_name)

    def set_register(self, reg_name: str, val: int, print_time: float | None = None) -> None:
        """Write into the chip, now: a driver's registers do not act at a time."""
        self._fields._values.words[reg_name] = val
        self._write(reg_name)

    def get_tmc_frequency(self) -> float:
        """Hz of the driver's clock."""
        return self._clock_hz


class CurrentView:
    """`current_helper`: A."""

    def __init__(self, driver: Any) -> None:
        self._driver = driver

    def get_current(self) -> tuple[float, float, float, float]:
        """Running, holding, requested for holding, largest."""
        driver = self._driver
        return driver.run_current, driver.hold_current, driver.hold_current, driver.current.largest_a

    def set_current(self, run_current: float, hold_current: float, print_time: float | None = None) -> None:
        self._driver.set_currents(run_current, hold_current)


def TMCtstepHelper(mcu_tmc: RegisterView, velocity: float, pstepper: Any = None, pconfig: Any = None) -> int:
    """TSTEP at a speed, mm/s. Without `pstepper` the motor is that of the section `pconfig`."""
    if pstepper is not None:
        step_mm = pstepper.get_step_dist()
    else:
        rotation_mm, steps = parse_step_distance(pconfig)
        step_mm = rotation_mm / steps
    microsteps = MICROSTEPS_MAX >> mcu_tmc.get_fields().get_field("mres")
    return speed_threshold(velocity, step_mm, microsteps, mcu_tmc.get_tmc_frequency())
