"""The host's end of a simulated line: hands the serial queue to the world, which calls it directly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import chelper

from .simtime import SimTime
from .world import World


class SimPort:
    """One open connection to a simulated MCU (the `Port` contract of klippy/link/serialport.py)."""

    def __init__(self, world: World, time: SimTime, mcu: int) -> None:
        self._world, self._time, self._mcu = world, time, mcu

    def attach(self, sq_pointer: Any, on_receive: Callable[[], None]) -> None:
        """From now on the world moves bytes between this queue and the MCU."""
        ffi, lib = chelper.get_ffi()

        def address(thing: Any) -> int:
            return int(ffi.cast("uintptr_t", thing))

        result = self._world.lib.world_attach(
            self._world.pointer,
            self._mcu,
            address(sq_pointer),
            address(ffi.addressof(lib, "serialqueue_receive")),
            address(ffi.addressof(lib, "serialqueue_transmit")),
        )
        assert result == 0, "attach to an MCU that is not there"
        self._time.set_receiver(self._mcu, on_receive)

    def notify(self) -> None:
        """Nothing to do: the world asks every queue before it lets time pass."""

    def reset(self) -> None:
        """A simulated line has no reset wire; the firmware's reset command does it."""

    def close(self) -> None:
        """The world stops using the queue; bytes on the way are lost."""
        self._time.set_receiver(self._mcu, None)
        if self._world.pointer is not None:
            self._world.lib.world_detach(self._world.pointer, self._mcu)
