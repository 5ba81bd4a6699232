"""[multi_pin NAME]: several output pins as one, used as `multi_pin:NAME`."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

CHIP = "multi_pin"


class MultiOutput:
    """What a digital_out or pwm pin offers, done to every pin of the group."""

    def __init__(self, outputs: list[Any]) -> None:
        self._outputs = outputs

    def get_mcu(self) -> Any:
        """The MCU of the first pin: the group's clock."""
        return self._outputs[0].get_mcu()

    def setup_max_duration(self, max_duration: float) -> None:
        for output in self._outputs:
            output.setup_max_duration(max_duration)

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        for output in self._outputs:
            output.setup_start_value(start_value, shutdown_value)

    def setup_cycle_time(self, cycle_time: float, hardware_pwm: bool = False) -> None:
        for output in self._outputs:
            output.setup_cycle_time(cycle_time, hardware_pwm)

    def set_digital(self, print_time: float, value: int) -> None:
        for output in self._outputs:
            output.set_digital(print_time, value)

    def set_pwm(self, print_time: float, value: float) -> None:
        for output in self._outputs:
            output.set_pwm(print_time, value)


class MultiPinChip:
    """The chip `multi_pin`, with a pin for each section."""

    def __init__(self, pins: Any) -> None:
        self._pins = pins
        self._members: dict[str, tuple[str, ...]] = {}

    def add(self, name: str, members: tuple[str, ...]) -> None:
        self._members[name] = members

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> MultiOutput:
        """Called by pins.PrinterPins for `multi_pin:NAME`."""
        name = pin_params["pin"]
        members = self._members.get(name)
        if members is None:
            raise self._pins.error(
                f"multi_pin:{name} needs a section [multi_pin {name}] above the one that uses it."
            )
        if pin_type not in ("digital_out", "pwm"):
            raise self._pins.error(f"multi_pin:{name} can only be an output, not a pin of type {pin_type}.")
        invert = "!" if pin_params["invert"] else ""
        return MultiOutput([self._pins.setup_pin(pin_type, _flip(member, invert)) for member in members])


def _flip(member: str, invert: str) -> str:
    """A member's description, turned round once more if the group is."""
    member = member.strip()
    if not invert:
        return member
    return member[1:].strip() if member.startswith("!") else f"!{member}"


class PrinterMultiPin:
    """The object `multi_pin NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        pins = config.get_printer().lookup_object("pins")
        chip = pins.chips.get(CHIP)
        if chip is None:
            chip = MultiPinChip(pins)
            pins.register_chip(CHIP, chip)
        members = config.getlist("pins")
        if not members:
            raise config.error(f"Option 'pins' in section '{config.get_name()}' names no pin.")
        chip.add(config.get_name().split()[1], members)


def load_config_prefix(config: ConfigWrapper) -> PrinterMultiPin:
    """Section [multi_pin NAME]."""
    return PrinterMultiPin(config)
