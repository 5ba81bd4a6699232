"""The calibration run: which phase when, what is recorded, and when to stop. Pure; decides, does not act.

Temperature cannot jump, the drive can: while the nozzle slowly heats, the bridge visits one power after
another for a few milliseconds each, with stretches at the minimum phase in between. So every power sees every
temperature, and the temperature at a visit lies between those of the stretches before and after it:

    phase  ___|‾‾|______|‾‾|______|‾‾|______      visits: 10, 20 ... 100 %, then again
            low  10 %  low  20 %  low  30 %       stretches are as long as makes the mean power right

Then it cools with the bridge off, short looks at the minimum phase and a visit now and then. Cooling against heating
gives the reference sensor's lag (fit_sweep.py).
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import fmean
from typing import TextIO

from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.records import PHASE_MAX_TICKS, PhaseCommand
from thermal.sensing import features
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS
from thermal.sensing.blocks import Blocks

from .run import DONE, Run

COLUMNS = ("t_s", "temp_ref_c", "error", "phase_ticks", "count", "duration_s")
READING_MARK = "# reference,"  # before a reading as it came; the column is interpolated
REST, WAIT, HEAT, COOL = "rest", "wait", "heat", "cool"  # stages; DONE follows
# A bridge whose dead time is as long as the pulse of a phase drives no current, and little if it is almost as long.
# Then the next phase is taken. At weak drive the signal is nearly linear in the phase. 200 ns of dead time move that of
# the smallest phase by 60 units away from the line through two larger ones, 120 ns by 20.
LOW_PHASES_TICKS = (SENSING_PHASE_TICKS, 4025)  # 0.2 and 0.8 % of full power
LINE_TICKS = (4025, 7115)
LINE_LOOKS = 10  # at each of them
LINE_UNITS = 30.0
POWERS_PERCENT = (1.0, 2.5, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0)


def ticks_of_percent(percent: float) -> int:
    return round(PHASE_MAX_TICKS * math.sqrt(percent / 100.0))


@dataclass(frozen=True, slots=True)
class SweepParameters:
    """One run; powers are those of the drive law in use, only roughly right before a calibration."""

    front: features.FeatureParameters
    law: DriveLaw
    temp_max_c: float  # of the reference, its lag allowed for
    powers_percent: tuple[float, ...] = POWERS_PERCENT
    heat_w: float = 14.0  # mean: 10-30 K/s on the reference nozzle
    rest_s: float = 4.0  # at the start: a look at the nozzle as it is
    warm_c: float = 35.0  # a nozzle above this, ...
    still_c: float = 0.5  # ... or one that falls by more than this at rest, is left to cool ...
    still_s: float = 15.0  # ... until it falls by less within this time
    heat_s: float = 90.0  # at most
    cool_to_c: float = 60.0
    cool_s: float = 75.0  # at most
    lag_s: float = 1.5  # of the reference, until it is known: heating stops this time ahead
    visit_s: float = 0.0062  # settling and some 700 samples
    look_s: float = 0.0038
    pause_s: float = 0.045  # bridge off between looks while cooling
    phase_low_ticks: int = SENSING_PHASE_TICKS  # of the looks; more, if it shows nothing
    lead_s: float = 0.015
    ahead_s: float = 0.035  # commands are sent this far ahead at most
    refresh_s: float = 0.030  # longest phase without a new command
    silence_s: float = 0.5
    reference_s: float = 3.0  # longest silence of the reference
    contact_s: float = 6.0  # within this time of heating the reference must rise ...
    contact_c: float = 8.0  # ... by this much, or the heat goes elsewhere
    balance_share: float = 0.6  # unless this share of the heat is what the nozzle loses anyway


@dataclass(slots=True)
class Recording:
    """What a run brought: blocks as (centre s, signal units, phase, count, duration s) and (s, degC) of the reference.

    Blocks with the bridge off are there too, with error 0: they show how long it was off.
    """

    blocks: list[tuple[float, float, int, int, float]] = field(default_factory=list)
    reference: list[tuple[float, float]] = field(default_factory=list)


class Sweep(Run):
    """One run. Feed it blocks, reference readings and time; it gives commands until it is over."""

    poll_s = 0.020  # of the reference sensor
    progress_s = 5.0
    timeout_s = math.inf  # it watches blocks and reference itself: the law in use may have no reading here

    def __init__(self, parameters: SweepParameters, now_s: float) -> None:
        super().__init__(REST)
        self.parameters = parameters
        self.recording = Recording()
        self.started_s = self.stage_s = self._watched_s = now_s
        self._low_ticks = parameters.phase_low_ticks
        self._received_s = now_s  # last blocks
        self._next_s = now_s + parameters.lead_s
        self._plan: Iterator[tuple[int, float]] = self._rest()
        self._at_rest: dict[int, list[float]] = {}  # signals by phase
        self._has_waited = False  # for a warm nozzle to cool
        self._rise = (now_s, -math.inf)  # when the reference had risen enough, and to what
        self._levels = itertools.cycle([ticks_of_percent(p) for p in parameters.powers_percent])

    def progress(self, temp_c: float) -> str:
        readings = self.recording.reference
        shown = f"{readings[-1][1]:.1f} C" if readings else "no reading yet"
        stage = (
            "the nozzle is warm, wait until it is as cold as the room" if self.stage == WAIT else self.stage
        )
        return f"{stage} for {self._watched_s - self.stage_s:.0f} s, reference {shown}"

    @property
    def target_c(self) -> float:
        """Where it heats to."""
        return self.parameters.temp_max_c if self.stage in (WAIT, REST, HEAT) else 0.0

    def write(self, stream: TextIO) -> None:
        """The readings as they came, then the blocks with the reference interpolated to them."""
        readings = self.recording.reference
        for read_s, shown_c in readings:
            stream.write(f"{READING_MARK}{read_s:.6f},{shown_c:.4f}\n")
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        at = 0
        for time_s, error, phase, count, duration_s in self.recording.blocks:
            while at + 1 < len(readings) and readings[at + 1][0] <= time_s:
                at += 1
            if not readings or not readings[0][0] <= time_s < readings[-1][0]:
                continue
            (t0, c0), (t1, c1) = readings[at], readings[at + 1]
            shown_c = c0 + (c1 - c0) * (time_s - t0) / (t1 - t0)
            writer.writerow(
                (f"{time_s:.6f}", f"{shown_c:.3f}", f"{error:.4f}", phase, count, f"{duration_s:.7f}")
            )

    # Input

    def reference(self, time_s: float, temp_c: float) -> None:
        """A reading of the reference sensor, with the time it was taken."""
        self.recording.reference.append((time_s, temp_c))

    def on_blocks(self, blocks: Blocks, now_s: float) -> list[PhaseCommand]:
        record = self.recording
        if blocks:
            self._received_s = now_s
        for seen, block in zip(features.extract(self.parameters.front, blocks), blocks, strict=True):
            if self.over:
                break
            if seen.phase_ticks and seen.fault and not self._is_raised(seen.phase_ticks):
                self.abort(f"{seen.fault} at {100.0 * seen.power_fraction:.1f} % power")
                break
            if 0 < seen.phase_ticks < self._low_ticks:
                continue
            if seen.phase_ticks and self.stage in (REST, WAIT):
                self._at_rest.setdefault(seen.phase_ticks, []).append(seen.signal_units)
                if seen.phase_ticks > self._low_ticks:
                    continue
            error = seen.signal_units if seen.phase_ticks else 0.0
            record.blocks.append((seen.time_s, error, seen.phase_ticks, seen.count, block.duration_s))
        return self.on_timer(now_s)

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        """Watch the limits, change the stage, and send the commands that are due."""
        self._watch(now_s)
        if self.over:
            return self._off(now_s)
        commands = []
        while self._next_s < now_s + self.parameters.lead_s + self.parameters.ahead_s:
            start_s = max(self._next_s, now_s + self.parameters.lead_s)
            phase, duration_s = next(self._plan)
            commands.append(PhaseCommand(start_s, phase, self.parameters.law.power_w(phase)))
            self._next_s = start_s + duration_s
        return commands

    def _off(self, now_s: float) -> list[PhaseCommand]:
        if self._next_s == math.inf:
            return []
        at_s = max(self._next_s, now_s + self.parameters.lead_s)
        self._next_s = math.inf
        return [PhaseCommand(at_s, 0, 0.0)]

    # Deciding

    def _slope_c_s(self) -> float:
        readings = self.recording.reference[-4:]
        if len(readings) < 2 or readings[-1][0] <= readings[0][0]:
            return 0.0
        return (readings[-1][1] - readings[0][1]) / (readings[-1][0] - readings[0][0])

    def _enter(self, stage: str, plan: Iterator[tuple[int, float]], now_s: float) -> None:
        self.stage, self.stage_s, self._plan = stage, now_s, plan

    def _watch(self, now_s: float) -> None:
        p, record = self.parameters, self.recording
        self._watched_s = now_s
        if self.over:
            return
        if now_s - self._received_s > p.silence_s:
            self.abort("no samples from the induction unit")
            return
        read_s = record.reference[-1][0] if record.reference else self.started_s
        if now_s - read_s > p.reference_s:
            self.abort(f"the reference sensor has sent no reading for {now_s - read_s:.1f} s")
            return
        if not record.reference:
            return
        self._change_stage(now_s, record.reference[-1][1])

    def _change_stage(self, now_s: float, temp_c: float) -> None:
        p = self.parameters
        since_s = now_s - self.stage_s
        if temp_c > p.temp_max_c + 60.0:
            self.abort(f"the reference reads {temp_c:.0f} C, far above the limit of this run")
        elif self.stage == REST and since_s >= p.rest_s:
            self._rise = (now_s, temp_c)
            if self._is_beside_line():
                self._raise_low()
            elif self._is_warm(temp_c):
                self._enter(WAIT, self._rest(), now_s)
            else:
                self._enter(HEAT, self._heat(), now_s)
        elif self.stage == WAIT and self._has_cooled(now_s):
            self._has_waited = True
            self.recording.blocks.clear()  # the run begins here
            del self.recording.reference[:-1]
            self._enter(REST, self._rest(), now_s)
        elif self.stage == HEAT:
            if self._stalled(now_s, temp_c):
                lost_w = heat_loss.loss_w(heat_loss.LossLaw(), temp_c)
                if lost_w > p.balance_share * p.heat_w:
                    self._enter(COOL, self._cool(), now_s)  # as hot as this power makes it
                    return
                self.abort(
                    f"the reference rose by only {temp_c - self._rise[1]:.1f} C in {p.contact_s:.0f} s of heating:"
                    " does it touch the nozzle, and is the nozzle in the coil?"
                )
            elif temp_c + p.lag_s * self._slope_c_s() >= p.temp_max_c or since_s >= p.heat_s:
                self._enter(COOL, self._cool(), now_s)
        elif self.stage == COOL and (temp_c <= p.cool_to_c or since_s >= p.cool_s):
            self.stage = DONE

    def _is_raised(self, phase_ticks: int) -> bool:
        """A look at rest shows no signal: does a larger phase take its place?"""
        if phase_ticks == self._low_ticks:
            if self.stage != REST or phase_ticks == LOW_PHASES_TICKS[-1]:
                return False
            self._raise_low()
        return phase_ticks < self._low_ticks  # commands of before are under way

    def _raise_low(self) -> None:
        self._low_ticks = min(ticks for ticks in LOW_PHASES_TICKS if ticks > self._low_ticks)
        self._enter(REST, self._rest(), self._watched_s)
        self.recording.blocks.clear()

    def _is_beside_line(self) -> bool:
        """Does the dead time take most of the smallest phase's pulse?"""
        low, (near, far) = LOW_PHASES_TICKS[0], LINE_TICKS
        if self._low_ticks != low or not all(self._at_rest.get(ticks) for ticks in (low, near, far)):
            return False
        at_low, at_near, at_far = (fmean(self._at_rest[ticks]) for ticks in (low, near, far))
        line = at_near + (at_near - at_far) * (near - low) / (far - near)
        return abs(at_low - line) > LINE_UNITS

    def _is_warm(self, temp_c: float) -> bool:
        """The fit takes the temperature at rest for the room's."""
        fell_c = self.recording.reference[0][1] - temp_c
        return not self._has_waited and (temp_c > self.parameters.warm_c or fell_c > self.parameters.still_c)

    def _has_cooled(self, now_s: float) -> bool:
        """Has the reference stopped falling?"""
        p, readings = self.parameters, self.recording.reference
        before = [shown_c for read_s, shown_c in readings if read_s <= now_s - p.still_s]
        return (
            len(before) > 0 and before[-1] - readings[-1][1] < p.still_c and now_s - self.stage_s > p.still_s
        )

    def _stalled(self, now_s: float, temp_c: float) -> bool:
        """Has the reference stopped rising?"""
        if temp_c >= self._rise[1] + self.parameters.contact_c:
            self._rise = (now_s, temp_c)
        return now_s - self._rise[0] > self.parameters.contact_s

    # Phases over time: (phase, duration)

    def _stretch(self, phase: int, duration_s: float) -> Iterator[tuple[int, float]]:
        """One phase for long, sent again often enough for the bridge's watchdog."""
        while duration_s > 0.0:
            part_s = min(duration_s, self.parameters.refresh_s)
            yield phase, part_s
            duration_s -= part_s

    def _rest(self) -> Iterator[tuple[int, float]]:
        """Short looks with long pauses, which do not heat the nozzle; the first ones at several phases."""
        for phase in (self._low_ticks, *LINE_TICKS) * LINE_LOOKS:
            yield phase, self.parameters.look_s
            yield 0, self.parameters.pause_s
        while True:
            yield self._low_ticks, self.parameters.look_s
            yield 0, self.parameters.pause_s

    def _heat(self) -> Iterator[tuple[int, float]]:
        p = self.parameters
        low_w = p.law.power_w(self._low_ticks)
        while True:
            phase = next(self._levels)
            surplus_j = (p.law.power_w(phase) - p.heat_w) * p.visit_s
            yield from self._stretch(self._low_ticks, max(0.006, surplus_j / max(1.0, p.heat_w - low_w)))
            yield phase, p.visit_s

    def _cool(self) -> Iterator[tuple[int, float]]:
        p = self.parameters
        while True:
            for _ in range(20):
                yield self._low_ticks, p.look_s
                yield 0, p.pause_s
            yield self._low_ticks, p.look_s
            yield next(self._levels), p.visit_s
            yield self._low_ticks, p.look_s
            yield 0, p.pause_s
