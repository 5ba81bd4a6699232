"""A world with fake MCUs (fake_mcu.c) whose pins a test works directly."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

from simulation.world import Pin, World

HERE = Path(__file__).resolve().parent
FAKE_CLOCK_HZ = 72e6  # the fake counts at the rate the real one has


def build_fake(folder: Path) -> Path:
    """Compile the fake MCU into `folder`."""
    library = folder / "fake_mcu.so"
    include = HERE.parents[1] / "src" / "simulator"
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", f"-I{include}"]
    subprocess.run(["gcc", *flags, "-o", library, HERE / "fake_mcu.c"], check=True)
    return library


class Rig:
    """One world, its MCUs on lines that take no time by default."""

    def __init__(self, library: Path, seed: int = 1, mcus: int = 1, **link: float) -> None:
        self.world = World(seed)
        line = {"baud": 0.0, "latency_s": 0.0, **link}
        self.mcus = [self.world.add_mcu(library=library, **line) for _ in range(mcus)]

    def start(self) -> None:
        """Power on; the boot bytes are taken away."""
        self.run(0.001)
        for mcu in self.mcus:
            self.world.drain_bytes(mcu)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.world.advance(self.world.now + seconds)

    def order(self, text: bytes, mcu: int = 0, reply: int = 0) -> bytes:
        """Send orders and let them happen (50 µs later at most); returns what the MCU said."""
        self.world.feed_bytes(mcu, text)
        self.run(50e-6)
        answer = self.world.drain_bytes(mcu)
        assert len(answer) == reply, f"{len(answer)} bytes came back, not {reply}"
        return answer

    def write(self, pin: Pin, value: int) -> None:
        self.order(bytes([ord("w"), pin.number, value]), pin.mcu)

    def read(self, pin: Pin) -> int:
        return self.order(bytes([ord("r"), pin.number]), pin.mcu, 1)[0]

    def adc(self, pin: Pin) -> int:
        return int(struct.unpack("<H", self.order(bytes([ord("a"), pin.number]), pin.mcu, 2))[0])

    def clock(self, mcu: int = 0) -> int:
        return int(struct.unpack("<Q", self.order(b"c", mcu, 8))[0])

    def steps(self, step: Pin, direction: Pin, count: int, forward: bool) -> None:
        """`count` full step pulses."""
        self.write(direction, int(forward))
        for _ in range(count):
            self.order(bytes([ord("w"), step.number, 1, ord("w"), step.number, 0]), step.mcu)
