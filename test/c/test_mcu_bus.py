"""SPI and I2C of the simulated MCU: by hardware, by hand on pins, and what is sent to devices in a shutdown."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from mcu_harness import Mcu

CS, MISO, MOSI, SCLK = 20, 21, 22, 23
SCL, SDA = 30, 31
ADDRESS = 0x48


def spi(*more: tuple[str, dict[str, Any]], cs_active_high: int = 0) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    device = {"oid": 0, "pin": CS, "cs_active_high": cs_active_high}
    mcu.configure(3, ("config_spi", device), *more)
    return mcu


HARDWARE = ("spi_set_bus", {"oid": 0, "spi_bus": 1, "mode": 3, "rate": 4_000_000})


def test_a_transfer_is_framed_by_the_chip_select_and_answered() -> None:
    mcu = spi(HARDWARE)
    level_during: list[int] = []

    def reply(bus: int, sent: bytes) -> bytes:
        level_during.append(mcu.edges(CS)[-1][1])
        return bytes(255 - byte for byte in sent)

    mcu.spi_reply = reply
    answer = mcu.ask("spi_transfer", oid=0, data=b"\x01\x02\xfe")
    assert answer["response"] == b"\xfe\xfd\x01"
    assert [transfer[1:] for transfer in mcu.spi_transfers] == [(1, 3, b"\x01\x02\xfe")]
    assert [level for _, level in mcu.edges(CS)] == [1, 0, 1] and level_during == [0]


def test_an_active_high_chip_select_is_the_other_way_round() -> None:
    mcu = spi(HARDWARE, cs_active_high=1)
    mcu.send("spi_send", oid=0, data=b"\x55")
    assert [level for _, level in mcu.edges(CS)] == [0, 1, 0]
    assert mcu.replies("spi_transfer_response") == []
    assert mcu.spi_transfers[0][3] == b"\x55"


def test_a_device_without_chip_select_moves_no_pin() -> None:
    mcu = Mcu()
    bus = {"oid": 0, "spi_bus": 0, "mode": 0, "rate": 1}
    mcu.configure(1, ("config_spi_without_cs", {"oid": 0}), ("spi_set_bus", bus))
    mcu.ask("spi_transfer", oid=0, data=b"\x01")
    assert mcu.pin_writes == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"spi_bus": 9}, "Invalid spi bus"), ({"mode": 4}, "Invalid spi_setup parameters")],
)
def test_hardware_that_is_not_there_shuts_down(change: dict[str, int], reason: str) -> None:
    mcu = Mcu()
    mcu.send("allocate_oids", count=1)
    mcu.send("config_spi_without_cs", oid=0)
    mcu.send("spi_set_bus", **({"oid": 0, "spi_bus": 0, "mode": 0, "rate": 1000} | change))
    assert mcu.shutdown_reason() == reason


def test_a_device_without_bus_is_refused() -> None:
    mcu = spi()
    mcu.send("spi_send", oid=0, data=b"\x01")
    assert mcu.shutdown_reason() == "Invalid spi config"


def test_the_shutdown_message_goes_out_once_the_firmware_stops() -> None:
    last_words = ("config_spi_shutdown", {"oid": 1, "spi_oid": 0, "shutdown_msg": b"\xde\xad"})
    mcu = spi(HARDWARE, last_words)
    assert mcu.spi_transfers == []
    mcu.send("emergency_stop")
    assert [transfer[3] for transfer in mcu.spi_transfers] == [b"\xde\xad"]
    assert mcu.edges(CS)[-1][1] == 1


# ---------------------------------------------------------------- SPI by hand


class SpiSlave:
    """A shift register on four pins, written from the definition of the four modes."""

    def __init__(self, mcu: Mcu, mode: int, answer: int, bits: int) -> None:
        self.mcu, self.cpol, self.cpha = mcu, mode >> 1, mode & 1
        self.answer, self.bits = answer, bits

    def level(self, pin: int, upto: int | None = None) -> int:
        writes = [value for _, where, value in self.mcu.pin_writes[:upto] if where == pin]
        return writes[-1] if writes else 0

    def clock_edges(self) -> list[tuple[int, int, int]]:
        """(clock, new level, index into pin_writes) of SCLK while selected."""
        found, last = [], self.cpol
        for index, (clock, pin, value) in enumerate(self.mcu.pin_writes):
            if pin == SCLK and value != last:
                last = value
                if self.level(CS, index) == 0:
                    found.append((clock, value, index))
        return found

    def read(self, pin: int, _clock: int) -> int:
        """MISO: bit n stands from n leading edges on (CPHA 1), or until the n-th trailing edge (CPHA 0)."""
        if pin != MISO:
            return 0
        edges = self.clock_edges()
        leading = sum(1 for _, value, _ in edges if value != self.cpol)
        done = leading - 1 if self.cpha else len(edges) - leading
        return self.answer >> (self.bits - 1 - done) & 1

    def received(self) -> bytes:
        """What the slave samples on MOSI: on leading edges (CPHA 0) or trailing ones (CPHA 1)."""
        sampled = self.cpol if self.cpha else 1 - self.cpol
        bits = [self.level(MOSI, index) for _, value, index in self.clock_edges() if value == sampled]
        return int("".join(map(str, bits)), 2).to_bytes(len(bits) // 8, "big")


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_software_spi_speaks_all_four_modes_at_the_rate_asked_for(mode: int) -> None:
    pins = {"miso_pin": MISO, "mosi_pin": MOSI, "sclk_pin": SCLK}
    mcu = spi(("spi_set_sw_bus", {"oid": 0, "mode": mode, "pulse_ticks": 36, **pins}))
    slave = SpiSlave(mcu, mode, 0x8C5A01, 24)
    mcu.input_level = slave.read
    assert mcu.ask("spi_transfer", oid=0, data=b"\xa5\x01\x80")["response"] == b"\x8c\x5a\x01"
    assert slave.received() == b"\xa5\x01\x80"
    assert slave.level(SCLK) == mode >> 1, "the clock rests at its idle level"
    clocks = [clock for clock, _, _ in slave.clock_edges()]
    assert all(b - a >= 36 for a, b in itertools.pairwise(clocks))


def test_software_spi_too_slow_for_a_task_is_refused() -> None:
    mcu = Mcu()
    mcu.send("allocate_oids", count=1)
    mcu.send("config_spi_without_cs", oid=0)
    mcu.send("spi_set_sw_bus", oid=0, miso_pin=1, mosi_pin=2, sclk_pin=3, mode=0, pulse_ticks=72_000_000)
    assert mcu.shutdown_reason() == "Invalid spi_setup parameters"


# ---------------------------------------------------------------- I2C


def i2c(setup: tuple[str, dict[str, Any]]) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    mcu.configure(1, ("config_i2c", {"oid": 0}), setup)
    return mcu


I2C_HARDWARE = ("i2c_set_bus", {"oid": 0, "i2c_bus": 1, "rate": 100_000, "address": ADDRESS})
I2C_SOFTWARE = (
    "i2c_set_sw_bus",
    {"oid": 0, "scl_pin": SCL, "sda_pin": SDA, "pulse_ticks": 360, "address": ADDRESS},
)


def test_hardware_i2c_hands_on_what_the_bus_says() -> None:
    mcu = i2c(I2C_HARDWARE)
    mcu.i2c_reply = lambda address, wrote, count: (0, bytes(range(count)))
    answer = mcu.ask("i2c_transfer", oid=0, write=b"\x10", read_len=3)
    assert (answer["i2c_bus_status"], answer["response"]) == (0, b"\x00\x01\x02")
    assert mcu.i2c_transfers == [(1, ADDRESS, b"\x10", 3)]
    mcu.i2c_reply = lambda address, wrote, count: (3, bytes(count))
    answer = mcu.ask("i2c_transfer", oid=0, write=b"\x10", read_len=3)
    status = mcu.dictionary.plain["enumerations"]["i2c_bus_status"]
    assert answer["i2c_bus_status"] == status["START_NACK"] and answer["response"] == b""
    assert mcu.shutdown_reason() is None


class I2cSlave:
    """An EEPROM-like device on SCL and SDA, following the lines write by write.

    The harness records what the master does to its own outputs; a line let go shows as level 1. The slave's own
    pull on SDA (and a stretched SCL) comes in through input_level.
    """

    def __init__(self, mcu: Mcu, address: int = ADDRESS, memory: bytes = b"\x11\x22\x33") -> None:
        self.mcu, self.address, self.memory = mcu, address, memory
        self.seen = 0
        self.levels = {SCL: 1, SDA: 1}
        self.pull = False  # the slave holds SDA low
        self.mode = "idle"
        self.bits: list[int] = []
        self.out: list[int] = []
        self.log: list[str] = []
        self.nack_from = 99  # data bytes acknowledged before refusing
        self.stretch_until = 0

    def read(self, pin: int, clock: int) -> int:
        for _, where, value in self.mcu.pin_writes[self.seen :]:
            if where in self.levels and self.levels[where] != value:
                self.levels[where] = value
                self.follow(where, value)
        self.seen = len(self.mcu.pin_writes)
        if pin == SCL and clock < self.stretch_until:
            return 0
        return 0 if pin == SDA and self.pull else self.levels[pin]

    def follow(self, pin: int, value: int) -> None:
        if pin == SDA and self.levels[SCL] and not self.pull:
            self.mode, self.bits, self.pull = ("idle", [], False) if value else ("address", [], False)
            self.log.append("P" if value else "S")
        elif pin == SCL and value:
            if self.mode in ("address", "write", "ack-master"):
                self.bits.append(self.levels[SDA])
        elif pin == SCL:
            self.on_fall()

    def on_fall(self) -> None:
        if self.mode in ("address", "write") and len(self.bits) == 8:
            byte = int("".join(map(str, self.bits)), 2)
            self.log.append(f"{byte:02x}")
            data_bytes = sum(len(entry) == 2 for entry in self.log)
            good = byte >> 1 == self.address if self.mode == "address" else data_bytes <= self.nack_from
            self.pull = good
            self.reading = self.mode == "address" and byte & 1
            self.bits = []
            self.mode = "acked" if good else "idle"
        elif self.mode == "acked":
            self.pull = False
            self.mode = "write"
            if self.reading:
                self.start_byte(self.memory[0])
                self.memory = self.memory[1:]
        elif self.mode == "read":
            self.next_bit()
        elif self.mode == "ack-master" and self.bits:
            last = self.bits.pop()
            self.log.append("n" if last else "a")
            self.mode = "idle"
            if not last:
                self.start_byte(self.memory[0])
                self.memory = self.memory[1:]

    def start_byte(self, byte: int) -> None:
        self.mode, self.out = "read", [byte >> (7 - i) & 1 for i in range(8)]
        self.next_bit()

    def next_bit(self) -> None:
        if self.out:
            self.pull = not self.out.pop(0)
        else:
            self.pull, self.mode, self.bits = False, "ack-master", []


def software_slave(**options: Any) -> tuple[Mcu, I2cSlave]:
    mcu = i2c(I2C_SOFTWARE)
    slave = I2cSlave(mcu, **options)
    slave.seen = len(mcu.pin_writes)
    mcu.input_level = slave.read
    return mcu, slave


def test_software_i2c_writes_and_reads_in_one_transfer() -> None:
    mcu, slave = software_slave()
    answer = mcu.ask("i2c_transfer", oid=0, write=b"\xa5\x0f", read_len=3)
    slave.read(SDA, 0)
    assert (answer["i2c_bus_status"], answer["response"]) == (0, b"\x11\x22\x33")
    assert slave.log == ["S", "90", "a5", "0f", "S", "91", "a", "a", "n", "P"]


def test_software_i2c_reads_without_writing_and_keeps_its_speed() -> None:
    mcu, slave = software_slave()
    assert mcu.ask("i2c_transfer", oid=0, write=b"", read_len=1)["response"] == b"\x11"
    slave.read(SDA, 0)
    assert slave.log == ["S", "91", "n", "P"]
    clocks = [clock for clock, _ in mcu.edges(SCL)]
    assert all(b - a >= 360 for a, b in itertools.pairwise(clocks[1:]))


@pytest.mark.parametrize(("address", "nack_from", "status"), [(0x21, 99, "START_NACK"), (ADDRESS, 2, "NACK")])
def test_software_i2c_reports_who_did_not_answer(address: int, nack_from: int, status: str) -> None:
    mcu, slave = software_slave(address=address)
    slave.nack_from = nack_from
    answer = mcu.ask("i2c_transfer", oid=0, write=b"\x01\x02\x03", read_len=0)
    assert answer["i2c_bus_status"] == mcu.dictionary.plain["enumerations"]["i2c_bus_status"][status]
    slave.read(SDA, 0)
    assert slave.log[-1] == "P", "the bus is left free"


def test_software_i2c_waits_for_a_stretched_clock_but_not_for_ever() -> None:
    mcu, slave = software_slave()
    slave.stretch_until = mcu.now + 72 * 500  # 0.5 ms: within the limit
    assert mcu.ask("i2c_transfer", oid=0, write=b"", read_len=1)["response"] == b"\x11"
    mcu, slave = software_slave()
    slave.stretch_until = mcu.now + 72_000_000
    answer = mcu.ask("i2c_transfer", oid=0, write=b"", read_len=1)
    assert answer["i2c_bus_status"] == mcu.dictionary.plain["enumerations"]["i2c_bus_status"]["TIMEOUT"]


def test_an_i2c_read_longer_than_a_message_is_refused() -> None:
    mcu = i2c(I2C_HARDWARE)
    mcu.send("i2c_transfer", oid=0, write=b"", read_len=60)
    assert mcu.shutdown_reason() == "Invalid i2c_setup parameters!"
