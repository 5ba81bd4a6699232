"""Does the heat that the melt takes agree with the planned flow? The heat witness of [nozzle_monitor].

Each step of `step_s` compares the heat missing from the nozzle's balance with what planned flow and fan explain:

    taken  = P - loss(T, T2) - C dT/dt                         W, from the temperature and the drive law
    taken  = gain e + fan_w_k s (T - Ta) + bias + noise        e: heat of the planned melt, s: speed of the part fan

A Kalman filter follows gain, fan_w_k and bias. Its innovation nu, with variance S, drives Page's CUSUM for a loss
of the share `lost_share` of the flow, d = lost_share gain e (log-likelihood ratio of a mean of -d against 0):

    sum = max(0, sum + (-nu d - d^2/2)/S)                      alarm above h = ln(mean steps between false alarms)

The bound is Lorden's (1971): with independent Gaussian noise the mean run to a false alarm is at least exp(h) steps.
The same ratio with its sign turned ends an alarm; no step has more than a share of h in it. The ratio of another,
independent witness is added in a second sum; then h is greater by ln 2. While a sum is above a quarter of h nothing is
learned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from thermal.models.heat_loss import HeatCapacity
from thermal.models.melt_exchange import MeltExchange

from .heat_balance_monitor import TwoNodeLoss

CLEAR, RESTRICTED, NO_FILAMENT, UNKNOWN = "clear", "restricted", "no_filament", "unknown"

UNKNOWNS = range(3)
Matrix = list[list[float]]


@dataclass(frozen=True, slots=True)
class FlowMonitorParameters:
    """Models of the nozzle, what to look for, and how sure to be."""

    heat: HeatCapacity
    loss: TwoNodeLoss
    melt: MeltExchange
    lost_share: float = 0.3  # loss of flow that the test is made for; greater ones are found sooner
    false_alarm_s: float = 360e3  # mean extrusion time between false alarms, at least
    noise_w_s: float = 0.15  # W s^0.5: of the balance without melt and fan
    gain: float = 1.0
    gain_sigma: float = 0.10  # of a melt that was not calibrated
    step_s: float = 2.0  # a retraction and its return weigh little in it
    flow_min_w: float = 0.3  # planned melt that takes less says nothing
    model_share: float = 0.05  # of the planned melt's heat: errors of its law when the flow changes
    stored_max_w: float = 15.0  # in a faster change of temperature the capacity is judged, not the melt
    fan_settle_s: float = 3.0  # a fan takes so long to its new speed
    fan_learn_s: float = 10.0  # for so long its cooling is learned and nothing is judged ...
    fan_doubt_w: float = 0.1  # ... if it may be wrong by more than this
    ready_steps: int = 5  # with flow, before a condition is given
    all_share: float = 0.75  # so much lost is all of it
    has_other: bool = False  # there is another witness: one sum with it, one without

    @property
    def threshold(self) -> float:
        return math.log((1 + self.has_other) * self.false_alarm_s / self.step_s)


@dataclass(frozen=True, slots=True)
class HeatReading:
    """A tenth of a second or so: what ended at `time_s`."""

    time_s: float
    temp_c: float
    second_c: float  # second mass, followed by the heat-balance monitor
    second_doubt_c: float
    heat_j: float  # into the nozzle since the reading before; NaN: not known
    planned_mm3: float  # likewise; filament that returns from a retraction is no flow
    fan: float  # 0..1
    other: float = 0.0  # log-likelihood ratio of the same loss by another witness


@dataclass(slots=True)
class Step:
    """Sums of a step under way."""

    lasts_s: float = 0.0
    taken_j: float = 0.0
    planned_j: float = 0.0
    fan_k_s: float = 0.0
    stored_j: float = 0.0
    other: float = 0.0
    disturbed: bool = False


@dataclass(slots=True)
class FlowMonitorState:
    """Memory; `unknowns` are gain, fan_w_k (W/K) and bias (W)."""

    unknowns: list[float]
    covariance: Matrix
    time_s: float = math.nan
    temp_c: float = math.nan
    fan: float = 0.0
    fan_s: float = -math.inf  # when that changed
    judged_from_s: float = -math.inf
    step: Step = field(default_factory=Step)
    flow_steps: int = 0
    evidence: float = 0.0  # the sum of the test, the greater one
    alone: float = 0.0  # without the other witness
    joint: float = 0.0
    weight: float = 0.0  # evidence for a loss since the sum was 0, and that times the missing share
    weighted_share: float = 0.0
    lost: bool = False
    lost_share: float = 0.0  # of the melt's heat, from the alarm on


def start(p: FlowMonitorParameters) -> FlowMonitorState:
    """Before the first reading."""
    spread = (p.gain_sigma, 0.01, 0.15)  # a part fan takes 5 to 12 mW/K; 0.15 W: 3 % of the losses
    covariance = [[spread[i] ** 2 if i == j else 0.0 for j in UNKNOWNS] for i in UNKNOWNS]
    return FlowMonitorState([p.gain, 0.01, 0.0], covariance)


def condition(p: FlowMonitorParameters, state: FlowMonitorState) -> str:
    """One of the words above."""
    if state.lost:
        return NO_FILAMENT if state.lost_share >= p.all_share else RESTRICTED
    return CLEAR if state.flow_steps >= p.ready_steps else UNKNOWN


def observe(p: FlowMonitorParameters, state: FlowMonitorState, reading: HeatReading) -> bool:
    """Take a reading; True when a step ended that the test used."""
    dt_s = reading.time_s - state.time_s
    before_c = state.temp_c
    state.time_s, state.temp_c = reading.time_s, reading.temp_c
    step = state.step
    if abs(reading.fan - state.fan) > 0.01:
        spread = (
            0.3 * state.unknowns[1] * (reading.fan - state.fan)
        )  # its cooling is not quite linear in its speed
        state.covariance[1][1] += spread**2
        state.fan, state.fan_s = reading.fan, reading.time_s
        doubt_w = math.sqrt(state.covariance[1][1]) * reading.fan * (reading.temp_c - p.loss.ambient_c)
        if doubt_w > p.fan_doubt_w:
            state.judged_from_s = reading.time_s + p.fan_learn_s
    if not 0.0 < dt_s < 1.0 or math.isnan(reading.heat_j):
        state.step = Step()
        return False
    mid_c = 0.5 * (reading.temp_c + before_c)
    stored_j = p.heat.at(mid_c) * (reading.temp_c - before_c)
    step.lasts_s += dt_s
    step.stored_j += stored_j
    step.other += reading.other
    step.taken_j += reading.heat_j - stored_j - dt_s * p.loss.skin_out_w(mid_c, reading.second_c)
    rise_c = max(0.0, mid_c - p.melt.inlet_c)
    step.planned_j += dt_s * p.melt.heat_w_k(reading.planned_mm3 / dt_s) * rise_c
    step.fan_k_s += dt_s * reading.fan * (mid_c - p.loss.ambient_c)
    doubt_w = p.loss.link_w_k * reading.second_doubt_c
    unsettled = reading.time_s - state.fan_s < p.fan_settle_s
    step.disturbed |= unsettled or doubt_w > 0.1
    if step.lasts_s < p.step_s:
        return False
    state.step = Step()
    if step.disturbed or abs(step.stored_j) > p.stored_max_w * step.lasts_s:
        return False
    _judge(p, state, step)
    return True


def _judge(p: FlowMonitorParameters, state: FlowMonitorState, step: Step) -> None:
    """One step of filter and test."""
    lasts_s = step.lasts_s
    planned_w = step.planned_j / lasts_s
    row = (planned_w, step.fan_k_s / lasts_s, 1.0)
    spread = [sum(state.covariance[i][j] * row[j] for j in UNKNOWNS) for i in UNKNOWNS]
    noise = p.noise_w_s**2 / lasts_s + (p.model_share * planned_w) ** 2
    variance = noise + sum(row[i] * spread[i] for i in UNKNOWNS)
    missing_w = sum(row[i] * state.unknowns[i] for i in UNKNOWNS) - step.taken_j / lasts_s  # minus innovation
    if planned_w >= p.flow_min_w and state.time_s >= state.judged_from_s:
        _test(p, state, planned_w * lasts_s, missing_w * lasts_s, lasts_s, variance, step.other)
    is_usual = missing_w < LEARN_SIGMA * math.sqrt(variance)
    if not state.lost and is_usual and state.evidence < 0.25 * p.threshold:
        _learn(state, spread, variance, -missing_w, lasts_s)


def _test(
    p: FlowMonitorParameters,
    state: FlowMonitorState,
    planned_j: float,
    missing_j: float,
    lasts_s: float,
    variance: float,
    other: float,
) -> None:
    """Page's test, for a loss or for its end."""
    state.flow_steps += 1
    looked_for_w = p.lost_share * state.unknowns[0] * planned_j / lasts_s
    ratio = (missing_j / lasts_s * looked_for_w - 0.5 * looked_for_w**2) / variance
    share = max(0.0, min(1.0, missing_j / (state.unknowns[0] * planned_j)))
    if state.lost:
        state.lost_share += LOST_WEIGHT * (share - state.lost_share)
        ratio, other = min(-ratio, END_SHARE * p.threshold), -other
    state.alone = max(0.0, state.alone + ratio)
    state.joint = max(0.0, state.joint + ratio + other)
    state.evidence = max(state.alone, state.joint)
    if state.evidence == 0.0:
        state.weight = state.weighted_share = 0.0
        return
    state.weight += max(0.0, ratio)
    state.weighted_share += max(0.0, ratio) * share
    if state.evidence > p.threshold:
        state.lost = not state.lost
        state.lost_share = state.weighted_share / state.weight if state.lost and state.weight else 0.0
        state.evidence = state.alone = state.joint = state.weight = state.weighted_share = 0.0


END_SHARE = 0.25  # of the threshold, from one step: a reading that jumped once ends no alarm
LEARN_SIGMA = 3.0  # a step that misses more may be the first of a loss
LOST_WEIGHT = 0.2  # of a step, in the share that is lost
WALK = (5e-4, 1e-5, 3e-3)  # of the unknowns, in a second


def _learn(
    state: FlowMonitorState, spread: list[float], variance: float, innovation_w: float, lasts_s: float
) -> None:
    """Kalman filter: what the step says of gain, fan and bias."""
    for i in UNKNOWNS:
        state.unknowns[i] += spread[i] / variance * innovation_w
        for j in UNKNOWNS:
            state.covariance[i][j] -= spread[i] * spread[j] / variance
        state.covariance[i][i] += WALK[i] ** 2 * lasts_s
    state.unknowns[0] = min(1.4, max(0.6, state.unknowns[0]))
