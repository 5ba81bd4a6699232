"""A print with a temperature plan in this process, watched: what the plan emits, path, faults, bytes on the wire."""

from __future__ import annotations

import gc
import hashlib
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import chelper
from extras import temperature_plan
from simulation import simport
from simulation.runner import Outcome, RunOptions, Simulation
from thermal.control.control_api import Reference

FILAMENT_MM2 = math.pi / 4.0 * 1.75**2


# Nothing decides but what is asked for by name.
SECTION = """
[temperature_plan]
material: PLA
bonding: no
melt_min: 190
melt_max: 240
"""


@dataclass(frozen=True, slots=True)
class Emitted:
    """What the heater was given: the plan's reference, or the user's own target; times are print times, s."""

    now_s: float
    corners: list[tuple[float, float]]
    by_user: bool


@dataclass(frozen=True, slots=True)
class Road:
    """Part of a move (speeding up, cruise, braking) as the look-ahead gave it out."""

    start_s: float
    end_s: float
    flow_mm3_s: float  # 0: nothing is extruded


@dataclass(slots=True)
class Watched:
    """All of one print."""

    emitted: list[Emitted] = field(default_factory=list)
    roads: list[Road] = field(default_factory=list)
    ahead_s: list[float] = field(default_factory=list)  # how far ahead of the machine moves were given out
    log: list[logging.LogRecord] = field(default_factory=list)
    outcome: Outcome | None = None
    planner: Any = None
    stalls: int = 0
    sent: str = ""  # hash of all bytes to the MCU

    @property
    def tracebacks(self) -> list[str]:
        return [record.getMessage() for record in self.log if record.exc_info]


class _Log(logging.Handler):
    def __init__(self, records: list[logging.LogRecord]) -> None:
        super().__init__(logging.INFO)
        self._records = records

    def emit(self, record: logging.LogRecord) -> None:
        self._records.append(record)


def _watch_planner(watched: Watched, patch: pytest.MonkeyPatch) -> None:
    ready = temperature_plan.TemperaturePlanner._on_ready

    def on_ready(self: Any) -> None:
        watched.planner = self
        loop = self.heater.loop
        give, set_user = loop.set_reference, loop.set_target

        def set_reference(points: Sequence[tuple[float, float]], now_s: float) -> Any:
            known = Reference.of(points) if points else None
            corners = [(now_s, loop.state.target_c)]
            if known is not None:
                corners = list(zip(known.times_s, known.temps_c, strict=True))
            watched.emitted.append(Emitted(now_s, corners, by_user=known is None))
            return give(points, now_s)

        def set_target(target_c: float, now_s: float) -> Any:
            if target_c != loop.state.target_c:
                watched.emitted.append(Emitted(now_s, [(now_s, target_c)], by_user=True))
            return set_user(target_c, now_s)

        patch.setattr(loop, "set_reference", set_reference)
        patch.setattr(loop, "set_target", set_target)
        ready(self)

    patch.setattr(temperature_plan.TemperaturePlanner, "_on_ready", on_ready)


def _roads(move: Any) -> Iterator[Road]:
    """Its phases; the extruder alone deposits nothing."""
    deposits = move.is_kinematic_move and move.axes_d[3] > 0.0
    mm3_per_mm = move.axes_d[3] / move.move_d * FILAMENT_MM2 if deposits else 0.0
    time_s = move.print_time
    for duration_s, speed in (
        (move.accel_t, 0.5 * (move.start_v + move.cruise_v)),
        (move.cruise_t, move.cruise_v),
        (move.decel_t, 0.5 * (move.cruise_v + move.end_v)),
    ):
        if duration_s > 0.0:
            yield Road(time_s, time_s + duration_s, speed * mm3_per_mm)
        time_s += duration_s


def _watch_path(watched: Watched, patch: pytest.MonkeyPatch) -> None:
    wait = Simulation._wait_ready

    def wait_ready(self: Simulation) -> bool:
        if not wait(self):
            return False
        toolhead = self.printer.lookup_object("toolhead")

        def note(moves: Sequence[Any]) -> None:
            now_s = toolhead.mcu.estimated_print_time(self.reactor.monotonic())
            for move in moves:
                watched.roads += _roads(move)
            watched.ahead_s.append(moves[0].print_time - now_s)

        toolhead.register_move_listener(note)
        return True

    patch.setattr(Simulation, "_wait_ready", wait_ready)


def _watch_wire(digest: Any, patch: pytest.MonkeyPatch) -> list[Any]:
    """What the serial queue sends goes through here, with its time. The list keeps the callback alive."""
    ffi, lib = chelper.get_ffi()

    @ffi.callback("int(struct serialqueue *, uint8_t *, int, double, double *)")  # type: ignore[untyped-decorator]
    def transmit(queue: Any, out: Any, capacity: int, now: float, next_wake: Any) -> int:
        count = int(lib.serialqueue_transmit(queue, out, capacity, now, next_wake))
        if count:
            digest.update(b"%.9f " % now + bytes(ffi.buffer(out, count)))
        return count

    class Lib:
        serialqueue_receive = lib.serialqueue_receive
        serialqueue_transmit = transmit

    class Ffi:
        cast = staticmethod(ffi.cast)

        @staticmethod
        def addressof(where: Any, name: str) -> Any:
            return transmit if name == "serialqueue_transmit" else ffi.addressof(lib, name)

    class Helper:
        @staticmethod
        def get_ffi() -> tuple[Any, Any]:
            return Ffi, Lib

    patch.setattr(simport, "chelper", Helper)
    return [transmit]


def watch(config: Path, gcode: Path, until_s: float = 400.0, seed: int = 1, wire: bool = False) -> Watched:
    """Print it on the simulated printer; `wire`: hash what is sent, which takes time."""
    watched = Watched()
    handler, logger, threshold = _Log(watched.log), logging.getLogger(), gc.get_threshold()
    level, digest, keep = logger.level, hashlib.sha256(), []
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        with pytest.MonkeyPatch.context() as patch:
            _watch_planner(watched, patch)
            if wire:
                keep = _watch_wire(digest, patch)
            else:
                _watch_path(watched, patch)
            simulation = Simulation(RunOptions(config, gcode, seed, until_s=until_s))
            watched.outcome = simulation.run()
            printer = simulation.printer
            watched.stalls = printer.lookup_object("toolhead").print_stall
            watched.sent = digest.hexdigest()
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        gc.set_threshold(*threshold)
        gc.unfreeze()
        del keep
    return watched
