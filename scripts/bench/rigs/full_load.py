"""Everything at once on the STM32F334 image: a print in closed loop with the plant, one more axis at 50,000 steps/s.

The host is the product's own. The chip's model writes down every sample its converter was given and every change of
its bridge; the host's end of the wire writes down what was commanded and every block that came back. Beside the print
(four motors, closed loop heating, 120 kHz sampling) a further motor makes TRAVEL_HZ pulses a second for `seconds`.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from block_codec import Row, unpack
from extras.induction.mcu import BLOCK_FORMAT
from simulation.emulator import Emulator, Recording
from simulation.runner import Outcome, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ROOT / "config" / "sim-f334.cfg"
SPINNER = """
[manual_stepper spinner]
step_pin: PB10
dir_pin: PB11
microsteps: 16
rotation_distance: 3.2
velocity: 50
accel: 5000

[simulator axis spinner]
section: manual_stepper spinner
position_min: -10
position_max: 10000
start_position: 0
"""
TRAVEL_HZ = 50_000  # 50 mm/s at 1000 steps/mm
TARGET_C = 250.0
WARM_UP_S = 12.0  # of recording: start, homing, heating; generous
PERIOD = 600  # ticks
TRIGGER = 2  # ticks from a period's edge, whose clock a record has, to the sample
FULL_LAG, FULL_PHASE = 19200, 45000  # 180 degrees: steps of HRTIM, units of the wire
SOON = 7200  # ticks, 100 us: a change of the phase that is due has been made
OFF = 48 * PERIOD + SOON  # the board's test of the bridge: off for that long, and late by an interrupt
PLAN_STEP = struct.Struct("<HH")


@dataclass
class Load:
    """What came of it. All clocks are the firmware's, which does not wrap within a run."""

    outcome: Outcome = field(default_factory=lambda: Outcome(1, "", {}))
    blocks: list[tuple[int, Row]] = field(default_factory=list)  # clock of the first sample
    block_len: int = 0
    shift: int = 0  # a record's value is its sum shifted right by so much
    plans: list[tuple[int, list[tuple[int, int]]]] = field(default_factory=list)  # sent at; clock, phase
    sample_clocks: Any = None
    samples: Any = None
    lags: list[tuple[int, int]] = field(default_factory=list)  # clock, steps of HRTIM between the legs
    looks: list[tuple[float, dict[str, int], float]] = field(
        default_factory=list
    )  # s; axis → steps; nozzle, C
    counters: dict[str, Any] = field(default_factory=dict)

    def sum_of(self, clock: int, count: int) -> tuple[int, int, int] | None:
        """Sum, lowest and highest of the samples given from `clock` on; None if they were not all recorded."""
        first = int(np.searchsorted(self.sample_clocks, clock + TRIGGER))
        last = first + count - 1
        if last >= len(self.samples) or self.sample_clocks[first] != clock + TRIGGER:
            return None
        if self.sample_clocks[last] - self.sample_clocks[first] != (count - 1) * PERIOD:
            return None
        part = self.samples[first : last + 1]
        return int(part.sum()), int(part.min()), int(part.max())

    def commanded(self, clock: int) -> set[int]:
        """Phases that may be in force at a clock: of the newest plan that had begun, or of the one before it, which
        holds until the newer has come."""
        begun = [plan for sent, plan in self.plans if sent < clock and plan[0][0] <= clock]
        return {plan[bisect_right([at for at, _ in plan], clock) - 1][1] for plan in begun[-2:]}

    def spinning(self) -> list[tuple[float, dict[str, int], float]]:
        """The looks between which the spinner turned at its full speed."""
        made = [look for look in self.looks if look[1].get("spinner")]
        whole = made[-1][1]["spinner"]
        return [look for look in made if 0.02 * whole < look[1]["spinner"] < 0.98 * whole]


def part(seconds: float) -> str:
    """Home, heat, start the spinner for `seconds`, print squares for as long."""
    distance = 50.0 * seconds
    lines = ["G28", f"M109 S{TARGET_C:g}", "G90", "M83", "G1 Z0.3 F600", "G1 X60 Y60 F9000", "M106 S128"]
    lines += ["MANUAL_STEPPER STEPPER=spinner ENABLE=1 SET_POSITION=0", "M400"]
    lines.append(f"MANUAL_STEPPER STEPPER=spinner MOVE={distance:g} SPEED=50 SYNC=0")
    turn, length_s = 0, 40.0 / 60.0  # a square of 4 x 10 mm at 60 mm/s
    while turn * length_s < seconds:
        low, high = 60.0, 70.0
        lines.append(f"G1 Z{0.3 + 0.02 * turn:.2f} F600")
        for x, y in ((high, low), (high, high), (low, high), (low, low)):
            lines.append(f"G1 X{x:g} Y{y:g} E0.33 F3600")
        turn += 1
    return "\n".join([*lines, "M400"]) + "\n"


class FullLoad(Simulation):
    """Prints, and records."""

    def __init__(self, folder: Path, seconds: float) -> None:
        config, gcode = folder / "full.cfg", folder / "full.gcode"
        config.write_text(CONFIG.read_text() + SPINNER)
        gcode.write_text(part(seconds))
        super().__init__(RunOptions(config, gcode, builds={"mcu": "stm32f334"}))
        self.seconds = seconds
        self.load = Load()
        self._recordings: dict[str, Recording] = {}
        self._before: dict[str, int] = {}

    def _open_port(self, reactor: Any, path: str, baud: int) -> Any:
        port = super()._open_port(reactor, path, baud)
        assert self.machine is not None
        self.chip = Emulator(self.world, self.machine.mcus["mcu"])
        capacity = round((WARM_UP_S + self.seconds) * 1.5 * 120_000)
        self._recordings["samples"] = self.chip.record("samples", capacity)
        self._recordings["lags"] = self.chip.record("lags", 100_000)
        return port

    def _wait_ready(self) -> bool:
        ready = super()._wait_ready()
        if ready:
            unit = self.printer.lookup_object("heaters").lookup_heater("extruder").unit
            self.load.block_len, self.load.shift = unit.settings.block_samples, unit.settings.oversample
            self._listen(unit)
        return ready

    def _listen(self, unit: Any) -> None:
        """Between the heater and its wire."""
        send_plan, load = unit._queue_plan.send, self.load

        def send(data: list[Any], **options: Any) -> None:
            at, steps = data[1], []
            for periods, phase in PLAN_STEP.iter_unpack(data[2]):
                at += periods * PERIOD
                steps.append((at, phase))
            load.plans.append((self.chip.peek("tim2.count"), steps))
            send_plan(data, **options)

        take_batch, unpack_message = unit._take_batch, unit.mcu._serial._unpack

        def take(messages: Any, count: int) -> None:
            for message in messages[0:count]:
                params = unpack_message(message)[1]
                for row in unpack(bytes(params["data"]), load.block_len):
                    load.blocks.append((params["clock"] + row.offset * PERIOD, row))
            take_batch(messages, count)

        unit._queue_plan.send, unit._take_batch = send, take
        unit.mcu.register_batch(take, BLOCK_FORMAT)

    def _pause(self) -> bool:
        going = super()._pause()
        if self.machine is not None:
            steps = {
                name: self.world.axis(index)["steps_forward"] for name, index in self.machine.axes.items()
            }
            nozzle_c = float(self.world.lib.world_nozzle_temperature(self.world.pointer, 0))
            self.load.looks.append((self.world.now, steps, nozzle_c))
        return going

    def _finish(self) -> Outcome:
        if self.machine is not None:
            load, chip = self.load, self.chip
            offset = chip.peek("ticks") - chip.peek("tim2.count")
            load.counters = chip.counters()
            clocks, codes = self._recordings["samples"].arrays()
            load.sample_clocks = (np.asarray(clocks).astype(np.int64) - offset) & 0xFFFFFFFF
            load.samples = np.asarray(codes).astype(np.int64)
            clocks, lags = self._recordings["lags"].arrays()
            load.lags = [
                ((clock - offset) & 0xFFFFFFFF, lag) for clock, lag in zip(clocks, lags, strict=True)
            ]
        return super()._finish()


def play(folder: Path, seconds: float) -> Load:
    """The whole run; the spinner turns for `seconds`."""
    run = FullLoad(folder, seconds)
    run.load.outcome = run.run()
    return run.load


def check_blocks(load: Load) -> int:
    """Every block's sum, lowest and highest against what the converter was given; returns how many were compared."""
    checked = 0
    for clock, row in load.blocks:
        truth = load.sum_of(clock, row.count)
        assert truth is not None, f"a block at {clock} covers samples that were never taken"
        assert (row.value, row.low, row.high) == (truth[0] >> load.shift, truth[1], truth[2]), f"at {clock}"
        checked += 1
    return checked


def check_continuity(load: Load) -> None:
    """No sample lost, none reported twice: a block begins where the one before ends, discarded samples included."""
    assert len(load.blocks) > 1
    for (clock, row), (after, following) in zip(load.blocks, load.blocks[1:], strict=False):
        assert row.lost == following.lost == 0
        assert after == clock + (row.count + following.discarded) * PERIOD
    assert load.counters["samples_lost"] == 0


def lag_of(phase: int) -> int:
    """Compare steps for a phase, to the nearest."""
    return (phase * FULL_LAG + FULL_PHASE // 2) // FULL_PHASE


def check_phases(load: Load) -> int:
    """The legs lag by what is commanded: whenever they change, and soon after every change that was due; how many.
    Off for a test they may be at any time."""
    tests = {a for (a, lag), (b, _) in pairwise(load.lags) if not lag and b - a <= OFF}
    begin = load.plans[0][1][0][0]
    changes = [(clock, lag) for clock, lag in load.lags if clock > begin]
    at = [clock for clock, _ in load.lags]
    due = {clock for _, plan in load.plans for clock, _ in plan if clock < at[-1]}
    looks = [(clock + SOON, load.lags[bisect_right(at, clock + SOON) - 1][1]) for clock in sorted(due)]
    for clock, lag in changes + looks:
        allowed = {lag_of(phase) for phase in load.commanded(clock)}
        if at[bisect_right(at, clock) - 1] in tests:
            allowed.add(0)
        assert lag in allowed, f"at {clock} the legs lag by {lag}, commanded are {allowed}"
    return len(changes)
