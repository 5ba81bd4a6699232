"""A board for one simulated MCU, in plain Python: loads the library, speaks the wire format, records the pins.

The message codec here is written apart from the host's, from the protocol's description, so that the two check one
another.  All times are MCU clocks (72 MHz ticks).
"""

from __future__ import annotations

import fcntl
import functools
import json
import os
import shutil
import subprocess
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cffi

from chelper.compiler import read_headers

ROOT = Path(__file__).resolve().parents[3]
SIM_DIR = ROOT / "out" / "simulator"
FREQ = 72_000_000
HEADER = ROOT / "klippy" / "simulation" / "emulator" / "emulator.h"  # with src/simulator/sim_mcu.h


def make(target: str, *variables: str) -> None:
    """Bring a target of src/build.mk up to date; test processes that run side by side take turns."""
    (ROOT / "out").mkdir(exist_ok=True)
    with open(ROOT / "out" / ".simulation-lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = ["make", "-s", "-f", "src/build.mk", target, *variables]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, f"make {target} failed:\n{run.stdout}{run.stderr}"


@functools.cache
def library_path() -> Path:
    """The library under test; FERRITE_MCU_LIBRARY names another build of it (the sanitized one)."""
    if "FERRITE_MCU_LIBRARY" in os.environ:
        return Path(os.environ["FERRITE_MCU_LIBRARY"])
    make("firmware-sim")
    return SIM_DIR / "libferrite_mcu.so"


@functools.cache
def _declarations() -> str:
    return read_headers([HEADER], f"-I{ROOT / 'src' / 'simulator'}")


def load_library(path: Path) -> tuple[cffi.FFI, Any]:
    """Load a copy of the library, so that each has its own static data."""
    ffi = cffi.FFI()
    ffi.cdef(_declarations())
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "mcu.so"
        shutil.copy(path, copy)
        return ffi, ffi.dlopen(os.fspath(copy))


# ---------------------------------------------------------------- wire format


def crc16(data: bytes) -> int:
    """CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x8408 if crc & 1 else 0)
    return crc


def make_block(sequence: int, content: bytes) -> bytes:
    body = bytes([len(content) + 5, 0x10 | sequence & 15]) + content
    return body + crc16(body).to_bytes(2, "big") + b"\x7e"


def vlq(value: int) -> bytes:
    """Encode a number; unsigned ones above 2^31 as they are (five bytes)."""
    groups = [value & 0x7F]
    rest = value
    while not -32 <= rest <= 95 and len(groups) < 5:
        rest >>= 7
        groups.insert(0, rest & 0x7F | 0x80)
    return bytes(groups)


def take_vlq(data: bytes, position: int) -> tuple[int, int]:
    first = data[position]
    value = (first & 0x7F) - (0x80 if first & 0x60 == 0x60 else 0)
    while data[position] & 0x80:
        position += 1
        value = value << 7 | data[position] & 0x7F
    return value, position + 1


@dataclass(frozen=True)
class Format:
    """One message of the dictionary."""

    number: int
    name: str
    params: tuple[tuple[str, str], ...]  # (name, %type)

    @classmethod
    def parse(cls, text: str, number: int) -> Format:
        name, *words = text.split()
        pairs = (word.split("=") for word in words)
        return cls(number, name, tuple((key, kind) for key, kind in pairs))

    def encode(self, values: dict[str, int | bytes]) -> bytes:
        assert set(values) == {key for key, _ in self.params}, f"{self.name} takes {self.params}"
        out = vlq(self.number)
        for key, _ in self.params:
            value = values[key]
            out += vlq(value) if isinstance(value, int) else bytes([len(value)]) + value
        return out

    def decode(self, data: bytes, position: int) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key, kind in self.params:
            if kind.endswith("s"):
                length = data[position]
                values[key] = data[position + 1 : position + 1 + length]
                position += 1 + length
            else:
                values[key], position = take_vlq(data, position)
                if kind in ("%u", "%c", "%hu"):
                    values[key] &= 0xFFFFFFFF
        assert position == len(data), f"{self.name}: {len(data) - position} bytes left over"
        return values


class Dictionary:
    """The data dictionary: formats by name and number, constants, enumerations."""

    def __init__(self, plain: dict[str, Any]) -> None:
        self.plain = plain
        self.commands = {f.name: f for f in (Format.parse(t, n) for t, n in plain["commands"].items())}
        self.responses = {f.number: f for f in (Format.parse(t, n) for t, n in plain["responses"].items())}
        self.shutdown_texts = {
            number: text for text, number in plain["enumerations"]["static_string_id"].items()
        }

    @classmethod
    def built(cls) -> Dictionary:
        library_path()
        return cls(json.loads((SIM_DIR / "ferrite.dict").read_text()))


# ---------------------------------------------------------------- board


@dataclass(frozen=True)
class Reply:
    """One block from the MCU: an ack or nak (name "") or a response."""

    name: str
    clock: int
    sequence: int
    values: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, key: str) -> Any:
        return self.values[key]


class Mcu:
    """A booted MCU on a recording board, and the host's end of its wire."""

    def __init__(self, path: Path | None = None, boot_clock: int = 1000) -> None:
        self.dictionary = Dictionary.built()
        self.ffi, self.lib = load_library(path or library_path())
        self.pin_writes: list[tuple[int, int, int]] = []  # clock, pin, value
        self.pwm_writes: list[tuple[int, int, int, int]] = []  # clock, pin, cycle_ticks, value
        self.bridge_sets: list[tuple[int, int]] = []  # clock, phase
        self.sampling_moves: list[tuple[int, int]] = []  # clock, ticks late
        self.sample_reads: list[tuple[int, int, int]] = []  # first clock, count, period
        self.sent: list[tuple[int, bytes]] = []  # clock, block
        self.input_level: Callable[[int, int], int] = lambda pin, clock: 0
        self.adc_code: Callable[[int, int], int] = lambda pin, clock: 2000
        self.sample_code: Callable[[int], int] = lambda clock: 1000
        self.spi_transfers: list[tuple[int, int, int, bytes]] = []  # clock, bus, mode, bytes sent
        self.spi_reply: Callable[[int, bytes], bytes] = lambda bus, sent: bytes(len(sent))
        self.i2c_transfers: list[
            tuple[int, int, bytes, int]
        ] = []  # bus, address, bytes written, bytes to read
        self.i2c_reply: Callable[[int, bytes, int], tuple[int, bytes]] = lambda address, wrote, count: (
            0,
            bytes(count),
        )
        self.sequence = 0
        self.board = self._make_board()
        self.boot(boot_clock)

    def _make_board(self) -> Any:
        ffi = self.ffi

        def sync_adc_read(_ctx: Any, samples: Any, count: int, first: int, period: int) -> None:
            self.sample_reads.append((first, count, period))
            for i in range(count):
                samples[i] = self.sample_code(first + i * period)

        def spi_exchange(_ctx: Any, bus: int, mode: int, data: Any, length: int, clock: int) -> None:
            sent = bytes(ffi.buffer(data, length))
            self.spi_transfers.append((clock, bus, mode, sent))
            ffi.buffer(data, length)[:] = self.spi_reply(bus, sent)

        def i2c_exchange(
            _ctx: Any, bus: int, address: int, write: Any, wrote: int, read: Any, count: int, _clock: int
        ) -> int:
            sent = bytes(ffi.buffer(write, wrote)) if wrote else b""
            self.i2c_transfers.append((bus, address, sent, count))
            status, reply = self.i2c_reply(address, sent, count)
            if count:
                ffi.buffer(read, count)[:] = reply
            return status

        functions = {
            "pin_write": lambda _c, pin, value, clock: self.pin_writes.append((clock, pin, value)),
            "pin_read": lambda _c, pin, clock: self.input_level(pin, clock),
            "pwm_write": lambda _c, pin, cycle, value, clock: self.pwm_writes.append(
                (clock, pin, cycle, value)
            ),
            "adc_read": lambda _c, pin, clock: self.adc_code(pin, clock),
            "bridge_set": lambda _c, phase, clock: self.bridge_sets.append((clock, phase)),
            "sync_adc_read": sync_adc_read,
            "sync_adc_move": lambda _c, ticks, clock: self.sampling_moves.append((clock, ticks)),
            "console_send": lambda _c, data, n, clock: self.sent.append((clock, bytes(ffi.buffer(data, n)))),
            "spi_exchange": spi_exchange,
            "i2c_exchange": i2c_exchange,
        }
        board = ffi.new("struct sim_board *")
        kinds = dict(ffi.typeof("struct sim_board").fields)
        self._callbacks = [ffi.callback(kinds[name].type, function) for name, function in functions.items()]
        for name, callback in zip(functions, self._callbacks, strict=True):
            setattr(board, name, callback)
        return board

    # ------------------------------------------------ time and bytes

    def boot(self, clock: int) -> None:
        self.now = clock
        self.sequence = 0
        self.lib.sim_mcu_boot(self.board, clock)

    def run_to(self, clock: int) -> None:
        self.now = max(self.now, clock)
        self.lib.sim_mcu_advance(self.now)

    def run(self, seconds: float) -> None:
        self.run_to(self.now + round(seconds * FREQ))

    def raw(self, data: bytes) -> bytes:
        """Bytes to the MCU now; what it sends back at once."""
        before = len(self.sent)
        self.lib.sim_mcu_receive(data, len(data))
        self.lib.sim_mcu_advance(self.now)
        return b"".join(block for _, block in self.sent[before:])

    # ------------------------------------------------ messages

    def encode(self, name: str, **values: int | bytes) -> bytes:
        return self.dictionary.commands[name].encode(values)

    def decode(self, clock: int, block: bytes) -> Reply:
        body, crc = block[:-3], int.from_bytes(block[-3:-1], "big")
        assert block[0] == len(block) and block[-1] == 0x7E and crc == crc16(body) and block[1] & 0xF0 == 0x10
        if len(block) == 5:
            return Reply("", clock, block[1] & 15)
        number, position = take_vlq(body, 2)
        form = self.dictionary.responses[number]
        return Reply(form.name, clock, block[1] & 15, form.decode(body, position))

    def replies(self, name: str | None = None) -> list[Reply]:
        """All blocks sent so far, or those of one response."""
        decoded = [self.decode(clock, block) for clock, block in self.sent]
        return [reply for reply in decoded if name is None or reply.name == name]

    def send_content(self, content: bytes) -> list[Reply]:
        """One block with the right sequence number; the replies to it, without the ack."""
        before = len(self.sent)
        self.raw(make_block(self.sequence, content))
        self.sequence = (self.sequence + 1) & 15
        decoded = [self.decode(clock, block) for clock, block in self.sent[before:]]
        return [reply for reply in decoded if reply.name]

    def send(self, name: str, **values: int | bytes) -> list[Reply]:
        return self.send_content(self.encode(name, **values))

    def ask(self, name: str, **values: int | bytes) -> Reply:
        """Send a query that has exactly one answer."""
        (reply,) = self.send(name, **values)
        return reply

    def configure(self, oids: int, *commands: tuple[str, dict[str, Any]]) -> None:
        self.send("allocate_oids", count=oids)
        for name, values in commands:
            self.send(name, **values)
        self.send("finalize_config", crc=0x12345678)
        assert self.ask("get_config")["is_config"] == 1, self.shutdown_reason()

    # ------------------------------------------------ what happened

    def shutdown_reason(self) -> str | None:
        """The text of the last shutdown message, None if there was none."""
        messages = self.replies("shutdown")
        return self.dictionary.shutdown_texts[messages[-1]["static_string_id"]] if messages else None

    def edges(self, pin: int) -> list[tuple[int, int]]:
        """(clock, level) of each change of an output."""
        changes: list[tuple[int, int]] = []
        for clock, where, value in self.pin_writes:
            if where == pin and (not changes or changes[-1][1] != value):
                changes.append((clock, value))
        return changes

    def identify(self) -> dict[str, Any]:
        """Fetch the dictionary as a host does, 40 bytes at a time."""
        data = b""
        while True:
            reply = self.ask("identify", offset=len(data), count=40)
            assert reply["offset"] == len(data)
            if not reply["data"]:
                return dict(json.loads(zlib.decompress(data)))
            data += reply["data"]
