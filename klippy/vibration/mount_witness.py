"""How wide is the hole? By the vibration of the extruder's mount. The vibration witness of [nozzle_monitor].

The melt that is pressed through the hole shakes the mount at its natural frequency. Tlegenov 2018 measured the
amplitude over the hole's diameter, at one flow and temperature (nozzle_flow.AMPLITUDES). Its law in both follows from
the pressure, of which it is taken to be a power:

    amplitude = A (d0/d)^k (v/v0)^m exp(b (1/T - 1/T0))       m = n k/j,  b = beta k/j,  pressure ~ v^n d^-j exp(beta/T)

A and m are learned, or found by NOZZLE_MONITOR_CALIBRATE. The power P in a band of the width B is that of 2 B t squared
Gaussian numbers in a time t. A step of about a second has the mean ratio r of P to that of the clear nozzle, with
W = B t. Page's CUSUM adds up the logarithm of the likelihood ratio of a power that is q times as great:

    W (r (1 - 1/q) - ln q)        narrowed hole: q = (1 - restriction)^-2k        lost flow: q = (1 - lost share)^2m

The doubt of A and m is taken off r first, so a wrong m is no clog. Above a quarter of the alarm nothing is learned.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from functools import cache

from thermal.models.nozzle_flow import Melt, NozzleShape, pressure_zones_pa

KELVIN = 273.15
FLOW_MM3_S, TEMP_C = 5.0, 210.0  # v0, T0
MEDIUM = Melt(650.0, 0.66, 5000.0, 200.0)  # PLA, Tlegenov 2018, Table 1; beta is not given there [assumed]
UNKNOWN_FLOW_EXPONENT_SIGMA, FLOW_EXPONENT_SIGMA = 0.2, 0.05  # of m: by the pressure, of a calibration
FLOW_CHANGE_MAX = 1.3  # from a window to the next
SHAPE = (1.75, 20.0, 110.0, 1.0)  # mm, mm, degrees, mm: barrel, its length, cone, length of the hole


def pressure_exponents(hole_mm: float) -> tuple[float, float]:
    """n and j: d ln p/d ln v and -d ln p/d ln d of thermal/models/nozzle_flow.py."""

    def log_pressure(diameter_mm: float) -> float:
        shape = NozzleShape(*SHAPE[:3], diameter_mm, SHAPE[3])
        return math.log(sum(pressure_zones_pa(shape, MEDIUM, FLOW_MM3_S, TEMP_C)))

    step = 0.01
    rise = log_pressure(hole_mm * (1.0 - step)) - log_pressure(hole_mm * (1.0 + step))
    return MEDIUM.flow_index, rise / math.log((1.0 + step) / (1.0 - step))


@dataclass(frozen=True, slots=True)
class MountParameters:
    """The mount, the law, what to look for, and how sure to be."""

    frequency_hz: float = 200.0
    quality: float = 20.0
    hole_mm: float = 0.4
    exponent: float = 3.86
    amplitude_m_s2: float | None = None  # of the clear nozzle at v0, T0; None: learned
    flow_exponent: float | None = None  # None: by the pressure
    restriction: float = 0.1  # share of the diameter whose loss the test is made for
    lost_share: float = 0.3  # of the flow
    false_alarm_s: float = 360e3
    step_s: float = 1.0
    flow_min_mm3_s: float = 1.0
    noise_s: float = 0.5  # without flow, before anything is judged
    signal_share_min: float = 0.5  # of the power: a weaker signal is not judged
    doubt: float = 0.02  # of the law, in the logarithm of the amplitude
    doubt_sigmas: float = 1.5  # taken off before a test
    saved_doubt: float = 0.03
    exponent_doubt: float = 0.1  # of k, as a share

    @property
    def width_hz(self) -> float:
        """Of each filter: four times that of the resonance."""
        return 4.0 * self.frequency_hz / self.quality

    @property
    def noise_width_hz(self) -> float:
        """B: of the resonance behind the filters."""
        return 1.8 * self.frequency_hz / self.quality

    @property
    def lag_s(self) -> float:
        """From a step of the flow to the power behind the filters."""
        return self.quality / (math.pi * self.frequency_hz)

    @property
    def threshold(self) -> float:
        return math.log(2.0 * self.false_alarm_s / self.step_s)  # two tests

    @property
    def ready_weight(self) -> float:
        """Sum of W until A counts as known: 3.5 % of the amplitude."""
        return 200.0

    @property
    def learned_weight(self) -> float:
        """Sum of W until A is kept."""
        return 800.0

    @property
    def window_weight(self) -> float:
        """Sum of W of a diameter: 3.7 % of the amplitude, 1 % of the diameter, in 10 s direct and 60 s Bowden."""
        return 180.0


@dataclass(frozen=True, slots=True)
class MountWindow:
    """Some tens of milliseconds."""

    time_s: float
    lasts_s: float
    power: float  # mean square in the band, (m/s^2)^2
    flow_mm3_s: float
    temp_c: float
    is_disturbed: bool = False  # by motion in the band, or in doubt
    moves: bool = False


@dataclass(slots=True)
class Step:
    """Sums of a step under way."""

    lasts_s: float = 0.0
    power: float = 0.0  # power times time
    expected: float = 0.0
    expected_square: float = 0.0
    noise: float = 0.0
    log_flow: float = 0.0


@dataclass(slots=True)
class MountState:
    """Memory. `log_amplitude` and `flow_exponent` are known with `covariance`, at the flow exp(centre)."""

    log_amplitude: float
    flow_exponent: float
    variance: list[float]  # of both; they are independent at the centre
    centre: float = math.log(FLOW_MM3_S)
    covariance: float = 0.0
    weight: float = 0.0  # learned so far
    is_ready: bool = False
    is_learned: bool = False  # A is kept
    noise_power: float = 0.0
    noise_weight: float = 0.0  # s
    noise_moves: bool = False  # it is that of motion
    response: float = 0.0  # square of the expected law, behind the lag
    flow_mm3_s: float = 0.0  # of the window before
    step: Step = field(default_factory=Step)
    narrowed: float = 0.0  # sums of the two tests
    lost: float = 0.0
    evidence_steps: int = 0  # since both sums were 0
    is_narrowed: bool = False
    is_lost: bool = False
    news: float = 0.0  # log-likelihood ratio of lost flow, of the step that just ended
    recent: deque[tuple[float, float, float]] = field(
        default_factory=deque
    )  # W, ratio of power without noise, flow
    log_diameter: float = math.nan  # of d/d0
    log_sigma: float = math.nan


@cache
def law_exponents(p: MountParameters) -> tuple[float, float]:
    """m and b (K)."""
    n, j = pressure_exponents(p.hole_mm)
    m = n * p.exponent / j if p.flow_exponent is None else p.flow_exponent
    return m, MEDIUM.arrhenius_k * p.exponent / j


def start(p: MountParameters) -> MountState:
    """Before the first window."""
    m, _ = law_exponents(p)
    m_sigma = UNKNOWN_FLOW_EXPONENT_SIGMA if p.flow_exponent is None else FLOW_EXPONENT_SIGMA
    if p.amplitude_m_s2 is None:
        return MountState(0.0, m, [25.0, m_sigma**2])
    return MountState(
        math.log(p.amplitude_m_s2), m, [p.saved_doubt**2, m_sigma**2], is_ready=True, is_learned=True
    )


def _expected_square(p: MountParameters, state: MountState, flow_mm3_s: float, temp_c: float) -> float:
    """Square of the law without A, over two: a power."""
    _, b = law_exponents(p)
    log_law = state.flow_exponent * (math.log(flow_mm3_s) - state.centre)
    log_law += b * (1.0 / (temp_c + KELVIN) - 1.0 / (TEMP_C + KELVIN))
    return 0.5 * math.exp(2.0 * log_law)


def observe(p: MountParameters, state: MountState, window: MountWindow) -> bool:
    """Take a window; True when a step ended."""
    state.news = 0.0
    flowing = window.flow_mm3_s >= 0.1 * p.flow_min_mm3_s
    square = _expected_square(p, state, window.flow_mm3_s, window.temp_c) if flowing else 0.0
    share = 1.0 - math.exp(-window.lasts_s / p.lag_s)
    state.response += share * (square - state.response)
    before, state.flow_mm3_s = state.flow_mm3_s, window.flow_mm3_s
    if window.is_disturbed:
        return False
    if not flowing:
        if state.response < 1e-4:
            _learn_noise(state, window)
        return False
    if window.flow_mm3_s < p.flow_min_mm3_s or state.noise_weight < p.noise_s:
        return False
    if not before < FLOW_CHANGE_MAX * window.flow_mm3_s < FLOW_CHANGE_MAX**2 * before:
        return False  # its power is that of more than one flow
    step = state.step
    expected = state.response * math.exp(2.0 * state.log_amplitude)
    step.lasts_s += window.lasts_s
    step.power += window.power * window.lasts_s
    step.expected += (expected + state.noise_power) * window.lasts_s
    step.expected_square += (expected + state.noise_power) ** 2 * window.lasts_s
    step.noise += state.noise_power * window.lasts_s
    step.log_flow += math.log(window.flow_mm3_s) * window.lasts_s
    if step.lasts_s < p.step_s:
        return False
    state.step = Step()
    _judge(p, state, step)
    return True


def _learn_noise(state: MountState, window: MountWindow) -> None:
    """Power of the band without flow, over the last minute of it; once known, that of motion."""
    if state.noise_moves and not window.moves:
        return
    if window.moves and not state.noise_moves:
        state.noise_moves, state.noise_weight = True, 0.0
    state.noise_weight = min(60.0, state.noise_weight + window.lasts_s)
    state.noise_power += window.lasts_s / state.noise_weight * (window.power - state.noise_power)


def _judge(p: MountParameters, state: MountState, step: Step) -> None:
    ratio = step.power / step.expected
    weight = p.noise_width_hz * step.expected**2 / step.expected_square
    signal_share = 1.0 - step.noise / step.expected
    if signal_share < p.signal_share_min:
        return
    away = step.log_flow / step.lasts_s - state.centre
    variance = state.variance[0] + away**2 * state.variance[1] + 2.0 * away * state.covariance
    signal = max(1e-3, (ratio - 1.0) / signal_share + 1.0)
    if not state.is_ready:
        _learn(p, state, signal, weight, away, variance)
        return
    doubt = math.sqrt(variance + p.doubt**2)
    state.recent.append((weight, signal, away))  # logarithm of the flow, from the centre
    if _test(p, state, ratio, weight, signal_share, doubt):
        while len(state.recent) > state.evidence_steps:  # what was before the change is no longer so
            state.recent.popleft()
    while sum(w for w, _, _ in state.recent) - state.recent[0][0] >= p.window_weight:
        state.recent.popleft()
    recent_weight = sum(w for w, _, _ in state.recent)
    mean = sum(w * s for w, s, _ in state.recent) / recent_weight
    state.log_diameter = -0.5 * math.log(max(1e-6, mean)) / p.exponent
    scatter = math.sqrt(0.25 / recent_weight + doubt**2) / p.exponent
    state.log_sigma = math.hypot(scatter, p.exponent_doubt * state.log_diameter)
    quiet = 0.25 * p.threshold
    if not state.is_narrowed and not state.is_lost and state.narrowed < quiet and state.lost < quiet:
        if state.is_learned:
            _learn_flow(p, state, signal, weight, away)
        else:
            _learn(p, state, signal, weight, away, variance)


def _log_ratio(weight: float, ratio: float, times: float, signal_share: float) -> float:
    """Of the likelihoods of a signal `times` as strong and of the expected one."""
    q = 1.0 + signal_share * (times - 1.0)
    return weight * (ratio * (1.0 - 1.0 / q) - math.log(q))


def _test(
    p: MountParameters, state: MountState, ratio: float, weight: float, signal_share: float, doubt: float
) -> bool:
    """Page's tests, for a change or for its end; True when one of them found it."""
    doubt *= 2.0 * p.doubt_sigmas  # of the power
    stronger = (1.0 - p.restriction) ** (-2.0 * p.exponent)
    weaker = (1.0 - p.lost_share) ** (2.0 * state.flow_exponent)
    down = _log_ratio(weight, ratio * math.exp(doubt), stronger, signal_share)
    up = _log_ratio(weight, ratio * math.exp(-doubt), stronger, signal_share)
    state.narrowed = max(0.0, state.narrowed + (-down if state.is_narrowed else up))
    state.news = _log_ratio(weight, ratio * math.exp(doubt), weaker, signal_share)
    if state.is_narrowed or ratio > math.sqrt(stronger):
        state.news = 0.0  # a narrowed hole: more power than before says nothing of the flow
    back = -_log_ratio(weight, ratio * math.exp(-doubt), weaker, signal_share)
    state.lost = max(0.0, state.lost + (back if state.is_lost else state.news))
    state.evidence_steps = state.evidence_steps + 1 if max(state.narrowed, state.lost) > 0.0 else 0
    if max(state.narrowed, state.lost) <= p.threshold:
        return False
    if state.narrowed > p.threshold:
        state.is_narrowed, state.narrowed = not state.is_narrowed, 0.0
    if state.lost > p.threshold:
        state.is_lost, state.lost = not state.is_lost, 0.0
    return True


def _learn(
    p: MountParameters, state: MountState, signal: float, weight: float, away: float, variance: float
) -> None:
    """A clear nozzle: A and m by a Kalman filter."""
    scatter = 0.25 / weight + p.doubt**2
    innovation = 0.5 * math.log(signal) + 0.25 / weight  # the logarithm's mean is low by that
    gains = (
        (state.variance[0] + away * state.covariance) / (variance + scatter),
        (state.covariance + away * state.variance[1]) / (variance + scatter),
    )
    spread = (state.variance[0] + away * state.covariance, state.covariance + away * state.variance[1])
    state.log_amplitude += gains[0] * innovation
    state.flow_exponent += gains[1] * innovation
    state.variance[0] -= gains[0] * spread[0]
    state.covariance -= gains[0] * spread[1]
    state.variance[1] -= gains[1] * spread[1]
    state.weight += weight
    state.is_ready = state.weight >= p.ready_weight
    if state.weight >= p.learned_weight:
        state.is_learned = True
        _recentre(state)


def _recentre(state: MountState) -> None:
    """To the flow where A and m are independent: from there on A is kept."""
    shift = -state.covariance / state.variance[1]
    state.log_amplitude += state.flow_exponent * shift
    state.variance[0] += shift * state.covariance
    state.centre += shift
    state.covariance = 0.0


def _learn_flow(p: MountParameters, state: MountState, signal: float, weight: float, away: float) -> None:
    """m alone, from how a step differs from the mean of the recent ones: a narrower hole changes them all alike."""
    recent_weight = sum(w for w, _, _ in state.recent)
    away -= sum(w * x for w, _, x in state.recent) / recent_weight
    innovation = 0.5 * math.log(signal) + 0.25 / weight + p.exponent * state.log_diameter
    scatter = 0.25 / weight + p.doubt**2
    gain = away * state.variance[1] / (away**2 * state.variance[1] + scatter)
    state.flow_exponent += gain * innovation
    state.flow_exponent = min(2.0, max(0.3, state.flow_exponent))
    state.variance[1] = max(1e-4, state.variance[1] - gain * away * state.variance[1])
