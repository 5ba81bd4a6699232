"""A recorded run as a table: how the nozzle was driven, step by step, and what the coil read."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thermal.control.loop_records import LoopParameters
from thermal.recording import plain, stored

Array = np.ndarray[Any, np.dtype[Any]]

MERGED_S = 0.016  # blocks in a row at one phase are one step up to this length
HELD_S = 0.1  # longest gap in the blocks: the drive in it is not known
ROWS_MIN = 100  # triples of blocks that determine the noise
TINY_S = 1e-9
COUNT_MIN = 48  # samples; a shorter reading is not used
RISE_MIN_C = 80.0  # of a heat-up
COLD_MAX_C = 60.0  # at the start: all parts of the nozzle are then at the temperature of the room
LASTS_MIN_S = 10.0  # the second mass answers in 10 s
# As thermal/recording/recorder.py writes them.
BLOCK = np.dtype(
    [
        *((name, "<i8") for name in ("sequence", "clock")),
        *((name, "<f8") for name in ("time_s", "lasts_s", "raw")),
        *((name, "<i4") for name in ("count", "low", "high", "phase", "discarded", "lost")),
    ]
)


class RunError(ValueError):
    """No plant can be found from this file; the text is for people."""


@dataclass(slots=True)
class Recording:
    """Steps in order of time. `steps`: as C's struct follow_step, a row each."""

    heater: str
    parameters: LoopParameters
    steps: Array
    end_s: Array  # since the start of the recording
    raw: Array  # mean code; NaN: nothing measured in this step
    sigma_raw: Array  # 1 sigma of that mean, by noise and rounding
    noise_lsb: float
    noise_sigma_lsb: float  # its standard error

    temp_c: Array = field(init=False)  # by the law of the run, NaN where there is no reading
    c_per_unit: Array = field(init=False)

    def __post_init__(self) -> None:
        temp_c, c_per_unit = self.temperature(self.raw)
        self.raw[~np.isfinite(temp_c)] = np.nan  # a code outside the law is no reading
        self.temp_c, self.c_per_unit = temp_c, c_per_unit

    def temperature(self, raw: Array) -> tuple[Array, Array]:
        """degC, and degC a signal unit, of mean codes where the run has a reading."""
        front, law, supply = (
            self.parameters.front,
            self.parameters.estimator.law,
            self.parameters.estimator.supply,
        )
        out = np.full((2, len(raw)), np.nan)
        for i in np.flatnonzero(np.isfinite(self.raw)):
            units = (raw[i] - front.adc_zero_raw) * front.units_per_lsb
            out[:, i] = law.invert(units, self.steps[i, 1], supply)
        return out[0], out[1]


def read(path: Path) -> Recording:
    """Raises RunError, RunFileError, UnknownType, OSError."""
    header: dict[str, Any] = {}
    tables, pending = [], dict[str, tuple[float, ...]]()
    schedules = {"F": _Schedules(), "A": _Schedules()}
    for frame in stored.read(path):
        if frame.kind == "H":
            header = frame.json()
        elif frame.kind == "b":
            (now_s,) = struct.unpack_from("<d", frame.payload)
            tables.append(np.frombuffer(frame.payload[8:], BLOCK))
            for kind, doubles in pending.items():  # a schedule is written just before the blocks it is for
                schedules[kind].add(now_s, doubles)
            pending.clear()
        elif frame.kind in schedules:
            pending[frame.kind] = frame.doubles()
    if not header or not tables:
        raise RunError("it holds no header" if tables else "it holds no blocks")
    blocks = np.concatenate(tables)
    missing_s = float((blocks["time_s"][1:] - (blocks["time_s"] + blocks["lasts_s"])[:-1]).max(initial=0.0))
    if missing_s > HELD_S:
        raise RunError(f"{missing_s:.1f} s of blocks are missing in the middle of the run")
    made = _merged(header, blocks, schedules["F"], schedules["A"])
    _check(made)
    return made


def _check(run: Recording) -> None:
    seen_c = run.temp_c[np.isfinite(run.temp_c)]
    if run.end_s[-1] < LASTS_MIN_S:
        raise RunError(
            f"it lasts {run.end_s[-1]:.1f} s: too short, a heat-up and {LASTS_MIN_S:g} s are needed"
        )
    if seen_c[0] > COLD_MAX_C:
        raise RunError(
            f"it begins at {seen_c[0]:.0f} C: record from a nozzle at the temperature of the room on"
        )
    if seen_c.max() - seen_c[0] < RISE_MIN_C:
        raise RunError(
            f"it has no heat-up: the nozzle went from {seen_c[0]:.0f} C to {seen_c.max():.0f} C at most"
        )


class _Schedules:
    """Planned flow or fan as it was known: each schedule holds until the next one arrives."""

    def __init__(self) -> None:
        self._times_s: list[float] = [-math.inf]
        self._values: list[float] = [0.0]

    def add(self, now_s: float, doubles: tuple[float, ...]) -> None:
        before, *rest = doubles
        half = len(rest) // 2
        while self._times_s and self._times_s[-1] >= now_s:
            del self._times_s[-1], self._values[-1]
        for at_s, value in zip((-math.inf, *rest[:half]), (before, *rest[half:]), strict=True):
            if at_s <= now_s and self._times_s and self._times_s[-1] == now_s:
                self._values[-1] = value
            elif not self._values or value != self._values[-1]:
                self._times_s.append(max(at_s, now_s))
                self._values.append(value)

    def at(self, time_s: Array) -> Array:
        """The value that was planned for each time."""
        index = np.searchsorted(np.array(self._times_s), time_s, side="right") - 1
        return np.array(self._values)[np.maximum(index, 0)]

    def ramped(self, time_s: Array) -> Array:
        """As `at`, with the ramps of accelerations, of which a schedule has the means.

        A span above its neighbours is at constant speed. Beside one the flow is a ramp, between two a dip.
        """
        values = np.array(self._values)
        begins = np.concatenate([[True], values[1:] != values[:-1]])
        mean, begin_s = values[begins], np.array(self._times_s)[begins]
        end_s = np.concatenate([begin_s[1:], [math.inf]])
        before, after = np.concatenate([[0.0], mean[:-1]]), np.concatenate([mean[1:], [0.0]])
        high = np.concatenate([[False], (mean > before) & (mean > after), [False]])
        left, right = high[:-2] & (mean > 0.0), high[2:] & (mean > 0.0)
        first = np.where(left, before, np.where(right, np.maximum(0.0, 2.0 * mean - after), mean))
        last = np.where(right, after, np.where(left, np.maximum(0.0, 2.0 * mean - before), mean))
        middle = np.where(left & right, np.maximum(0.0, 2.0 * mean - 0.5 * (before + after)), mean)
        at = np.maximum(np.searchsorted(begin_s, time_s, side="right") - 1, 0)
        with np.errstate(invalid="ignore"):
            share = np.nan_to_num(2.0 * (time_s - begin_s[at]) / (end_s - begin_s)[at])
        early, late = np.clip(share, 0.0, 1.0), np.clip(share - 1.0, 0.0, 1.0)
        return np.asarray(first[at] + early * (middle - first)[at] + late * (last - middle)[at])


def _noise(blocks: Array) -> tuple[float, float, float]:
    """Noise of one sample in LSB, its standard error, and the unit of a block's sum, in LSB.

    From second differences of whole blocks at one phase: a temperature moves along a line for 5 ms.
    """
    count = int(blocks["count"].max())
    whole = (blocks["phase"] > 0) & (blocks["count"] == count)
    unit = float(np.diff(np.unique(np.rint(blocks["raw"][whole] * count))).min(initial=math.inf))
    row = whole[:-2] & whole[1:-1] & whole[2:] & (np.ptp(_triples(blocks["phase"]), axis=0) == 0)
    if row.sum() < ROWS_MIN:
        raise RunError("it has no heat-up: the bridge is hardly ever on")
    bends = (np.array([1.0, -2.0, 1.0]) @ _triples(blocks["raw"]))[row]
    variance = float(np.mean(bends**2)) / 6.0 * count
    noise_lsb = math.sqrt(max(variance - (1.0 + unit**2 / count) / 12.0, 1e-4))  # less what rounding adds
    return noise_lsb, variance / (noise_lsb * math.sqrt(row.sum())), unit


def _triples(values: Array) -> Array:
    return np.stack([values[:-2], values[1:-1], values[2:]])


def _merged(header: dict[str, Any], blocks: Array, flow: _Schedules, fan: _Schedules) -> Recording:
    """Blocks in a row that differ in nothing become one step; what settles after a phase step is a step of its own."""
    parameters = plain.restored(header["parameters"])
    noise_lsb, noise_sigma_lsb, unit = _noise(blocks)
    # With little noise the mean of rounded codes is off by a sine of the signal.
    sine_lsb = math.exp(-2.0 * (math.pi * noise_lsb) ** 2) / math.pi
    codes = blocks["raw"] + sine_lsb * np.sin(2.0 * np.pi * blocks["raw"])
    phase, time_s = blocks["phase"], blocks["time_s"]
    end_s = time_s + blocks["lasts_s"]
    drive = np.column_stack([phase, flow.ramped(0.5 * (time_s + end_s)), fan.at(time_s)])
    gap_s = np.maximum(0.0, time_s - np.concatenate([time_s[:1], end_s[:-1]]))
    usable = (
        (phase >= parameters.estimator.phase_low_ticks)
        & (blocks["lost"] == 0)
        & (blocks["low"] > 0)
        & (blocks["high"] < header["adc_max"])
    )
    # The board turns the bridge off for a moment to test it; then the signal settles. Lost blocks are no such moment.
    discarded_s = blocks["discarded"] * blocks["lasts_s"] / blocks["count"]
    off_s = np.minimum(gap_s, discarded_s) - parameters.timing.settle_s
    off_s[np.concatenate([[True], phase[1:] != phase[:-1]]) | (off_s < TINY_S)] = 0.0
    rows, begin = [], 0
    for i in range(1, len(blocks) + 1):
        same = i < len(blocks) and gap_s[i] < TINY_S and usable[i] == usable[begin]
        if same and end_s[i] - time_s[begin] <= MERGED_S and (drive[i] == drive[begin]).all():
            continue
        if gap_s[begin] > 0.0:
            if off_s[begin]:
                rows.append((off_s[begin], 0.0, *drive[begin, 1:], time_s[begin], np.nan, 0))
            rows.append((gap_s[begin] - off_s[begin], *drive[begin], time_s[begin], np.nan, 0))
        count = blocks["count"][begin:i]
        mean = np.average(codes[begin:i], weights=count) if usable[begin] else np.nan
        rows.append((end_s[i - 1] - time_s[begin], *drive[begin], end_s[i - 1], mean, count.sum()))
        begin = i
    table = np.array(rows)
    steps, count = np.ascontiguousarray(table[:, :4]), np.maximum(table[:, 6], 1.0)
    raw = np.where(table[:, 6] >= COUNT_MIN, table[:, 5], np.nan)
    lasting = (
        unit / blocks["count"].max()
    ) ** 2 / 12.0  # a sum is rounded to its unit, blocks in a row alike
    sigma = np.sqrt((noise_lsb**2 + 1.0 / 12.0) / count + lasting)
    end_s = table[:, 4] - time_s[0]
    return Recording(header["heater"], parameters, steps, end_s, raw, sigma, noise_lsb, noise_sigma_lsb)
