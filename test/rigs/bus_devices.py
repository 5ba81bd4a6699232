"""Chips on a bus of the board of bus_rig.py, written from their data sheets: frames in, what the chip makes of them.

`take(chip, device)` gives a device all that the board sends at start and what it is sent afterwards.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import pytest

import bus_rig
from bus_rig import Answer, Chip

EARLY = re.compile(r"(spi_send|i2c_transfer) oid=(\d+) (?:data|write)=([0-9a-f]*)")


class Device(Protocol):
    """What a frame does to it."""

    def frame(self, data: bytes) -> None: ...


def frames(chip: Chip, oid: int) -> list[bytes]:
    """What the device with this oid has been sent: at start, then in the run."""
    found = [
        bytes.fromhex(data) for _, number, data in EARLY.findall("\n".join(chip.init)) if int(number) == oid
    ]
    for name, values, _, _ in chip.sent:
        if name in ("spi_send", "i2c_transfer", "spi_transfer") and values[0] == oid:
            found.append(bytes(values[1]))
    return found


def take(chip: Chip, device: Any, oid: int = 0) -> Any:
    """The device after all that it has been sent."""
    for data in frames(chip, oid):
        device.frame(data)
    return device


def attach(monkeypatch: pytest.MonkeyPatch, answers: Mapping[str, Answer]) -> None:
    """The board has these answers to commands from the start on."""
    configure = bus_rig.Chip.configure

    def with_answers(board: Chip) -> None:
        board.answers.update(answers)
        configure(board)

    monkeypatch.setattr(bus_rig.Chip, "configure", with_answers)


def on_i2c(transfer: Callable[[bytes, int], bytes | None]) -> dict[str, Answer]:
    """Answers of a device on I2C: (written, bytes wanted) -> bytes, or None for no acknowledgement."""

    def answer(values: list[Any]) -> dict[str, Any]:
        data = transfer(bytes(values[1]), values[2])
        return {"i2c_bus_status": "START_NACK" if data is None else "SUCCESS", "response": data or b""}

    return {"i2c_transfer": answer}


class Ad5206:
    """Resistance from wiper to B, as share of the whole (256 positions), by channel address."""

    def __init__(self) -> None:
        self.shares: dict[int, float] = {}

    def frame(self, data: bytes) -> None:
        word = int.from_bytes(data, "big") & 0x7FF  # a shift register of 11 bits
        address = word >> 8
        assert address < 6, "addresses 6 and 7 are none"
        self.shares[address] = (word & 0xFF) / 256.0


class Dac084S085:
    """Outputs as share of the reference, by channel letter."""

    def __init__(self) -> None:
        self.shares: dict[str, float] = {}
        self.registers: dict[str, float] = {}

    def frame(self, data: bytes) -> None:
        assert len(data) == 2, "16 falling edges, or the frame is void"
        word = int.from_bytes(data, "big")
        letter, operation = "ABCD"[word >> 14], word >> 12 & 3
        self.registers[letter] = (word >> 4 & 0xFF) / 256.0
        if operation == 1:  # 0: the register only
            self.shares[letter] = self.registers[letter]


class Mcp4451:
    """Resistance from wiper to B as share of the whole (256 steps), by wiper number."""

    def __init__(self) -> None:
        self.shares: dict[int, float] = {}

    def frame(self, data: bytes) -> None:
        first, low = data
        assert first >> 2 & 3 == 0, "not a write"
        code = (first & 3) << 8 | low
        assert code <= 0x100, "beyond terminal A"
        self.shares[{0: 0, 1: 1, 6: 2, 7: 3}[first >> 4]] = code / 256.0


class Mcp4018:
    """Resistance from wiper to B as share of the whole, 127 steps."""

    share = 0.5  # after power-on

    def frame(self, data: bytes) -> None:
        (code,) = data
        assert code < 128
        self.share = code / 127.0


class Mcp4728:
    """Volts out by channel number, and whether its EEPROM was written."""

    SUPPLY_V = 5.0

    def __init__(self) -> None:
        self.volts: dict[int, float] = {}
        self.is_eeprom_written = False

    def frame(self, data: bytes) -> None:
        assert data[0] >> 5 == 0b010, "a command that writes"
        self.is_eeprom_written |= data[0] >> 3 & 3 != 0
        word = int.from_bytes(data[1:], "big")
        full_v = 2.048 * (1 + (word >> 12 & 1)) if word >> 15 else self.SUPPLY_V
        assert word >> 13 & 3 == 0, "powered down"
        if not data[0] & 1:  # UDAC
            self.volts[data[0] >> 1 & 3] = full_v * (word & 0xFFF) / 4096.0


class Ads1115:
    """Codes of the voltages at its inputs. A conversion takes 1/128 s, or 10 % more."""

    RANGES_V = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
    PAIRS = ((0, 1), (0, 3), (1, 3), (2, 3), (0, None), (1, None), (2, None), (3, None))

    def __init__(
        self, volts: list[float], bits: int = 16, rates_hz: tuple[float, ...] = (8, 16, 32, 64, 128)
    ) -> None:
        self.volts, self.bits, self.rates_hz = volts, bits, rates_hz
        self.now: Callable[[], float] = lambda: 0.0
        self.configuration = 0x8583
        self.done_s = 0.0
        self.is_there = True
        self._pointer = 0

    def transfer(self, written: bytes, count: int) -> bytes | None:
        if not self.is_there:
            return None
        if written:
            self._pointer = written[0]
        if len(written) == 3:
            assert self._pointer == 1
            self.configuration = int.from_bytes(written[1:], "big")
            if self.configuration >> 15:
                assert self.configuration & 0x100, "started by hand: single shots"
                self.done_s = self.now() + 1.1 / self.rates_hz[self.configuration >> 5 & 7]
        if not count:
            return b""
        if self._pointer == 1:
            word = self.configuration & 0x7FFF | (0x8000 if self.now() >= self.done_s else 0)
            return word.to_bytes(2, "big")
        plus, minus = self.PAIRS[self.configuration >> 12 & 7]
        volt = self.volts[plus] - (0.0 if minus is None else self.volts[minus])
        share = volt / self.RANGES_V[self.configuration >> 9 & 7]
        top = 1 << self.bits - 1
        code = max(-top, min(top - 1, round(share * top))) << 16 - self.bits
        return code.to_bytes(2, "big", signed=True)


class Apa102:
    """A chain: each LED takes the next 32 bits after the start, and passes on the rest."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.stream = b""

    def frame(self, data: bytes) -> None:
        self.stream += data

    def colors(self) -> list[tuple[int, int, int]]:
        """(red, green, blue) of each LED after the last start."""
        content = self.stream[self.stream.rindex(bytes(4)) + 4 :]
        leds, tail = content[: 4 * self.count], content[4 * self.count :]
        assert 8 * len(tail) >= self.count / 2, "too few clocks for the last LED"
        found = []
        for i in range(0, len(leds), 4):
            first, blue, green, red = leds[i : i + 4]
            assert first == 0xFF, "three ones and the full brightness"
            found.append((red, green, blue))
        return found


class Registers:
    """A chip whose first byte is a register's number and whether the next bytes go to the next ones."""

    def __init__(self, increment: int, mask: int) -> None:
        self.increment, self.mask = increment, mask
        self.registers: dict[int, int] = {}

    def frame(self, data: bytes) -> None:
        number = data[0] & self.mask
        assert len(data) == 2 or data[0] & self.increment
        for value in data[1:]:
            self.registers[number] = value
            number += 1


class Pca9533(Registers):
    """Duty cycles of LED0 to LED3."""

    def __init__(self) -> None:
        super().__init__(0x10, 0x07)

    def duties(self) -> list[float]:
        blinks = [0.0, 1.0, self.registers[2] / 256.0, self.registers[4] / 256.0]
        assert self.registers[1] == self.registers[3] == 0, "152 Hz, or it can be seen"
        return [blinks[self.registers[5] >> 2 * led & 3] for led in range(4)]


class Pca9632(Registers):
    """Duty cycles of the transistors at LED0 to LED3."""

    def __init__(self) -> None:
        super().__init__(0x80, 0x0F)

    def duties(self) -> list[float]:
        assert not self.registers[0] & 0x10, "asleep"
        mode2 = self.registers[1]
        assert mode2 & 0x14 == 0x14, "inverted, totem pole"
        states = [self.registers[8] >> 2 * led & 3 for led in range(4)]
        return [(0.0, 1.0, self.registers[2 + led] / 256.0, 0.0)[state] for led, state in enumerate(states)]


class Sx1509:
    """Mean levels of its outputs; data sheet SX1509B, registers and LED driver in static mode."""

    INTENSITY = (42, 45, 48, 51, 54, 59, 64, 69, 74, 77, 80, 83, 86, 91, 96, 101)

    def __init__(self) -> None:
        self.keys: list[int] = []
        self._reset()

    def _reset(self) -> None:
        self.registers = {0x0E: 0xFF, 0x0F: 0xFF, 0x10: 0xFF, 0x11: 0xFF}

    def frame(self, data: bytes) -> None:
        if data[0] == 0x7D:
            self.keys = [*self.keys, data[1]][-2:]
            if self.keys == [0x12, 0x34]:
                self._reset()
        for offset, value in enumerate(data[1:]):
            self.registers[data[0] + offset] = value

    def _bit(self, bank_b: int, pin: int) -> int:
        return self.registers.get(bank_b + (pin < 8), 0) >> pin % 8 & 1

    def levels(self) -> dict[int, float]:
        """Of the pins that drive."""
        return {pin: self._level(pin) for pin in range(16) if not self._bit(0x0E, pin)}

    def _level(self, pin: int) -> float:
        if not self._bit(0x20, pin):
            return float(self._bit(0x10, pin))
        assert self.registers[0x1E] >> 5 & 3 == 2, "the oscillator of the LED drivers"
        assert self.registers[0x1F] >> 4 & 7, "the clock of the LED drivers"
        return 1.0 if self._bit(0x10, pin) else 1.0 - self.registers.get(self.INTENSITY[pin], 0xFF) / 255.0


class SmartEffectorLine:
    """Bytes on the programming line: 1000 bits a second; (time, level) of each change."""

    BIT_S = 0.001

    def __init__(self, changes: list[tuple[float, float]]) -> None:
        self.changes = changes

    def level(self, time_s: float) -> int:
        return int(([0.0] + [value for at, value in self.changes if at <= time_s])[-1])

    def received(self, count: int) -> list[int]:
        start = self.changes[0][0] - 2 * self.BIT_S  # the first change is the one of 0 0 1 0
        found = []
        for byte in range(count):
            bits = [self.level(start + (14 * byte + n + 0.5) * self.BIT_S) for n in range(14)]
            assert bits[:4] == [0, 0, 1, 0] and bits[8] == 1 - bits[7] and bits[13] == 1 - bits[12], bits
            found.append(int("".join(map(str, bits[4:8] + bits[9:13])), 2))
        assert self.level(start + (14 * count + 0.5) * self.BIT_S) == 0
        return found
