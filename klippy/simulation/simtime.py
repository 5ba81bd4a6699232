"""The reactor's clock in a simulation: waiting makes the world move.

Theory of operation: klippy/simulation/README.md, "Who owns virtual time".
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from .world import World

if TYPE_CHECKING:
    from reactor import FdPoll

# Longest stretch without a look at file descriptors, signals and the hook, s.
MAX_STRETCH_S = 0.25
AWAKE_S = 0.014  # mean time from one pause of a late host to the next: it is late as often as not


class SimTime:
    """A `TimeSource` on a simulated world.

    `before_advance(now)` is called each time before time moves: what the host has decided by then can be read
    off there.
    """

    runs_by_itself = False

    def __init__(self, world: World) -> None:
        self._world = world
        self._advance = world.lib.world_advance
        self._read_now = world.lib.world_now
        self._now = world.now
        self._receivers: dict[int, Callable[[], None]] = {}
        self.before_advance: Callable[[float], None] = _nothing
        self.alarm_s = math.inf  # at this world time, or as soon as the host waits after it ...
        self.on_alarm: Callable[[], None] = lambda: None  # ... this is called; it sets the next one
        self.world_wall_s = 0.0  # real time spent in the world; the rest of a run is the host's
        self._late_s, self._pause_s, self._random = 0.0, math.inf, random.Random()

    def make_late(self, late_s: float, seed: int) -> None:
        """From now on the host does nothing for up to so long, again and again, at random times."""
        self._random.seed(seed)
        self._late_s, self._pause_s = late_s, self._now if late_s else math.inf

    def monotonic(self) -> float:
        """World time, s."""
        return self._now

    def wait(self, until: float, poll: FdPoll) -> None:
        """Let the world run to `until`, or until a message or a file descriptor wants the host."""
        now = self._now
        if until <= now or poll.poll(0.0):
            return
        self.before_advance(now)
        pointer = self._world.pointer
        entered = time.perf_counter()
        if now < self._pause_s:
            end = min(until, now + MAX_STRETCH_S)
            if self.alarm_s < end:
                end = max(self.alarm_s, now)
            waiting = self._advance(pointer, end)
        else:
            waiting = self._sleep(now)
        self.world_wall_s += time.perf_counter() - entered
        self._now = self._read_now(pointer)
        while self._now >= self.alarm_s:
            self.on_alarm()
        if waiting:
            for mcu, receive in list(self._receivers.items()):
                if waiting >> mcu & 1:
                    receive()

    def _sleep(self, now: float) -> int:
        """A late host: what arrives meanwhile has to wait."""
        end, waiting = now + self._random.uniform(0.0, self._late_s), 0
        while self._read_now(self._world.pointer) < end:
            waiting |= self._advance(self._world.pointer, end)
        self._pause_s = end + self._random.expovariate(1.0 / AWAKE_S)
        return waiting

    def stall(self, until: float, resumes: bool = True) -> None:
        """The host stands still while time goes on: no byte from it, none taken by it."""
        self._world.lib.world_stall_host(self._world.pointer, until if resumes else math.inf)
        while self._now < until:
            self._advance(self._world.pointer, min(until, max(self.alarm_s, self._now)))
            self._now = self._read_now(self._world.pointer)
            while self._now >= self.alarm_s:
                self.on_alarm()

    def set_receiver(self, mcu: int, receive: Callable[[], None] | None) -> None:
        """Call `receive` when messages of the MCU wait for the host."""
        if receive is None:
            self._receivers.pop(mcu, None)
        else:
            self._receivers[mcu] = receive


def _nothing(now: float) -> None:
    pass
