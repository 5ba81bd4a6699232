"""Registers of stepper drivers over SPI (TMC2130, TMC5160, TMC2240), alone or in a daisy chain.

A datagram has 40 bits: address (| 0x80 to write), then four bytes, highest first. The answer comes with the next
datagram: status, then the value of the register asked for, or what was written. In a chain all drivers are spoken to
at once; the first datagram sent ends up in the driver farthest from MOSI, and its answer comes first.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from .. import bus

MODE, SPEED_HZ = 3, 4_000_000
WRITE_FLAG = 0x80
DATAGRAM_BYTES = 5
REST = bytes(DATAGRAM_BYTES)  # for the others of a chain: read register 0
TRIES = 5
BUS_OPTIONS = ("spi_speed", "spi_bus", *(f"spi_software_{line}_pin" for line in ("sclk", "mosi", "miso")))


class Chain:
    """Drivers behind one chip select."""

    def __init__(self, config: ConfigWrapper, length: int, share_type: str | None) -> None:
        self.spi = bus.MCU_SPI_from_config(config, MODE, default_speed=SPEED_HZ, share_type=share_type)
        self.mcu = self.spi.get_mcu()
        self.mutex = self.mcu.get_printer().get_reactor().mutex()
        self.length = length
        self.taken: dict[int, str] = {}

    def _line(self, position: int, datagram: bytes) -> bytes:
        before = self.length - position
        return REST * before + datagram + REST * (position - 1)

    def exchange(self, position: int, datagram: bytes, following: bytes) -> bytes:
        """Send two datagrams to the driver at `position` (1: next to MOSI); the answer to the first."""
        params = self.spi.spi_transfer_with_preface(
            self._line(position, datagram), self._line(position, following)
        )
        start = (self.length - position) * DATAGRAM_BYTES
        return bytes(params["response"])[start : start + DATAGRAM_BYTES]


def lookup_chain(config: ConfigWrapper) -> tuple[Chain, int]:
    """(chain, position in it) of the options cs_pin, chain_length and chain_position."""
    length = config.getint("chain_length", None, minval=2)
    if length is None:
        return Chain(config, 1, None), 1
    position = config.getint("chain_position", minval=1, maxval=length)
    pins = config.get_printer().lookup_object("pins")
    params = pins.lookup_pin(config.get("cs_pin"), share_type="tmc_spi_cs")
    chain: Chain | None = params.get("class")
    if chain is None:
        chain = params["class"] = Chain(config, length, "tmc_spi_cs")
    for option in BUS_OPTIONS:  # the same again for each driver: the first one's count
        config.get(option, None)
    name = config.get_name()
    if chain.length != length:
        raise config.error(f"Section '{name}': all drivers of an SPI chain must have the same chain_length")
    if position in chain.taken:
        raise config.error(f"Section '{name}': {chain.taken[position]} has the same chain_position")
    chain.taken[position] = name
    return chain, position


class RegisterLink:
    """Registers of one driver."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split(None, 1)[-1]
        self.chain, self.position = lookup_chain(config)
        self.mcu = self.chain.mcu

    def read(self, register: int) -> int:
        """Value of a register. Whether it comes from this chip cannot be checked."""
        ask = bytes([register, 0, 0, 0, 0])
        with self.chain.mutex:
            answer = self.chain.exchange(self.position, ask, ask)
        return int.from_bytes(answer[1:], "big")

    def write(self, register: int, value: int) -> None:
        """Set a register, and check that the driver sends back the value written."""
        data = value.to_bytes(4, "big")
        with self.chain.mutex:
            for _ in range(TRIES):
                answer = self.chain.exchange(self.position, bytes([register | WRITE_FLAG]) + data, REST)
                if self.mcu.is_fileoutput() or answer[1:] == data:
                    return
        raise self.printer.command_error(
            f"The driver of '{self.name}' does not answer on its SPI bus. Check cs_pin, the bus and its wiring, and "
            "that the driver has motor power."
        )
