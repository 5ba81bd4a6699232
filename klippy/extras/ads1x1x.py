"""[ads1x1x NAME]: analog pins NAME:AIN0 ... of an ADS1013, 1014, 1015, 1113, 1114 or 1115 on I2C.

Data sheets of ADS101x and ADS111x: register 1 is the configuration, written with bit 15 it starts one conversion and
reads 1 there when that has ended; register 0 is the result, signed, of full scale +-pga.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from configfile import ConfigWrapper

from . import bus
from .adcs.host_pin import HostAdcPin

RESULT, CONFIGURATION = 0, 1
START, SINGLE_SHOT, NO_COMPARATOR = 0x8000, 0x0100, 0x0003
MUX = {
    "DIFF01": 0, "DIFF03": 1, "DIFF13": 2, "DIFF23": 3, "AIN0": 4, "AIN1": 5, "AIN2": 6, "AIN3": 7,
}  # fmt: skip
PGA = {f"{volt:.3f}V": volt for volt in (6.144, 4.096, 2.048, 1.024, 0.512, 0.256)}
ADDRESSES = {"GND": 0x48, "VCC": 0x49, "SDA": 0x4A, "SCL": 0x4B}
FULL_SCALE = 32768
TRIES = 3
MARGIN = 1.2  # the rate of conversions may be 10 % lower


@dataclass(frozen=True, slots=True)
class Kind:
    """What differs between the chips."""

    rate_bits: int
    rate_hz: float
    has_gain: bool = True  # else 2.048 V
    pins: Mapping[str, int] = field(default_factory=lambda: MUX)


_ONE_PAIR = {"DIFF01": 0}
KINDS = {
    "ADS1013": Kind(4 << 5, 1600.0, False, _ONE_PAIR), "ADS1014": Kind(4 << 5, 1600.0, pins=_ONE_PAIR),
    "ADS1015": Kind(4 << 5, 1600.0), "ADS1113": Kind(4 << 5, 128.0, False, _ONE_PAIR),
    "ADS1114": Kind(4 << 5, 128.0, pins=_ONE_PAIR), "ADS1115": Kind(4 << 5, 128.0),
}  # fmt: skip


class AdsPin(HostAdcPin):
    """One input, or the difference of two."""

    mux = 0

    def get_full_scale(self) -> float:
        return FULL_SCALE


class AdsChip:
    """The chip NAME. Its pins take turns."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name().split()[-1]
        self.kind = config.getchoice("chip", KINDS)
        self._gain = config.getchoice(
            "pga",
            PGA if self.kind.has_gain else {"2.048V": 2.048},
            "4.096V" if self.kind.has_gain else "2.048V",
        )
        self._per_code = self._gain / FULL_SCALE / config.getfloat("adc_voltage", 3.3, above=0.0)
        address = config.getchoice("address_pin", ADDRESSES, "GND")
        self.i2c = bus.MCU_I2C_from_config(config, address)
        self._inputs: list[AdsPin] = []
        self._turn = 0
        self._failures = 0
        self._pins = self.printer.lookup_object("pins")
        self._pins.register_chip(self.name, self)
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> AdsPin:
        """Called by pins for NAME:PIN."""
        name = pin_params["pin"]
        if pin_type != "adc":
            raise self._pins.error(f"{self.name}:{name} is an analog input only.")
        if name not in self.kind.pins:
            raise self._pins.error(
                f"{self.name} has no pin {name}. Its pins are {', '.join(self.kind.pins)}."
            )
        pin = AdsPin(self.printer, f"{self.name}:{name}", self.i2c.get_mcu())
        pin.mux = self.kind.pins[name]
        self._inputs.append(pin)
        return pin

    def _handle_connect(self) -> None:
        if self._inputs and self.printer.get_start_args().get("debugoutput") is None:
            self.reactor.register_timer(self._sample, self.reactor.NOW)

    def _convert(self, mux: int) -> int:
        """Raises the printer's command_error if the chip does not answer."""
        gain_bits = list(PGA.values()).index(self._gain) << 9
        word = START | mux << 12 | gain_bits | SINGLE_SHOT | self.kind.rate_bits | NO_COMPARATOR
        self.i2c.i2c_write([CONFIGURATION, *word.to_bytes(2, "big")])
        self.reactor.pause(self.reactor.monotonic() + MARGIN / self.kind.rate_hz)
        state = bytes(self.i2c.i2c_read([CONFIGURATION], 2)["response"])
        if not state[0] & START >> 8:
            raise self.printer.command_error("its conversion does not end")
        return int.from_bytes(self.i2c.i2c_read([RESULT], 2)["response"], "big", signed=True)

    def _sample(self, eventtime: float) -> float:
        """Timer: one pin after another, so that each has its report time."""
        if self.printer.is_shutdown():
            return float(self.reactor.NEVER)
        pin = self._inputs[self._turn]
        self._turn = (self._turn + 1) % len(self._inputs)
        try:
            code = self._convert(pin.mux)
            self._failures = 0
        except self.printer.command_error as e:
            self._failures += 1
            if self._failures >= TRIES:
                self.printer.invoke_shutdown(f"Section 'ads1x1x {self.name}': {e}")
        else:
            read_time = self.i2c.get_mcu().estimated_print_time(self.reactor.monotonic())
            pin.take(read_time, min(1.0, max(0.0, code * self._per_code)))
        return eventtime + min(p.report_time_s or 1.0 for p in self._inputs) / len(self._inputs)


def load_config_prefix(config: ConfigWrapper) -> AdsChip:
    return AdsChip(config)
