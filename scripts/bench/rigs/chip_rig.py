"""An emulated chip on the recording board of test/c: board and wire of mcu_harness.Mcu with a chip's image in place of
the simulator port: same tests, other chip.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mcu_harness import FREQ, Dictionary, Mcu, Reply, make_block
from simulation.builds import Build, make_build
from simulation.emulator import Emulator


class _World:
    """What Emulator needs of a world: the functions of one library by name."""

    def __init__(self, ffi: Any, lib: Any, emulator: Any) -> None:
        self.pointer, self.lib = None, self
        self._ffi, self._lib, self._types = ffi, lib, emulator

    def world_symbol(self, _world: Any, _mcu: int, name: bytes) -> int:
        return int(self._ffi.cast("uintptr_t", self._ffi.addressof(self._lib, name.decode())))


class Chip(Mcu):
    """A chip with an image, powered on."""

    def __init__(
        self, build: Build, image: Path, boot_clock: int = 0, mutations: tuple[str, ...] = ()
    ) -> None:
        self.build = build
        self.image = image
        self.mutations = mutations
        super().__init__(build.library, boot_clock)

    def boot(self, clock: int) -> None:
        error = self.lib.emulator_load(str(self.image).encode())
        assert error == self.ffi.NULL, self.ffi.string(error).decode()
        self.chip = Emulator(_World(self.ffi, self.lib, None), 0)  # type: ignore[arg-type]
        for mutation in self.mutations:
            self.chip.mutate(mutation)
        super().boot(clock)

    def fault(self) -> str:
        """What the model objects to, "" if nothing."""
        text = self.ffi.new("char[640]")
        return self.ffi.string(text).decode() if self.lib.emulator_fault(text, 640) else ""


class Firmware(Chip):
    """The firmware's image, and the host's end of its wire: a message takes the line's time here."""

    PATIENCE_S = 0.02  # for an answer: 64 bytes each way at 250 kbit/s are 5 ms

    def __init__(self, name: str = "stm32f334", settle_s: float = 0.05, **options: Any) -> None:
        build = make_build(name)
        assert build.image is not None
        self._whole = 0  # of `sent`: blocks that are complete
        super().__init__(build, build.image, **options)
        self.dictionary = Dictionary(json.loads(build.dictionary.read_text()))
        self.run(settle_s)

    def _blocks(self) -> None:
        """The line brings pieces; the harness wants whole blocks, each at the clock of its last byte."""
        pieces = self.sent[self._whole :]
        del self.sent[self._whole :]
        rest = b""
        for clock, piece in pieces:
            rest += piece
            while rest and len(rest) >= rest[0]:
                self.sent.append((clock, rest[: rest[0]]))
                rest = rest[rest[0] :]
        self._whole = len(self.sent)
        if rest:
            self.sent.append((self.now, rest))  # the beginning of a block, finished by the next piece

    def raw(self, data: bytes) -> bytes:
        before = len(self.sent)
        self.lib.sim_mcu_receive(data, len(data))
        limit, quiet = self.now + round(self.PATIENCE_S * FREQ), 0
        while self.now < limit and quiet < 3:
            pieces = len(self.sent)
            self.run(0.001)
            quiet = quiet + 1 if pieces == len(self.sent) > before else 0
        return b"".join(block for _, block in self.sent[before:])

    def replies(self, name: str | None = None) -> list[Reply]:
        decoded = [self.decode(clock, block) for clock, block in self.sent[: self._whole]]
        return [reply for reply in decoded if name is None or reply.name == name]

    def post(self, name: str, **values: int | bytes) -> None:
        """A message whose answer nobody waits for; no time passes. At most 192 bytes between two runs."""
        block = make_block(self.sequence, self.encode(name, **values))
        self.lib.sim_mcu_receive(block, len(block))
        self.sequence = (self.sequence + 1) & 15

    def run(self, seconds: float) -> None:
        super().run(seconds)
        self._blocks()
        assert not self.fault(), self.fault()

    def send_content(self, content: bytes) -> list[Reply]:
        before = self._whole
        self.raw(make_block(self.sequence, content))
        self.sequence = (self.sequence + 1) & 15
        decoded = [self.decode(clock, block) for clock, block in self.sent[before : self._whole]]
        return [reply for reply in decoded if reply.name]
