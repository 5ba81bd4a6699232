"""Filter of predictive control written out in Python, as an independent reference for the one in C.

Straight from the equations in the docstring of predictive_filter. Figures that tune the filter are repeated here, so
that one changed by mistake shows. The plant is model_reference_plant.py's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from reference.model_reference_plant import (
    advance,
    at_rest,
    capacity_j_k,
    heat_per_output_w,
    melt_w_k,
    schedule_at,
)
from thermal.control.control_api import IDLE, Schedule
from thermal.models.heat_loss import STEFAN_BOLTZMANN, ZERO_CELSIUS_K
from thermal.models.heater_model import ModelParameters, Nodes
from thermal.records import Planned, Sample

GAIN_MIN, GAIN_MAX = 0.1, 10.0
TOGETHER_MAX = 7  # samples of one innovation
SURPRISE = 14.0  # innovation squared over its variance beyond which the disturbance is taken to have changed
SURPRISED_W = 3.0  # by about this much at once
# Innovations that lean one way: their sum, each in its own sigma and decaying so fast a message, is 1.5 by chance.
LEAN_KEEP, LEAN_MAX = 0.75, 4.0  # nearly three times that: the disturbance moves ...
LEAN_SHARE = 0.5  # ... by about this much of disturbance_start_w a message
JUMP_C, JUMP_SIGMA = 3.0, 6.0  # farther off than this within a message no heat goes: the thermometer jumped
JUMPED_C = 10.0  # 1 sigma of such a jump
REBASED_SIGMA = 10.0  # a step of the drive may move the sensing law by this many of a sample's sigma
OFFSET_C, OFFSET_SIGMA = (
    1.0,
    4.0,
)  # beyond this it has, and the reading is put right as long as the drive stays
OFFSET_SHARE = 0.5  # below this share of the drive it was seen at it is forgotten: little drive is the truth
TAKEN_C, TAKEN_GAIN = (
    1.0,
    0.2,
)  # 1 sigma of nodes, share of the gain's doubt after taking over from another law
SLANT_WALK_C, SLANT_USUAL_S = 0.3, 0.2  # how the reading's slant walks in a second; memory of the usual drive
SLANT_GAIN = 0.05  # the slant is learned once the gain is known so well
COLOURED_GAP_S, SWING_S, SWING_SHARE, SWING_KEEP_S, SWING_DOUBT_C = 0.02, 0.006, 0.25, 1.0, 5.0
GAIN_SHARE, COLOURED_JUMP_C = 0.25, 12.0  # with coloured errors
SECOND_MARGIN_C = 20.0  # the second mass lies between air and the hottest node, give or take this


Matrix = tuple[tuple[float, ...], ...]


UNKNOWN = Nodes(math.nan, math.nan, math.nan, math.nan, math.nan, 0.0)


class ModelState(NamedTuple):
    """Memory of predictive control. A tuple: one is made at every step."""

    time_s: float = math.nan  # what the nodes belong to; NaN: nothing known yet
    nodes: Nodes = UNKNOWN
    disturbance_w: float = 0.0
    gain: float = 1.0
    covariance: Matrix = ()
    innovation_c: float = 0.0  # newest: measured minus expected
    measured_s: float = -math.inf  # newest measurement
    output: float = 0.0  # newest output decided
    driven: float = 0.0  # output in force at the newest measurement
    offset_c: float = 0.0  # taken off the readings ...
    offset_output: float = 0.0  # ... since the output stepped to this
    lean: float = 0.0  # decaying sum of innovations, each over its sigma
    swing_c: float = 0.0  # amplitude of innovations that swing to and fro
    half_c: float = 0.0  # peak of the present half wave
    before_c: float = 0.0  # size of the one before
    swinging_s: float = 0.0  # for so long the reading has swung
    read_to_s: float = 0.0  # end of the newest piece with a measurement
    read_s: float = 0.0  # of the newest samples: time since those before
    read_cs: float = 0.0  # ... reading times time
    ridden_c: float = 0.0  # added to the wanted temperature while the reading swings
    slant_c: float = 0.0  # what full drive by itself adds to the reading
    usual: float = 0.0  # share of full drive at which the reading is taken for the truth
    sent: tuple[Planned, ...] = ()  # own outputs, where the caller gives none that are pending

    @property
    def known(self) -> bool:
        return self.time_s == self.time_s


class Layout(NamedTuple):
    """Places in the covariance; -1: no such node."""

    element: int
    temp: int
    second: int
    sensor: int
    disturbance: int
    gain: int
    slant: int
    size: int
    measured: int


def _layout(has_element: bool, has_second: bool, has_sensor: bool, has_slant: bool) -> Layout:
    temp = int(has_element)
    second = temp + 1 if has_second else -1
    sensor = temp + 1 + has_second if has_sensor else -1
    disturbance = temp + 1 + has_second + has_sensor
    measured = sensor if has_sensor else temp
    return Layout(
        0 if has_element else -1,
        temp,
        second,
        sensor,
        disturbance,
        disturbance + 1,
        disturbance + 2 if has_slant else -1,
        disturbance + 2 + has_slant,
        measured,
    )


def layout(p: ModelParameters) -> Layout:
    """Which node stands where."""
    return _layout(p.element_j_k > 0.0, p.second_j_k > 0.0, p.sensor_s > 0.0, p.slant_c > 0.0)


def begin(p: ModelParameters, temp_c: float, time_s: float, before: ModelState | None = None) -> ModelState:
    """A state that knows one temperature; the drive's gain is kept from `before`, if any."""
    places = layout(p)
    nodes = at_rest(p, temp_c)
    variances = [0.0] * places.size
    rise_c = abs(temp_c - p.ambient_c)
    if places.element >= 0:
        variances[places.element] = (5.0 + 0.1 * rise_c) ** 2
    variances[places.temp] = (p.sigma_c + (0.1 * rise_c if p.sensor_s else 0.0)) ** 2
    if places.second >= 0:
        variances[places.second] = (2.0 + p.second_start * rise_c) ** 2
    if places.sensor >= 0:
        variances[places.sensor] = p.sigma_c**2
    variances[places.disturbance] = p.disturbance_start_w**2
    gain, gain_variance = 1.0, p.gain_start**2
    if before is not None and before.known:
        gain, gain_variance = before.gain, before.covariance[places.gain][places.gain]
    variances[places.gain] = gain_variance
    if places.slant >= 0:
        variances[places.slant] = p.slant_c**2
    rows = [tuple(v if i == j else 0.0 for j in range(places.size)) for i, v in enumerate(variances)]
    output = before.output if before is not None else 0.0
    sent = before.sent if before is not None else ()
    usual = output / p.output_high
    return ModelState(
        time_s, nodes, 0.0, gain, tuple(rows), 0.0, time_s, output, usual=usual, sent=sent, read_to_s=time_s
    )


def taken_over(p: ModelParameters, state: ModelState, disturbance_w: float) -> ModelState:
    """A state just begun, with a given disturbance, which holds the doubt about gain and second mass, too."""
    places = layout(p)
    doubts = {
        places.temp: TAKEN_C,
        places.disturbance: p.disturbance_w,
        places.gain: TAKEN_GAIN * p.gain_start,
    }
    if places.second >= 0:
        doubts[places.second] = TAKEN_C
    rows = [list(row) for row in state.covariance]
    for place, sigma in doubts.items():
        rows[place][place] = min(rows[place][place], sigma * sigma)
    max_w = p.disturbance_max_w
    known_w = min(max_w, max(-max_w, disturbance_w))
    return state._replace(disturbance_w=known_w, covariance=tuple(map(tuple, rows)))


def _slopes(
    p: ModelParameters, places: Layout, nodes: Nodes, gain: float, output: float, fan: float
) -> list[tuple[int, int, float]]:
    """Nonzero entries (row, column, 1/s) of A, the derivative of the model's rates by its state."""
    heat = capacity_j_k(p, nodes.temp_c)
    hot_k = nodes.temp_c + ZERO_CELSIUS_K
    air = p.loss_w_k + fan * p.fan_w_k + 4.0 * STEFAN_BOLTZMANN * p.radiation_m2 * hot_k**3
    taken = air + p.link_w_k + p.element_w_k + melt_w_k(p, nodes.flow)
    entries = [
        (places.temp, places.temp, -taken / heat),
        (places.temp, places.disturbance, 1.0 / heat),
    ]
    drive_w = output * heat_per_output_w(p, nodes.temp_c)
    if places.element >= 0:
        entries.append((places.element, places.element, -p.element_w_k / p.element_j_k))
        entries.append((places.element, places.temp, p.element_w_k / p.element_j_k))
        entries.append((places.element, places.gain, drive_w / p.element_j_k))
        entries.append((places.temp, places.element, p.element_w_k / heat))
    else:
        entries.append((places.temp, places.gain, drive_w / heat))
    if places.second >= 0:
        entries.append((places.temp, places.second, p.link_w_k / heat))
        entries.append((places.second, places.temp, p.link_w_k / p.second_j_k))
        entries.append((places.second, places.second, -(p.link_w_k + p.second_loss_w_k) / p.second_j_k))
    if places.sensor >= 0:
        entries.append((places.sensor, places.sensor, -1.0 / p.sensor_s))
        entries.append((places.sensor, places.temp, 1.0 / p.sensor_s))
    return entries


def _spread(
    p: ModelParameters,
    places: Layout,
    rows: list[list[float]],
    slopes: list[tuple[int, int, float]],
    dt_s: float,
) -> list[list[float]]:
    """P <- F P F' + Q over `dt_s`."""
    steps = 1 if dt_s <= p.step_s else math.ceil(dt_s / p.step_s)
    h = dt_s / steps
    walk = p.temp_walk_c * p.temp_walk_c * h
    for _ in range(steps):
        left = [row[:] for row in rows]
        for i, j, slope in slopes:
            k = slope * h
            target, source = left[i], rows[j]
            for c in range(places.size):
                target[c] += k * source[c]
        rows = [row[:] for row in left]
        for i, j, slope in slopes:
            k = slope * h
            for r in range(places.size):
                rows[r][i] += k * left[r][j]
        for i in range(places.disturbance):
            rows[i][i] += walk
        rows[places.disturbance][places.disturbance] += p.disturbance_w * p.disturbance_w * h
        rows[places.gain][places.gain] += p.gain_walk * p.gain_walk * h
        if places.slant >= 0:
            rows[places.slant][places.slant] += SLANT_WALK_C**2 * h
    return rows


class _Run(NamedTuple):
    """What walking through the samples has given."""

    nodes: Nodes
    time_s: float
    weight: float  # sum of 1/variance
    innovation_c: float  # weighted mean
    measured_s: float
    output: float  # mean over the time walked
    rebased_c: float  # 1 sigma of what a step of the drive may have moved the reading, 0: there was none
    driven: float
    offset_c: float
    offset_output: float
    lever: float  # share of full drive beyond the usual, weighted mean
    usual: float


def _coloured(p: ModelParameters, state: ModelState, sample: Sample, last_s: float) -> float:
    """Variance of one sample by coloured errors."""
    span_s = max(2.0 * (sample.end_s - sample.time_s), min(sample.end_s - last_s, COLOURED_GAP_S))
    if not p.coloured_c2_s or not span_s > 0.0:
        return 0.0
    return (p.coloured_c2_s + SWING_S * state.swing_c * state.swing_c) / span_s


def _grouped(p: ModelParameters, state: ModelState, samples: Sequence[Sample]) -> list[Sample]:
    """Neighbours under one output as one sample at their weighted middle: the slope between them is a line."""
    groups: list[Sample] = []
    end_s, output = math.nan, math.nan
    weight = heat = moment = 0.0
    last_s = state.measured_s

    def close() -> None:
        if weight:
            groups.append(Sample(moment / weight, end_s, heat / weight, weight**-0.5, output))
        elif not math.isnan(end_s):
            groups.append(Sample(end_s, end_s, math.nan, 0.0, output))

    for sample in samples:
        if sample.output != output or sample.rebased:
            close()
            weight = heat = moment = 0.0
            end_s, output = math.nan, sample.output
            if sample.rebased:
                groups.append(sample)
                continue
        end_s = sample.end_s
        if sample.temp_c == sample.temp_c:
            sigma_c = sample.sigma_c or p.sigma_c
            share = 1.0 / (sigma_c * sigma_c + _coloured(p, state, sample, last_s))
            last_s = sample.end_s
            weight += share
            heat += share * sample.temp_c
            moment += share * sample.time_s
    close()
    return groups


def _walk(
    p: ModelParameters, state: ModelState, samples: Sequence[Sample], flow: Schedule, fan: Schedule
) -> _Run:
    """Through the outputs of these samples; within one of them the expected temperature is a straight line."""
    nodes, now_s, measured_s = state.nodes, state.time_s, state.measured_s
    weight = pulled = passed = 0.0
    rebased_c, driven = 0.0, state.driven
    offset_c, offset_output = state.offset_c, state.offset_output
    levered, usual = 0.0, state.usual
    for sample in _grouped(p, state, samples):
        surroundings = schedule_at(flow, now_s), schedule_at(fan, now_s)
        drive = sample.output, state.gain, state.disturbance_w
        before, span_s = nodes, max(0.0, sample.end_s - now_s)
        nodes = advance(p, nodes, drive, surroundings, span_s)
        if sample.temp_c == sample.temp_c:
            sigma_c = sample.sigma_c if sample.sigma_c > 0.0 else p.sigma_c
            share = 1.0 / (sigma_c * sigma_c)
            if offset_c and sample.output < OFFSET_SHARE * offset_output:
                offset_c = 0.0
            since = min(1.0, max(0.0, (sample.time_s - now_s) / span_s)) if span_s else 1.0
            expected_c = before.sensor_c + since * (nodes.sensor_c - before.sensor_c)
            usual = sample.output / p.output_high if sample.rebased else usual
            lever = sample.output / p.output_high - usual
            expected_c += state.slant_c * lever
            off_c = sample.temp_c - offset_c - expected_c
            if sample.rebased:
                rebased_c = REBASED_SIGMA * sigma_c
                if sample.output > driven and abs(off_c) > OFFSET_C + OFFSET_SIGMA * sigma_c:
                    offset_c, offset_output = offset_c + off_c, sample.output
                    off_c = 0.0
            weight += share
            levered += share * lever
            pulled += share * off_c
            measured_s, driven = sample.time_s, sample.output
        passed += sample.output * span_s
        now_s += span_s
    elapsed_s = now_s - state.time_s
    output = passed / elapsed_s if elapsed_s > 0.0 else state.output
    mean_c = pulled / weight if weight else 0.0
    lever = levered / weight if weight else 0.0
    return _Run(
        nodes,
        now_s,
        weight,
        mean_c,
        measured_s,
        output,
        rebased_c,
        driven,
        offset_c,
        offset_output,
        lever,
        usual,
    )


def _looking(places: Layout, run: _Run) -> list[float]:
    """What the expected reading is made of: the node measured, and the slant by its lever."""
    h = [0.0] * places.size
    h[places.measured] = 1.0
    if places.slant >= 0:
        h[places.slant] = run.lever
    return h


def _column(rows: list[list[float]], h: list[float]) -> list[float]:
    return [sum(value * share for value, share in zip(row, h, strict=True) if share) for row in rows]


def _spread_of(places: Layout, rows: list[list[float]], run: _Run) -> float:
    """Variance of the innovation."""
    h = _looking(places, run)
    return _column([_column(rows, h)], h)[0] + 1.0 / run.weight


def _moved(p: ModelParameters, places: Layout, nodes: Nodes, gains: list[float], by_c: float) -> Nodes:
    """The nodes after an update; bore and an ideal sensor go with the controlled node."""
    step_c = gains[places.temp] * by_c
    element_c = nodes.element_c + (gains[places.element] * by_c if places.element >= 0 else step_c)
    second_c = nodes.second_c + (gains[places.second] * by_c if places.second >= 0 else 0.0)
    temp_c = nodes.temp_c + step_c
    hottest_c = max(temp_c, nodes.temp_c, p.ambient_c) + SECOND_MARGIN_C
    second_c = min(hottest_c, max(p.ambient_c - SECOND_MARGIN_C, second_c))
    sensor_c = nodes.sensor_c + (gains[places.sensor] * by_c if places.sensor >= 0 else step_c)
    return Nodes(element_c, temp_c, second_c, sensor_c, nodes.bore_c + step_c, nodes.flow)


def _widened(p: ModelParameters, places: Layout, rows: list[list[float]], run: _Run, lean: float) -> float:
    """Doubt more where the innovation says that the model was wrong: `rows` in place. Returns the new lean."""
    m = places.measured
    jump_c = COLOURED_JUMP_C if p.coloured_c2_s else JUMP_C
    jumped = abs(run.innovation_c) > jump_c + JUMP_SIGMA * math.sqrt(_spread_of(places, rows, run))
    loose_c = max(run.rebased_c, JUMPED_C if jumped else 0.0)
    if loose_c:
        for i in range(places.size):
            rows[m][i] = rows[i][m] = 0.0 if i != m else rows[m][m] + loose_c * loose_c
        return 0.0
    if p.coloured_c2_s:
        return lean
    spread = _spread_of(places, rows, run)
    lean = LEAN_KEEP * lean + run.innovation_c / math.sqrt(spread)
    if abs(lean) > LEAN_MAX:
        rows[places.disturbance][places.disturbance] += (LEAN_SHARE * p.disturbance_start_w) ** 2
    elif run.innovation_c * run.innovation_c / spread > SURPRISE:
        rows[places.disturbance][places.disturbance] += SURPRISED_W * SURPRISED_W
    return lean


def _is_doubtful(p: ModelParameters, samples: Sequence[Sample]) -> bool:
    own = sum(1.0 / (s.sigma_c or p.sigma_c) ** 2 for s in samples if not s.rebased and s.temp_c == s.temp_c)
    return own * SWING_DOUBT_C**2 < 1.0


def _swing(
    p: ModelParameters, state: ModelState, run: _Run, samples: Sequence[Sample]
) -> tuple[float, float, float]:
    """swing_c, half_c and before_c after this innovation."""
    if not p.coloured_c2_s:
        return 0.0, 0.0, 0.0
    keep, by_c = math.exp(-(run.time_s - state.time_s) / SWING_KEEP_S), run.innovation_c
    if _is_doubtful(p, samples):
        by_c = 0.0
    swing_c, half_c, before_c = (keep * v for v in (state.swing_c, state.half_c, state.before_c))
    if by_c * half_c < 0.0:
        if abs(by_c) > SWING_SHARE * abs(half_c):
            return max(swing_c, min(abs(half_c), before_c)), by_c, abs(half_c)
    elif abs(by_c) > abs(half_c):
        half_c = by_c
    return swing_c, half_c, before_c


def observe(
    p: ModelParameters,
    state: ModelState,
    samples: Sequence[Sample],
    flow: Schedule = IDLE,
    fan: Schedule = IDLE,
) -> ModelState:
    """The state after these samples, in order of time."""
    state = state._replace(read_s=0.0, read_cs=0.0)
    if not samples:
        return state
    if not state.known or samples[-1].end_s - state.measured_s > p.gap_s:
        measured = [s for s in samples if s.temp_c == s.temp_c]
        if not measured:
            return state
        begun = begin(p, measured[-1].temp_c, measured[-1].end_s, state)
        return begun._replace(usual=measured[-1].output / p.output_high)
    for first in range(0, len(samples), TOGETHER_MAX):
        state = _observe_piece(p, state, samples[first : first + TOGETHER_MAX], flow, fan)
    return state


def _learning(
    p: ModelParameters, places: Layout, state: ModelState, rows: list[list[float]], run: _Run
) -> int:
    """So many places learn."""
    if p.coloured_c2_s and run.output < GAIN_SHARE * p.output_high:
        return places.gain
    is_known = rows[places.gain][places.gain] <= (SLANT_GAIN * state.gain) ** 2
    return places.slant if places.slant >= 0 and not is_known else places.size


def _observe_piece(
    p: ModelParameters, state: ModelState, samples: Sequence[Sample], flow: Schedule, fan: Schedule
) -> ModelState:
    """The samples of one innovation."""
    places = layout(p)
    run = _walk(p, state, samples, flow, fan)
    slopes = _slopes(p, places, run.nodes, state.gain, run.output, schedule_at(fan, run.time_s))
    rows = _spread(p, places, [list(row) for row in state.covariance], slopes, run.time_s - state.time_s)
    moved_c = abs(run.nodes.temp_c - state.nodes.temp_c)
    rows[places.disturbance][places.disturbance] += p.disturbance_w2_per_k * moved_c
    if not run.weight:
        covariance = tuple(map(tuple, rows))
        return state._replace(time_s=run.time_s, nodes=run.nodes, covariance=covariance)
    lean = _widened(p, places, rows, run, state.lean)
    swing = _swing(p, state, run, samples)
    spread = _spread_of(places, rows, run)
    more = run.innovation_c**2 / SURPRISE - spread
    if p.coloured_c2_s and more > 0.0 and _is_doubtful(p, samples):
        spread += more
    column = _column(rows, _looking(places, run))
    gains = [value / spread for value in column]
    learns = _learning(p, places, state, rows, run)
    kept = [row[learns:] for row in rows[learns:]]
    rows = [[v - k * c for v, c in zip(row, column, strict=True)] for row, k in zip(rows, gains, strict=True)]
    for row, known in zip(rows[learns:], kept, strict=True):
        row[learns:] = known
    gains[learns:] = [0.0] * len(kept)
    by_c = run.innovation_c
    gain = min(GAIN_MAX, max(GAIN_MIN, state.gain + gains[places.gain] * by_c))
    max_w = p.disturbance_max_w
    disturbance_w = min(max_w, max(-max_w, state.disturbance_w + gains[places.disturbance] * by_c))
    nodes = _moved(p, places, run.nodes, gains, by_c)
    slant_c, usual, since_s = 0.0, state.usual, run.time_s - state.read_to_s
    if places.slant >= 0:
        slant_c = state.slant_c + gains[places.slant] * by_c
        dt_s = run.time_s - state.time_s
        by = (run.output / p.output_high - run.usual) * dt_s / (SLANT_USUAL_S + dt_s)
        usual = run.usual + by
        nodes, rows = _at_usual(places, nodes, rows, by, slant_c)
    return ModelState(
        run.time_s,
        nodes,
        disturbance_w,
        gain,
        tuple(map(tuple, rows)),
        by_c,
        run.measured_s,
        state.output,
        run.driven,
        run.offset_c,
        run.offset_output,
        lean,
        *swing,
        state.swinging_s,
        run.time_s,
        state.read_s + since_s,
        state.read_cs + since_s * (run.nodes.sensor_c + by_c),
        state.ridden_c,
        slant_c,
        usual,
        state.sent,
    )


def _at_usual(
    places: Layout, nodes: Nodes, rows: list[list[float]], by: float, slant_c: float
) -> tuple[Nodes, list[list[float]]]:
    """The same with another usual drive: T is what would be read there, T + by k."""
    moved = {places.temp, places.sensor} - {-1}
    left = [
        [v + (by * k if i in moved else 0.0) for v, k in zip(row, rows[places.slant], strict=True)]
        for i, row in enumerate(rows)
    ]
    right = [[v + (by * row[places.slant] if j in moved else 0.0) for j, v in enumerate(row)] for row in left]
    step_c = by * slant_c
    return nodes._replace(
        temp_c=nodes.temp_c + step_c, sensor_c=nodes.sensor_c + step_c, bore_c=nodes.bore_c + step_c
    ), right
