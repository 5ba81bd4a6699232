"""[sx1509 NAME]: sixteen outputs sx1509_NAME:PIN_0 ... PIN_15 of an SX1509 on I2C, digital or PWM.

Data sheet of the SX1509B: the registers of pins 8 to 15 (bank B) stand before those of 0 to 7 (bank A). A PWM pin has
its LED driver on: with its data bit at 0 it is low for the share IOn / 255 of each cycle.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper

from . import bus

INPUT_DISABLE, DIRECTION, DATA, CLOCK, MISC, LED_DRIVER, RESET = 0x00, 0x0E, 0x10, 0x1E, 0x1F, 0x20, 0x7D
RESET_KEYS = (0x12, 0x34)
INTERNAL_2MHZ = 0x40  # of RegClock
LED_CLOCK_2MHZ = 0x10  # of RegMisc: the LED drivers' clock is that of the oscillator; linear in both banks
INTENSITY = (
    0x2A, 0x2D, 0x30, 0x33, 0x36, 0x3B, 0x40, 0x45, 0x4A, 0x4D, 0x50, 0x53, 0x56, 0x5B, 0x60, 0x65,
)  # RegIOn0 ... RegIOn15  # fmt: skip
FULL = 255
PINS = 16
ADDRESSES = (62, 63, 112, 113)


class Sx1509:
    """The chip."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = "_".join(config.get_name().split())
        config.getchoice("i2c_address", {address: address for address in ADDRESSES})
        self.i2c = bus.MCU_I2C_from_config(config)
        self.mcu = self.i2c.get_mcu()
        self._outputs: dict[int, Sx1509Pin] = {}
        self._data = 0  # of the digital outputs
        self._mutex = self.printer.get_reactor().mutex()
        pins = self.printer.lookup_object("pins")
        pins.register_chip(self.name, self)
        self._error = pins.error
        self.mcu.register_config_callback(self._build_config)

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Sx1509Pin:
        """Called by pins for sx1509_NAME:PIN_n."""
        name = pin_params["pin"]
        if pin_type not in ("digital_out", "pwm"):
            raise self._error(f"{self.name}:{name} is an output only.")
        number = name.removeprefix("PIN_")
        if not name.startswith("PIN_") or not number.isdigit() or int(number) >= PINS:
            raise self._error(f"{self.name} has no pin {name}. Its pins are PIN_0 to PIN_{PINS - 1}.")
        pin = Sx1509Pin(self, int(number), pin_type == "pwm", bool(pin_params["invert"]))
        self._outputs[pin.number] = pin
        return pin

    def _unused(self) -> int:
        return 0xFFFF & ~sum(1 << number for number in self._outputs)

    def _build_config(self) -> None:
        """At each start: outputs have their start values before they drive."""
        outputs = self._outputs.values()
        driven = sum(1 << pin.number for pin in outputs if pin.is_pwm)
        self._data = sum(1 << pin.number for pin in outputs if not pin.is_pwm and pin.start_value)
        writes = [bytes([RESET, key]) for key in RESET_KEYS]
        writes += [bytes([CLOCK, INTERNAL_2MHZ]), bytes([MISC, LED_CLOCK_2MHZ])]
        writes += [_intensity(pin.number, pin.start_value) for pin in outputs if pin.is_pwm]
        writes += [
            _word(INPUT_DISABLE, 0xFFFF & ~self._unused()),
            _word(LED_DRIVER, driven),
            _word(DATA, self._data | self._unused()),
            _word(DIRECTION, self._unused()),
        ]
        for data in writes:
            self.mcu.add_config_cmd(
                f"i2c_transfer oid={self.i2c.get_oid()} write={data.hex()} read_len=0", is_init=True
            )

    def set_bit(self, number: int, value: int, clock: int) -> None:
        """A digital output, at a clock of the board."""

        def data() -> bytes:
            self._data = self._data & ~(1 << number) | value << number
            return _word(DATA, self._data | self._unused())

        self._send(data, clock)

    def set_intensity(self, number: int, value: float, clock: int) -> None:
        """A PWM output's high share, at a clock of the board."""
        self._send(lambda: _intensity(number, value), clock)

    def _send(self, data: Callable[[], bytes], clock: int) -> None:
        """In the order of the requests; each waits for its clock and the chip's answer."""

        def transmit(eventtime: float) -> None:
            with self._mutex:
                if self.printer.is_shutdown():
                    return
                try:
                    self.i2c.i2c_write(data(), clock, clock)
                except self.printer.command_error as e:
                    logging.warning("%s: an output could not be set: %s", self.name, e)

        self.printer.get_reactor().register_callback(transmit)


def _word(register: int, word: int) -> bytes:
    """The registers of banks B and A."""
    return bytes([register, word >> 8, word & 0xFF])


def _intensity(number: int, high_share: float) -> bytes:
    return bytes([INTENSITY[number], FULL - round(high_share * FULL)])


class Sx1509Pin:
    """An output, as output_pin and fans use one. The board cannot switch it off when the host is dead."""

    def __init__(self, chip: Sx1509, number: int, is_pwm: bool, invert: bool) -> None:
        self._chip, self.number, self.is_pwm, self._invert = chip, number, is_pwm, invert
        self._label = f"{chip.name}:PIN_{number}"
        self.start_value = float(invert)

    def get_mcu(self) -> Any:
        return self._chip.mcu

    def setup_max_duration(self, max_duration: float) -> None:
        """A limit cannot be kept."""
        if max_duration:
            raise self._chip.printer.config_error(
                f"Pin {self._label} cannot be switched off by the board when the host is silent: nothing that heats or"
                " has a maximum duration can be on it."
            )

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        """The value at start. In a shutdown the pin stays as it is: the board cannot reach it then."""
        self.start_value = self._level(start_value)

    def setup_cycle_time(self, cycle_time: float, hardware_pwm: bool = False) -> None:
        """The chip's own cycle is 0.13 ms."""
        if not hardware_pwm:
            raise self._chip.printer.config_error(
                f"Pin {self._label} makes hardware PWM only: set hardware_pwm: True."
            )

    def _level(self, value: float) -> float:
        value = max(0.0, min(1.0, value))
        return 1.0 - value if self._invert else value

    def set_digital(self, print_time: float, value: int) -> None:
        clock = self._chip.mcu.print_time_to_clock(print_time)
        self._chip.set_bit(self.number, int(self._level(float(bool(value)))), clock)

    def set_pwm(self, print_time: float, value: float) -> None:
        clock = self._chip.mcu.print_time_to_clock(print_time)
        self._chip.set_intensity(self.number, self._level(value), clock)


def load_config_prefix(config: ConfigWrapper) -> Sx1509:
    return Sx1509(config)
