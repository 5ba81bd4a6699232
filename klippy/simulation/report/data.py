"""What a report shows, computed from the trace of a simulated print.

A trace is a CSV file with one header line and at least 100 rows a simulated second; 6000 s of printing make
600,000 rows. This file reads it in pieces, finds the layers, and thins the series to what a page can hold
without losing an extreme. It draws nothing; report/__init__.py (page) and png.py (picture) do.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Times = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]

COLUMNS = (
    "t_s",
    "target_c",
    "estimate_c",
    "true_c",
    "bore_c",
    "melt_c",
    "phase_ticks",
    "power_w",
    "flow_mm3_s",
    "x_mm",
    "y_mm",
    "z_mm",
    "e_mm",
)
OPTIONAL = ("bed_c", "bed_target_c", "fan", "sigma_c", "drift_c", "supply")  # a trace may be without them
CHUNK_ROWS = 50_000  # 5 MB as float64: keeps the peak of reading small

SETTLED_BAND_C = 3.0  # the accuracy promised while printing
SETTLED_HOLD_S = 2.0
EXTRUDING_FLOW_MM3_S = 0.02  # a 0.1 mm line 0.05 mm high at 4 mm/s; below that nothing useful is deposited
MOVING_MM_S = 0.5
LAYER_STEP_MM = 0.04  # thinner layers than this are not printed with a 0.4 mm nozzle
LAYER_MIN_S = 0.1
SPEED_ROWS = 5  # a speed is taken over so many: one row is too coarse for single steps


class ReportError(Exception):
    """The trace cannot be reported on; the text says why, for people."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Columns of a trace, all of one length, in time order; units are in the names."""

    t_s: Times
    target_c: Floats
    estimate_c: Floats
    true_c: Floats
    bore_c: Floats
    melt_c: Floats
    phase_ticks: Floats
    power_w: Floats
    flow_mm3_s: Floats
    x_mm: Floats
    y_mm: Floats
    z_mm: Floats
    e_mm: Floats
    bed_c: Floats | None = None
    bed_target_c: Floats | None = None
    fan: Floats | None = None
    sigma_c: Floats | None = None
    drift_c: Floats | None = None
    supply: Floats | None = None


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer as printed: rows first..last of the trace; figures over its extruding rows only."""

    z_mm: float
    first: int
    last: int
    start_s: float
    duration_s: float
    error_mean_c: float
    error_min_c: float
    error_max_c: float
    true_mean_c: float
    flow_mean_mm3_s: float
    flow_max_mm3_s: float


@dataclass(frozen=True, slots=True)
class Envelope:
    """A series thinned to buckets of rows: each bucket keeps its lowest and its greatest value."""

    t_s: Times
    low: Floats
    high: Floats

    def line(self) -> tuple[Times, Floats]:
        """One line through the extremes, with time rising from point to point."""
        if self.high is self.low:
            return self.t_s, self.low
        half_s = np.diff(self.t_s, append=2.0 * self.t_s[-1] - self.t_s[-2]) / 2.0
        t_s = np.column_stack((self.t_s, self.t_s + half_s)).ravel()
        return t_s, np.column_stack((self.low, self.high)).ravel()


@dataclass(frozen=True, slots=True)
class Path2D:
    """The extruded path, thinned: `pen` is 0 where a line starts, `layer_start` has layers' first points."""

    x_mm: Floats
    y_mm: Floats
    error_c: Floats
    true_c: Floats
    flow_mm3_s: Floats
    pen: npt.NDArray[np.uint8]
    layer_start: list[int]


def read_trace(path: Path) -> Trace:
    """Reads a trace. Columns beyond COLUMNS and OPTIONAL are ignored. Raises ReportError on anything else amiss."""
    try:
        with path.open(newline="") as f:
            names = next(csv.reader(f), [])
            missing = [c for c in COLUMNS if c not in names]
            if missing:
                raise ReportError(f"the trace {path} has no column {', '.join(missing)}")
            optional = [c for c in OPTIONAL if c in names]
            parts = list(_chunks(f, [names.index(c) for c in (*COLUMNS, *optional)]))
    except OSError as e:
        raise ReportError(f"cannot read the trace {path}: {e.strerror}") from None
    except ValueError as e:
        raise ReportError(f"the trace {path} holds something that is not a number: {e}") from None
    if sum(len(t) for t, _ in parts) < 2:
        raise ReportError(f"the trace {path} has no rows: the print ended before it began")
    t_s = np.concatenate([t for t, _ in parts])
    columns = np.concatenate([rest for _, rest in parts], axis=1)
    needed = len(COLUMNS) - 1
    return Trace(t_s, *columns[:needed], **dict(zip(optional, columns[needed:], strict=True)))


def _chunks(f: TextIO, usecols: Sequence[int]) -> Iterator[tuple[Times, Floats]]:
    """Times (float64) and the other columns (float32, one column a row) of successive pieces of the file."""
    while True:
        lines = [line for _, line in zip(range(CHUNK_ROWS), f, strict=False)]
        if not lines:
            return
        block = np.loadtxt(lines, delimiter=",", usecols=usecols, ndmin=2)
        yield block[:, 0].copy(), block[:, 1:].T.astype(np.float32)


def extruding(trace: Trace) -> Mask:
    """Rows in which plastic is deposited: flow, and the nozzle moving over the part."""
    dt = np.maximum(np.diff(trace.t_s), 1e-9)
    speed = np.hypot(np.diff(trace.x_mm), np.diff(trace.y_mm)) / dt
    moving = np.concatenate(([False], speed > MOVING_MM_S))
    return moving & (trace.flow_mm3_s > EXTRUDING_FLOW_MM3_S)


def head_speed(trace: Trace) -> Floats:
    """Speed of the nozzle along its path, mm/s, mean of SPEED_ROWS rows."""
    steps = [np.diff(axis.astype(np.float64)) for axis in (trace.x_mm, trace.y_mm, trace.z_mm)]
    way_mm = np.concatenate(([0.0], np.cumsum(np.sqrt(sum(np.square(step) for step in steps)))))
    rows = np.arange(len(way_mm))
    first, last = np.maximum(rows - SPEED_ROWS // 2, 0), np.minimum(rows + SPEED_ROWS // 2 + 1, rows[-1])
    return ((way_mm[last] - way_mm[first]) / (trace.t_s[last] - trace.t_s[first])).astype(np.float32)


def settled(trace: Trace) -> Mask:
    """Rows in which the nozzle counts as settled at its target.

    For each stretch of one target: from the first moment after which the true temperature has kept within
    SETTLED_BAND_C for SETTLED_HOLD_S, to the end of the stretch, whatever happens after.
    """
    result = np.zeros(len(trace.t_s), dtype=np.bool_)
    edges = np.flatnonzero(np.diff(trace.target_c)) + 1
    for start, end in pairwise([0, *edges.tolist(), len(trace.t_s)]):
        if trace.target_c[start] <= 0.0:
            continue
        t = trace.t_s[start:end]
        off = np.abs(trace.true_c[start:end] - trace.target_c[start:end]) > SETTLED_BAND_C
        # a row qualifies if the next row outside the band is SETTLED_HOLD_S away or more
        next_off = np.append(t[off], np.inf)[np.searchsorted(t[off], t)]
        held = (next_off - t >= SETTLED_HOLD_S) & (t + SETTLED_HOLD_S <= t[-1])
        if held.any():
            result[start + int(np.argmax(held)) : end] = True
    return result


def printing(trace: Trace, extrudes: Mask) -> Mask:
    """Rows from the first to the last extruding one (travel moves between them included)."""
    result = np.zeros(len(extrudes), dtype=np.bool_)
    rows = np.flatnonzero(extrudes)
    if len(rows):
        result[rows[0] : rows[-1] + 1] = True
    return result


def find_layers(trace: Trace, extrudes: Mask) -> list[Layer]:
    """Layers by the height of extruding moves; a lift between two moves of one layer does not split it."""
    rows = np.flatnonzero(extrudes)
    layers = []
    for group in _split_by_height(rows, trace.z_mm[rows]):
        layer = _layer(trace, group)
        if layer.duration_s >= LAYER_MIN_S:
            layers.append(layer)
    return layers


def _split_by_height(rows: Rows, z_mm: Floats) -> Iterator[Rows]:
    if not len(rows):
        return
    # only rows where the height changes at all can start a layer, so the loop is over few of them
    start, layer_z = 0, float(z_mm[0])
    for i in (np.flatnonzero(np.diff(z_mm)) + 1).tolist():
        if abs(float(z_mm[i]) - layer_z) >= LAYER_STEP_MM:
            yield rows[start:i]
            start, layer_z = i, float(z_mm[i])
    yield rows[start:]


def _layer(trace: Trace, rows: Rows) -> Layer:
    error = trace.true_c[rows] - trace.target_c[rows]
    flow = trace.flow_mm3_s[rows]
    first, last = int(rows[0]), int(rows[-1])
    return Layer(
        z_mm=float(trace.z_mm[first]),
        first=first,
        last=last,
        start_s=float(trace.t_s[first]),
        duration_s=float(trace.t_s[last] - trace.t_s[first]),
        error_mean_c=float(error.mean()),
        error_min_c=float(error.min()),
        error_max_c=float(error.max()),
        true_mean_c=float(trace.true_c[rows].mean()),
        flow_mean_mm3_s=float(flow.mean()),
        flow_max_mm3_s=float(flow.max()),
    )


def envelope(t_s: Times, values: Floats, buckets: int) -> Envelope:
    """Thins a series to at most `buckets` buckets of equally many rows, each with its extremes."""
    size = -(-len(values) // buckets)
    if size <= 1:
        return Envelope(t_s, values, values)
    starts = np.arange(0, len(values), size)
    # fmin and fmax pass over rows without a value (an estimate before the first measurement)
    return Envelope(t_s[starts], np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts))


# (turn in degrees, rows) beyond which a point is kept; tried in order until the path is short enough
PATH_THINNING = ((0.0, 1), (2.0, 4), (5.0, 8), (10.0, 16), (20.0, 40), (45.0, 100), (90.0, 400))


def thin_path(trace: Trace, layers: Sequence[Layer], extrudes: Mask, max_points: int) -> Path2D:
    """The extruded path in about `max_points` points or fewer: corners stay, straight runs thin out."""
    for turn_deg, stride in PATH_THINNING:
        keep = _kept_rows(trace, extrudes, turn_deg, stride)
        if int(np.count_nonzero(keep)) <= max_points:
            break
    breaks = np.cumsum(~extrudes)
    chosen, starts, pens = [], [], []
    total = 0
    for layer in layers:
        rows = np.flatnonzero(keep[layer.first : layer.last + 1]) + layer.first
        # a line is drawn to a point if every row since the point before it extrudes
        pens.append(np.diff(breaks[rows], prepend=-1) == 0)
        starts.append(total)
        chosen.append(rows)
        total += len(rows)
    rows = np.concatenate(chosen) if chosen else np.zeros(0, dtype=np.intp)
    pen = np.concatenate(pens).astype(np.uint8) if pens else np.zeros(0, dtype=np.uint8)
    true_c = trace.true_c[rows]
    return Path2D(
        trace.x_mm[rows],
        trace.y_mm[rows],
        true_c - trace.target_c[rows],
        true_c,
        trace.flow_mm3_s[rows],
        pen,
        starts,
    )


def _kept_rows(trace: Trace, extrudes: Mask, turn_deg: float, stride: int) -> Mask:
    # the row before an extruding one is where its line starts
    ends = np.diff(extrudes.astype(np.int8), append=0) == -1
    begins = np.diff(extrudes.astype(np.int8), append=0) == 1
    heading = np.unwrap(np.arctan2(np.diff(trace.y_mm, append=0), np.diff(trace.x_mm, append=0)))
    turns = np.abs(np.diff(heading, prepend=heading[0])) > np.radians(turn_deg)
    on_stride = np.arange(len(extrudes)) % stride == 0
    return begins | ends | (extrudes & (turns | on_stride))
