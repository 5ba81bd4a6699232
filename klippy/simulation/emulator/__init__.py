"""What an emulated chip offers beside the interface of a simulated MCU (emulator.h), for Python."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import cffi

from ..world import World, WorldError

_HEADER = Path(__file__).with_name("emulator.h")
_FUNCTION = re.compile(r"^SIM_EXPORT (?P<type>.+?)\b(?P<name>emulator_\w+)\((?P<arguments>.*)\);", re.M)


@lru_cache(maxsize=1)
def _ffi() -> tuple[Any, dict[str, str]]:
    """cffi with the header's types, and the type of each function by its name."""
    text = _HEADER.read_text()
    types = re.findall(r"^enum \{.*?\};|^struct \w+ \{.*?^\};", text, re.M | re.S)
    ffi = cffi.FFI()
    ffi.cdef("\n".join(types))
    functions = {m["name"]: f"{m['type']}(*)({m['arguments']})" for m in _FUNCTION.finditer(text)}
    return ffi, functions


class Recording:
    """What Emulator.record() has written down so far: the chip's clock of each entry, and its value."""

    def __init__(self, ffi: Any, capacity: int) -> None:
        self._ffi = ffi
        self._clocks = ffi.new("uint64_t[]", capacity)
        self._values = ffi.new("uint32_t[]", capacity)
        self.record = ffi.new("struct emulator_record *", (self._clocks, self._values, capacity, 0))

    def arrays(self) -> tuple[memoryview, memoryview]:
        """Clocks (64 bits) and values (32 bits); a view, good while this object is."""
        count = self.record.count
        assert count < self.record.capacity, "the recording is full"
        clocks = memoryview(self._ffi.buffer(self._clocks, 8 * count)).cast("Q")
        return clocks, memoryview(self._ffi.buffer(self._values, 4 * count)).cast("I")


class Emulator:
    """The chip under MCU `mcu` of a world."""

    def __init__(self, world: World, mcu: int) -> None:
        self._world, self._mcu = world, mcu
        self._ffi, self._types = _ffi()

    def _call(self, name: str, *arguments: Any) -> Any:
        address = self._world.lib.world_symbol(self._world.pointer, self._mcu, name.encode())
        if not address:
            raise WorldError("This MCU is not emulated.")
        return self._ffi.cast(self._types[name], address)(*arguments)

    def counters(self) -> dict[str, Any]:
        """struct emulator_counters; tables by exception number hold only those that have occurred."""
        record = self._ffi.new("struct emulator_counters *")
        self._call("emulator_counters", record)
        counters: dict[str, Any] = {}
        for name, field in self._ffi.typeof("struct emulator_counters").fields:
            value = getattr(record, name)
            if field.type.kind == "array":
                value = {i: int(v) for i, v in enumerate(value) if v}
            counters[name] = value
        return counters

    def mutate(self, what: str, value: int = 1) -> None:
        """Break something of the chip or its board: see docs/reference/Emulation.md."""
        if self._call("emulator_mutate", what.encode(), value):
            raise WorldError(f"This chip has no '{what}' to break.")

    def peek(self, what: str) -> int:
        """The value of a register."""
        value = self._ffi.new("uint32_t *")
        if self._call("emulator_peek", what.encode(), value):
            raise WorldError(f"This chip shows no '{what}' now.")
        return int(value[0])

    def record(self, what: str, capacity: int) -> Recording:
        """Write down what happens from now on. Keep the answer as long as the chip runs."""
        recording = Recording(self._ffi, capacity)
        if self._call("emulator_record", what.encode(), recording.record):
            raise WorldError(f"This chip has no '{what}' to record.")
        return recording

    def profile(self, function: str) -> int:
        """Instructions executed in one function of the image so far, without the functions it calls."""
        count = int(self._call("emulator_profile", function.encode()))
        if count < 0:
            raise WorldError(f"The image has no function '{function}'.")
        return count
