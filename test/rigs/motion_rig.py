"""For the motion tests: the C helper driven directly, the real printer in batch mode, and a reader of step commands.

Nothing here shares code with what it checks: commands are decoded and positions computed on their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import chelper
import msgproto
from batch_messages import (
    CLOCK_HZ,
    MAX_ERROR_S,
    QUEUE_STEP,
    RESET_CLOCK,
    SET_DIR,
    batch_args,
    decode,
    dictionary,
)
from printer import Printer
from reactor import Reactor

FFI, LIB = chelper.get_ffi()

# ---- step commands ----


@dataclass
class StepTrace:
    """The steps of one stepper as its MCU would make them."""

    clock: int = 0
    position: int = 0
    direction: int | None = None
    clocks: list[int] = field(default_factory=list)  # of each step, 64 bit
    positions: list[int] = field(default_factory=list)  # after each step
    commands: int = 0
    rebases: int = 0
    intervals_ok: bool = True

    def feed(self, params: dict[str, Any]) -> None:
        name = params["#name"]
        if name == "set_next_step_dir":
            self.direction = params["dir"]
        elif name == "reset_step_clock":
            self.rebases += 1
            self.clock += (params["clock"] - self.clock) & 0xFFFFFFFF
        elif name == "queue_step":
            self._run(params["interval"], params["count"], params["add"])

    def _run(self, interval: int, count: int, add: int) -> None:
        assert self.direction is not None, "a queue_step before the first set_next_step_dir"
        assert count > 0
        self.commands += 1
        for _ in range(count):
            self.intervals_ok &= 0 < interval < 2**32
            self.clock += interval
            interval += add
            self.position += 1 if self.direction else -1
            self.clocks.append(self.clock)
            self.positions.append(self.position)


# ---- the C helper directly ----


class CStepper:
    """trapq → solver → compressor of one stepper."""

    def __init__(
        self, step_dist: float = 0.0125, clock_hz: float = CLOCK_HZ, solver: Any = None, invert: bool = False
    ) -> None:
        self.clock_hz, self.step_dist = clock_hz, step_dist
        self.trapq = FFI.gc(LIB.trapq_alloc(), LIB.trapq_free)
        self.sc = FFI.gc(LIB.stepcompress_alloc(5), LIB.stepcompress_free)
        LIB.stepcompress_setup(self.sc, int(MAX_ERROR_S * clock_hz), QUEUE_STEP, SET_DIR, RESET_CLOCK)
        LIB.stepcompress_set_invert_dir(self.sc, invert)
        self.sk = FFI.gc(solver or LIB.cartesian_stepper_alloc(b"x"), LIB.itersolve_free)
        LIB.itersolve_set_stepcompress(self.sk, self.sc, step_dist)
        LIB.itersolve_set_trapq(self.sk, self.trapq)
        self.trace = StepTrace()
        self.messages: list[tuple[int, int]] = []  # (min_clock, req_clock)
        self._failed = FFI.new("int *")

    def open(self, places: int = 1000) -> None:
        self.sync = FFI.gc(LIB.steppersync_alloc(places), LIB.steppersync_free)
        LIB.steppersync_add_stepper(self.sync, self.sc)
        LIB.steppersync_set_kinematics(self.sync, 0, self.sk)
        LIB.steppersync_set_time(self.sync, 0.0, self.clock_hz)

    def run(self, until: float, flush_until: float | None = None) -> None:
        assert LIB.steppersync_generate(self.sync, until, self._failed) == 0
        clock = 2**63 if flush_until is None else max(0, int(flush_until * self.clock_hz))
        message = LIB.steppersync_flush(self.sync, clock, 0, self._failed)
        assert self._failed[0] == -1
        contents = []
        head = message
        while message:
            contents.append(bytes(FFI.buffer(message.data, message.len)))
            self.messages.append((message.min_clock, message.req_clock))
            message = message.next
        LIB.message_free_list(head)
        for params in decode(contents, self.clock_hz):
            self.trace.feed(params)

    def step_times(self) -> np.ndarray:
        return np.array(self.trace.clocks) / self.clock_hz


@dataclass(frozen=True)
class Trapezoid:
    """A move for trapq_append, with its own arithmetic."""

    time: float
    accel_t: float
    cruise_t: float
    decel_t: float
    start: float
    ratio: float
    start_v: float
    cruise_v: float
    accel: float

    @property
    def end_time(self) -> float:
        return self.time + self.accel_t + self.cruise_t + self.decel_t

    @property
    def distance(self) -> float:
        end_v = self.cruise_v - self.accel * self.decel_t
        return (
            (self.start_v + self.cruise_v) / 2 * self.accel_t
            + self.cruise_v * self.cruise_t
            + (self.cruise_v + end_v) / 2 * self.decel_t
        )

    @property
    def end(self) -> float:
        return self.start + self.ratio * self.distance

    def append(self, trapq: Any, flag: float = 0.0) -> None:
        LIB.trapq_append(
            trapq, self.time, self.accel_t, self.cruise_t, self.decel_t,
            self.start, 0.0, 0.0, self.ratio, flag, 0.0, self.start_v, self.cruise_v, self.accel,
        )  # fmt: skip

    def velocity(self, t: np.ndarray) -> np.ndarray:
        """d(position)/dt at times inside the move."""
        up = self.start_v + self.accel * np.minimum(t - self.time, self.accel_t)
        down = np.maximum(t - self.time - self.accel_t - self.cruise_t, 0.0)
        return self.ratio * (up - self.accel * down)

    def position(self, t: np.ndarray) -> np.ndarray:
        tau = np.clip(t - self.time, 0.0, self.end_time - self.time)
        t1 = np.minimum(tau, self.accel_t)
        t2 = np.clip(tau - self.accel_t, 0.0, self.cruise_t)
        t3 = np.maximum(tau - self.accel_t - self.cruise_t, 0.0)
        d = self.start_v * t1 + self.accel * t1**2 / 2 + self.cruise_v * (t2 + t3) - self.accel * t3**2 / 2
        return self.start + self.ratio * d


def from_rest(time: float, start: float, distance: float, speed: float, accel: float) -> Trapezoid:
    """A move that begins and ends at rest."""
    top = min(speed, math.sqrt(abs(distance) * accel))
    ramp = top / accel
    cruise = abs(distance) / top - ramp
    return Trapezoid(time, ramp, max(0.0, cruise), ramp, start, math.copysign(1.0, distance), 0.0, top, accel)


def path(moves: Sequence[Trapezoid], t: np.ndarray) -> np.ndarray:
    """Position of a row of moves at any times; at rest between them."""
    starts = np.array([m.time for m in moves])
    index = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(moves) - 1)
    result = np.empty_like(t)
    for number in np.unique(index):
        mask = index == number
        result[mask] = moves[number].position(t[mask])
    return result


# ---- the real printer in batch mode ----

CONFIG = """
[mcu]
serial: /dev/null
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
max_z_velocity: 10
max_z_accel: 100
[stepper_x]
step_pin: PA0
dir_pin: PA1
enable_pin: !PA2
microsteps: 16
rotation_distance: 40
endstop_pin: ^PA3
position_endstop: 0
position_max: 200
homing_speed: 50
[stepper_y]
step_pin: PB0
dir_pin: !PB1
microsteps: 16
rotation_distance: 40
endstop_pin: ^PB3
position_endstop: 200
position_max: 200
homing_speed: 50
[stepper_z]
step_pin: PC0
dir_pin: PC1
microsteps: 16
rotation_distance: 8
endstop_pin: ^PC3
position_endstop: 0.5
position_max: 200
homing_speed: 8
"""
EXTRUDER = """
[extruder]
step_pin: PD0
dir_pin: PD1
microsteps: 16
rotation_distance: 33.5
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: PD4
sensor_type: EPCOS 100K B57560G104F
sensor_pin: PD5
control: watermark
min_temp: 0
max_temp: 250
"""


@dataclass
class BatchResult:
    """Outcome of a batch run."""

    result: str
    message: str
    replies: list[str]
    commands: list[dict[str, Any]]
    printer: Any

    def traces(self) -> dict[str, StepTrace]:
        """Steps by stepper name."""
        steppers = {
            s.get_oid(): name for name, s in self.printer.lookup_object("force_move").steppers.items()
        }
        traces = {name: StepTrace() for name in steppers.values()}
        for params in self.commands:
            if params["#name"] in ("queue_step", "set_next_step_dir", "reset_step_clock"):
                traces[steppers[params["oid"]]].feed(params)
        return traces


def batch(
    folder: Path, gcode: str, config: str = CONFIG, clock_hz: float = CLOCK_HZ, **files: str
) -> BatchResult:
    """Run G-code as `klippy.py CONFIG -i GCODE -o OUT -d DICT` does, in this process."""
    (folder / "printer.cfg").write_text(config)
    (folder / "in.gcode").write_text(gcode)
    (folder / "dict").write_bytes(dictionary(clock_hz))
    reactor = Reactor()
    printer = Printer(reactor, {**batch_args(folder), **files})
    replies: list[str] = []
    printer.lookup_object("gcode").register_output_handler(replies.append)
    result = printer.run()
    message = printer.get_state_message()[0]
    reactor.finalize()
    commands: list[dict[str, Any]] = []
    out = folder / "out"
    if out.exists():
        blocks = msgproto.BlockReader().feed(out.read_bytes())
        commands = decode([block.content for block in blocks if block is not None], clock_hz)
    return BatchResult(result, message, replies, commands, printer)
