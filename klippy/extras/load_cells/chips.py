"""The converters of load cells: options, settings and rates, from the data sheets named in src/load_cell_adcs.c."""

from __future__ import annotations

from typing import Any, Protocol

from configfile import ConfigWrapper

from .. import bus

RANGE = 1 << 23  # of all of them: 24 bits with sign
LOOKS_PER_SAMPLE = 8.0  # at the line that says that there is one
LOOK_MIN_S = 0.0001
NO_SAMPLE = -(1 << 31)


class Chip(Protocol):
    """A converter on a board."""

    family: str
    mcu: Any
    oid: int
    rate_hz: float

    def configure(self) -> None:
        """Its object on the board; called when the board's commands are known."""

    def queue(self) -> Any:
        """Of its commands."""

    def prepare(self) -> None:
        """Its registers, before the board begins to read. Raises the printer's command_error."""


def unpack(raw: bytes) -> float | None:
    """The counts of a sample."""
    counts = int.from_bytes(raw, "little", signed=True)
    return None if counts == NO_SAMPLE else float(counts)


def rest_s(chip: Chip) -> float:
    """Between two looks."""
    return max(LOOK_MIN_S, 1.0 / (LOOKS_PER_SAMPLE * chip.rate_hz))


def _pins_on_one_board(config: ConfigWrapper, *options: str) -> tuple[Any, list[str]]:
    """(board, pins) of pin options."""
    pins = config.get_printer().lookup_object("pins")
    found = [pins.lookup_pin(config.get(option)) for option in options]
    for option, params in zip(options, found, strict=True):
        if params["chip"] is not found[0]["chip"]:
            raise config.error(
                f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): all pins of a converter"
                " must be on one board."
            )
    return found[0]["chip"], [params["pin"] for params in found]


class Hx71x:
    """HX711 or HX717: two pins; the gain also chooses the input, the rate is wired."""

    family = "hx71x"

    def __init__(self, config: ConfigWrapper, gains: dict[str, int], rates: tuple[int, ...]) -> None:
        self.mcu, (self._dout, self._sclk) = _pins_on_one_board(config, "dout_pin", "sclk_pin")
        self._pulses = config.getchoice("gain", gains, "A-128")
        self.rate_hz = float(config.getchoice("sample_rate", {rate: rate for rate in rates}, max(rates)))
        self.oid = self.mcu.create_oid()
        self._queue = self.mcu.alloc_command_queue()

    def queue(self) -> Any:
        return self._queue

    def configure(self) -> None:
        """The pulses after the 24 bits choose gain and input."""
        self.mcu.add_config_cmd(
            f"config_hx71x oid={self.oid} gain_channel={self._pulses} dout_pin={self._dout} sclk_pin={self._sclk}"
        )

    def prepare(self) -> None:
        """It has no registers."""


class Ads1220:
    """Four registers on SPI, mode 1."""

    family = "ads1220"
    GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
    NORMAL = (20, 45, 90, 175, 330, 600, 1000)
    TURBO = (40, 90, 180, 350, 660, 1200, 2000)
    INPUTS = (
        "AIN0_AIN1", "AIN0_AIN2", "AIN0_AIN3", "AIN1_AIN2", "AIN1_AIN3", "AIN2_AIN3", "AIN1_AIN0", "AIN3_AIN2",
        "AIN0_AVSS", "AIN1_AVSS", "AIN2_AVSS", "AIN3_AVSS",
    )  # fmt: skip
    REFERENCES = ("internal", "REF0", "REF1", "analog_supply")
    RESET, START, READ, WRITE = 0x06, 0x08, 0x20, 0x40
    CONTINUOUS, TURBO_MODE = 0x04, 0x10

    def __init__(self, config: ConfigWrapper) -> None:
        rates = {rate: rate for rate in sorted({*self.NORMAL, *self.TURBO})}
        rate = config.getchoice("sample_rate", rates, 660)
        turbo = rate in self.TURBO and rate != 90
        gain = self.GAINS.index(config.getchoice("gain", {gain: gain for gain in self.GAINS}, 128))
        inputs = self.INPUTS.index(config.getchoice("input_mux", list(self.INPUTS), "AIN0_AIN1"))
        bypass = config.getboolean("pga_bypass", False) or inputs >= self.INPUTS.index("AIN0_AVSS")
        reference = self.REFERENCES.index(config.getchoice("vref", list(self.REFERENCES), "internal"))
        code = (self.TURBO if turbo else self.NORMAL).index(rate)
        self.rate_hz = float(rate)
        self._registers = bytes(
            (
                inputs << 4 | gain << 1 | bypass,
                code << 5 | turbo * self.TURBO_MODE | self.CONTINUOUS,
                reference << 6,
                0,
            )
        )
        self._spi = bus.MCU_SPI_from_config(config, 1, default_speed=512000 if turbo else 256000)
        self.mcu = self._spi.get_mcu()
        pins = config.get_printer().lookup_object("pins")
        self._ready = pins.lookup_pin(config.get("data_ready_pin"))["pin"]
        self.oid = self.mcu.create_oid()

    def queue(self) -> Any:
        return self._spi.get_command_queue()

    def configure(self) -> None:
        self.mcu.add_config_cmd(
            f"config_ads1220 oid={self.oid} spi_oid={self._spi.get_oid()} data_ready_pin={self._ready}"
        )

    def prepare(self) -> None:
        """Reset, write, read back, start."""
        self._spi.spi_send([self.RESET])
        self._spi.spi_send([self.WRITE | 3, *self._registers])
        found = bytes(self._spi.spi_transfer([self.READ | 3, 0, 0, 0, 0])["response"])[1:]
        if found != self._registers:
            raise self.mcu.get_printer().command_error(
                f"The ADS1220 has {found.hex()} in its registers instead of {self._registers.hex()}: check its power,"
                " its wires, cs_pin and the bus."
            )
        self._spi.spi_send([self.START])


class Ads131m0x:
    """ADS131M02 and M04: frames of 24-bit words on SPI, mode 1."""

    family = "ads131m0x"
    GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
    RATIOS = (128, 256, 512, 1024, 2048, 4096, 8192, 16384)
    TURBO_RATIO, TURBO_BIT = 64, 0x20
    WORD = 3
    MODE, CLOCK, GAIN, CFG = 0x02, 0x03, 0x04, 0x06
    MODE_VALUE = 0x0110  # as after a reset, its flag cleared
    HIGH_RESOLUTION = 0x02
    CHOP = 0x0100

    def __init__(self, config: ConfigWrapper, channels: int) -> None:
        self._channels = channels
        self._channel = config.getint("adc_channel", 0, minval=0, maxval=channels - 1)
        clock_hz = self._read_clock(config)
        gain = self.GAINS.index(config.getchoice("gain", {gain: gain for gain in self.GAINS}, 128))
        chop = config.getboolean("enable_global_chop", False)
        delays = {2 << code: code for code in range(16)}
        delay_code = config.getchoice("global_chop_delay", delays, 16)
        wanted_hz = config.getfloat("sample_rate", 500.0, above=0.0)
        rates = {
            ratio: clock_hz / 2.0 / (3 * ratio + (2 << delay_code) if chop else ratio)
            for ratio in (self.TURBO_RATIO, *self.RATIOS)
        }
        ratio = min(rates, key=lambda ratio: abs(rates[ratio] - wanted_hz))
        self.rate_hz = rates[ratio]
        oversampling = self.TURBO_BIT if ratio == self.TURBO_RATIO else self.RATIOS.index(ratio) << 2
        self._writes = (
            (self.MODE, self.MODE_VALUE),
            (self.CLOCK, 1 << 8 + self._channel | oversampling | self.HIGH_RESOLUTION),
            (self.GAIN, gain << 4 * self._channel),
            (self.CFG, delay_code << 9 | chop * self.CHOP),
        )
        self._spi = bus.MCU_SPI_from_config(config, 1, default_speed=4000000)
        self.mcu = self._spi.get_mcu()
        pins = config.get_printer().lookup_object("pins")
        self._ready = pins.lookup_pin(config.get("data_ready_pin"))["pin"]
        self.oid = self.mcu.create_oid()

    @staticmethod
    def _read_clock(config: ConfigWrapper) -> float:
        name = config.get("pwm_clock", None)
        if name is None:
            return config.getfloat("clock_freq", minval=300000.0, maxval=8400000.0)
        clock = config.get_printer().load_object(config, f"static_pwm_clock {name.split()[-1]}")
        return float(clock.frequency_hz)

    def queue(self) -> Any:
        return self._spi.get_command_queue()

    def configure(self) -> None:
        self.mcu.add_config_cmd(
            f"config_ads131m0x oid={self.oid} spi_oid={self._spi.get_oid()} channel={self._channel}"
            f" num_channels={self._channels} data_ready_pin={self._ready}"
        )

    def _frame(self, *words: int) -> bytes:
        """A frame with these words first; returns the words that come meanwhile."""
        content = b"".join(word.to_bytes(2, "big") + b"\0" for word in words)
        response: bytes = self._spi.spi_transfer(content.ljust(self.WORD * (self._channels + 2), b"\0"))[
            "response"
        ]
        return bytes(response)

    def prepare(self) -> None:
        """Write and read back each register."""
        for register, value in self._writes:
            self._frame(0x6000 | register << 7, value)
            self._frame(0xA000 | register << 7)
            found = int.from_bytes(self._frame(0)[:2], "big")
            if found != value:
                raise self.mcu.get_printer().command_error(
                    f"The ADS131M0{self._channels} has 0x{found:04x} in register {register} instead of 0x{value:04x}:"
                    " check its power, its clock, its wires, cs_pin and the bus."
                )


TYPES = {
    "hx711": lambda config: Hx71x(config, {"A-128": 1, "B-32": 2, "A-64": 3}, (80, 10)),
    "hx717": lambda config: Hx71x(config, {"A-128": 1, "B-64": 2, "A-64": 3, "B-8": 4}, (320, 80, 20, 10)),
    "ads1220": Ads1220,
    "ads131m02": lambda config: Ads131m0x(config, 2),
    "ads131m04": lambda config: Ads131m0x(config, 4),
}


def read_chip(config: ConfigWrapper) -> Chip:
    """The converter of option sensor_type."""
    chip: Chip = config.getchoice("sensor_type", TYPES)(config)
    return chip
