"""Registers of stepper drivers over their single-wire UART (TMC2208, TMC2209, TMC2240).

A datagram (datasheet of the TMC2209, rev. 1.09, chapter 4; bytes from the lowest bit on, each with start and stop bit):

    write:  0x05  address  register | 0x80  data (4 bytes, highest first)  CRC
    read:   0x05  address  register         CRC      answer: 0x05  0xff  register  data (4 bytes)  CRC

A driver answers no write, but counts those it has understood (IFCNT). Up to four drivers (TMC2240: eight) share a wire.
A multiplexer may lead the wire to more of them: its select pins are set before a datagram.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper

from .. import bus

SYNC, MASTER_ADDRESS, WRITE_FLAG = 0x05, 0xFF, 0x80
IFCNT = 0x02
BAUD = 40000
# A slow microcontroller makes every bit in software: below this clock it gets more time for each.
SLOW_CLOCK_HZ = 20_000_000
SLOW_BAUD = 9000
ANSWER_BYTES = 8
TRIES = 5


def crc8(data: Sequence[int]) -> int:
    """CRC8-ATM (polynomial 0x07), each byte from its lowest bit on."""
    crc = 0
    for byte in data:
        for bit in range(8):
            top = crc >> 7 ^ byte >> bit & 1
            crc = (crc << 1 & 0xFF) ^ (0x07 if top else 0)
    return crc


def to_bits(data: Sequence[int]) -> bytes:
    """The line's bits, with start (0) and stop (1), packed from the lowest bit on."""
    line = 0
    for number, byte in enumerate(data):
        line |= (byte << 1 | 1 << 9) << (10 * number)
    return line.to_bytes((10 * len(data) + 7) // 8, "little")


def from_bits(packed: bytes, count: int) -> bytes | None:
    """`count` bytes out of the line's bits; None if a start or stop bit is wrong."""
    if len(packed) * 8 < 10 * count:
        return None
    line = int.from_bytes(packed, "little")
    frames = [line >> 10 * number & 0x3FF for number in range(count)]
    if any(frame & 1 or not frame >> 9 for frame in frames):
        return None
    return bytes(frame >> 1 & 0xFF for frame in frames)


def write_datagram(address: int, register: int, value: int) -> bytes:
    body = bytes([SYNC, address, register | WRITE_FLAG]) + value.to_bytes(4, "big")
    return body + bytes([crc8(body)])


def read_datagram(address: int, register: int) -> bytes:
    body = bytes([SYNC, address, register])
    return body + bytes([crc8(body)])


def parse_answer(packed: bytes, register: int) -> int | None:
    """The register's value, or None if the answer is damaged or missing."""
    answer = from_bits(packed, ANSWER_BYTES)
    if answer is None or answer[:3] != bytes([SYNC, MASTER_ADDRESS, register]):
        return None
    return int.from_bytes(answer[3:7], "big") if answer[7] == crc8(answer[:7]) else None


class Wire:
    """One UART of a micro-controller; its drivers take turns."""

    def __init__(self, rx_params: dict[str, Any], tx_params: dict[str, Any]) -> None:
        self.mcu = rx_params["chip"]
        self.mutex = self.mcu.get_printer().get_reactor().mutex()
        self.addresses: dict[tuple[tuple[int, ...], int], str] = {}
        self._cmd_queue = self.mcu.alloc_command_queue()
        self._select_names: tuple[str, ...] | None = None
        self._select_pins: list[bus.MCU_bus_digital_out] = []
        self._selected: tuple[int, ...] = ()
        self._rx, self._tx, self._pullup = rx_params["pin"], tx_params["pin"], rx_params["pullup"]
        self._oid = self.mcu.create_oid()
        self._transfer: Any = None
        self.mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self._oid
        baud = SLOW_BAUD if mcu.seconds_to_clock(1.0) < SLOW_CLOCK_HZ else BAUD
        mcu.add_config_cmd(
            f"config_tmcuart oid={oid} rx_pin={self._rx} pull_up={self._pullup} tx_pin={self._tx} "
            f"bit_time={mcu.seconds_to_clock(1.0 / baud)}"
        )
        self._transfer = mcu.lookup_query_command(
            "tmcuart_send oid=%c write=%*s read=%c",
            "tmcuart_response oid=%c read=%*s",
            oid=oid,
            cq=self._cmd_queue,
        )

    def read_selection(self, config: ConfigWrapper) -> tuple[int, ...]:
        """Levels of option select_pins for one driver. All drivers of the wire have the same pins there."""
        pins = config.get_printer().lookup_object("pins")
        params = [pins.parse_pin(text, can_invert=True) for text in config.getlist("select_pins", ())]
        names = tuple(f"{p['chip_name']}:{p['pin']}" for p in params)
        if self._select_names is None:
            self._select_names = names
            self._select_pins = [bus.MCU_bus_digital_out(self.mcu, name, self._cmd_queue) for name in names]
            self._selected = (-1,) * len(names)  # not known: the board may have kept its levels
        if names != self._select_names:
            raise config.error(
                f"Option 'select_pins' in section '{config.get_name()}': drivers with the same uart_pin need the same"
                " pins in the same order, each with or without '!'. The first of them has"
                f" {', '.join(self._select_names) or 'none'} ({config.where('select_pins')})."
            )
        return tuple(1 - p["invert"] for p in params)

    def select(self, selection: tuple[int, ...]) -> None:
        """Lead the wire to the drivers of these levels."""
        for pin, level, before in zip(self._select_pins, selection, self._selected, strict=True):
            if level != before:
                pin.update_digital_out(level)
        self._selected = selection

    def transfer(self, datagram: bytes, answer_bytes: int) -> bytes:
        """Send; returns the bits of the answer."""
        params = self._transfer.send([self._oid, to_bits(datagram), (10 * answer_bytes + 7) // 8])
        return bytes(params["read"])


def lookup_wire(config: ConfigWrapper) -> Wire:
    """The UART of options uart_pin and tx_pin (default: the same)."""
    pins = config.get_printer().lookup_object("pins")
    rx_params = pins.lookup_pin(config.get("uart_pin"), can_pullup=True, share_type="tmc_uart_rx")
    tx_pin = config.get("tx_pin", None)
    tx_params = rx_params
    if tx_pin is not None:
        tx_params = pins.lookup_pin(tx_pin, share_type="tmc_uart_tx")
    if tx_params["chip"] is not rx_params["chip"]:
        raise config.error(f"Section '{config.get_name()}': uart_pin and tx_pin must be on the same board")
    wire: Wire | None = rx_params.get("class")
    if wire is None:
        wire = rx_params["class"] = Wire(rx_params, tx_params)
    return wire


class RegisterLink:
    """Registers of one driver on a wire."""

    def __init__(self, config: ConfigWrapper, addresses: int = 4) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split(None, 1)[-1]
        self.wire = lookup_wire(config)
        self.mcu = self.wire.mcu
        self.address = config.getint("uart_address", 0, minval=0, maxval=addresses - 1)
        self.selection = self.wire.read_selection(config)
        other = self.wire.addresses.setdefault((self.selection, self.address), self.name)
        if other != self.name:
            raise config.error(
                f"Section '{config.get_name()}': the driver of '{other}' has the same uart_pin and uart_address "
                f"{self.address}"
            )

    def _is_batch(self) -> bool:
        return bool(self.wire.mcu.is_fileoutput())

    def read(self, register: int) -> int:
        """Value of a register; command_error if the driver does not answer."""
        with self.wire.mutex:
            self.wire.select(self.selection)
            return self._read(register)

    def _read(self, register: int) -> int:
        for _ in range(TRIES):
            packed = self.wire.transfer(read_datagram(self.address, register), ANSWER_BYTES)
            if self._is_batch():
                return 0
            value = parse_answer(packed, register)
            if value is not None:
                return value
        raise self._silent()

    def write(self, register: int, value: int) -> None:
        """Set a register, and make sure that the driver has understood."""
        with self.wire.mutex:
            self.wire.select(self.selection)
            for _ in range(TRIES):
                before = self._read(IFCNT)
                self.wire.transfer(write_datagram(self.address, register, value), 0)
                if self._is_batch() or self._read(IFCNT) != before:
                    return
        raise self._silent()

    def _silent(self) -> Exception:
        error: Exception = self.printer.command_error(
            f"The driver of '{self.name}' does not answer on its UART. Check uart_pin and uart_address, the wiring, "
            "and that the driver has motor power."
        )
        return error
