"""Clock estimation from samples, and the secondary clock, without a link."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

import clockfit_reference
from clockfit_reference import widest_strip
from clocksync import ClockEstimator, ClockLine, ClockSample, ClockSync, SecondarySync, fit_clock_line
from link.clockfit import fit_strip
from reactor import Reactor

FREQ = 72e6


class Oscillator:
    """A true clock: starts at `clock_0`, runs off by `ppm`, and drifts by `drift_ppm_min` a minute."""

    def __init__(self, ppm: float, clock_0: float = 5e9, drift_ppm_min: float = 0.0) -> None:
        self.ppm, self.clock_0, self.drift_ppm_min = ppm, clock_0, drift_ppm_min

    def at(self, time_s: float) -> float:
        fast = self.ppm * 1e-6 * time_s + 0.5 * self.drift_ppm_min * 1e-6 / 60.0 * time_s**2
        return self.clock_0 + FREQ * (time_s + fast)


def sample(
    osc: Oscillator, time_s: float, wait: Callable[[], float], latency_s: float = 0.0005
) -> ClockSample:
    there = latency_s + wait()
    return ClockSample(time_s, time_s + there + latency_s + wait(), int(osc.at(time_s + there)))


def run(osc: Oscillator, seconds: int, wait: Callable[[], float]) -> list[float]:
    """Errors (s) of the estimate half a second after each sample, when it is used and not renewed."""
    estimator = ClockEstimator(FREQ)
    errors = []
    times = [n * 0.05 for n in range(8)] + [0.5 + n * 0.97 for n in range(seconds)]
    for t in times:
        line = estimator.add(sample(osc, t, wait))
        errors.append((line.clock_at(t + 0.5) - osc.at(t + 0.5)) / FREQ)
    return errors


def test_without_jitter_the_line_is_exact() -> None:
    errors = run(Oscillator(80.0), 60, lambda: 0.0)
    # one tick is 14 ns; the prior on frequency holds the slope back by some ppm in the first seconds
    assert max(abs(e) for e in errors[:8]) < 50e-6
    assert max(abs(e) for e in errors[30:]) < 0.1e-6


@pytest.mark.parametrize("ppm", [80.0, -200.0])
@pytest.mark.parametrize("seed", range(3))
def test_converges_to_10_us_under_jitter(ppm: float, seed: int) -> None:
    rng = random.Random(seed)
    # two answers in four do not wait, one waits for tens of us, one for ms: queues
    errors = run(Oscillator(ppm), 120, lambda: rng.choice([0.0, 0.0, rng.expovariate(1 / 100e-6), 0.005]))
    assert max(abs(e) for e in errors[60:]) < 10e-6


def test_follows_a_warming_crystal() -> None:
    rng = random.Random(1)
    errors = run(
        Oscillator(20.0, drift_ppm_min=2.0), 300, lambda: rng.choice([0.0, rng.expovariate(1 / 50e-6)])
    )
    assert max(abs(e) for e in errors[60:]) < 20e-6


def test_sample_held_up_for_long_changes_little() -> None:
    samples = [sample(Oscillator(0.0), n * 0.97, lambda: 0.0) for n in range(20)]
    late = ClockSample(20.0, 20.5, int(Oscillator(0.0).at(20.45)))  # 450 ms there, 50 ms back
    line = fit_clock_line([*samples, late], FREQ)
    assert abs(line.clock_at(21.0) - Oscillator(0.0).at(21.0)) / FREQ < 2e-6


def test_line_converts_both_ways() -> None:
    line = ClockLine(10.0, 1e12, 72e6)
    assert line.time_of(line.clock_at(12.345)) == pytest.approx(12.345, abs=1e-9)


# --- 64-bit clocks and conversions ---


def synced(reactor: Any, line: ClockLine, sync: ClockSync | None = None) -> ClockSync:
    sync = sync or ClockSync(reactor)
    sync.mcu_freq = FREQ
    sync._estimator = ClockEstimator(FREQ)
    sync._estimator.line = line
    sync._last_clock = int(line.clock)
    return sync


@pytest.mark.parametrize("offset", [0, 1, -1, 2**31 - 1, -(2**31) + 1])
@pytest.mark.parametrize("base", [5, 2**32 - 3, 2**40 + 123])
def test_32_bit_clocks_are_extended_to_the_nearest(base: int, offset: int) -> None:
    sync = synced(Reactor(), ClockLine(0.0, base, FREQ))
    assert sync.clock32_to_clock64((base + offset) & 0xFFFFFFFF) == base + offset


def test_print_time_is_the_first_mcus_clock_at_its_nominal_rate() -> None:
    sync = synced(Reactor(), ClockLine(100.0, 50.0 * FREQ, FREQ * (1 + 80e-6)))
    assert sync.estimated_print_time(110.0) == pytest.approx(60.0 + 10 * 80e-6, abs=1e-6)
    assert sync.print_time_to_clock(60.0) == int(60 * FREQ)
    assert sync.clock_to_print_time(sync.print_time_to_clock(60.0)) == pytest.approx(60.0)


def test_secondary_bends_without_a_jump_and_meets_the_truth() -> None:
    reactor = Reactor()
    main = synced(reactor, ClockLine(100.0, 50.0 * FREQ, FREQ * (1 + 80e-6)))
    second = SecondarySync(reactor, main)
    synced(reactor, ClockLine(100.0, 7.0 * FREQ, FREQ * (1 - 50e-6)), second)
    second._adjusted_freq, second._offset_s = FREQ, 43.0 - 0.001  # 1 ms off at print time 50
    before = second.print_time_to_clock(50.5)
    second.calibrate_clock(50.5, 100.0)
    assert abs(second.print_time_to_clock(50.5) - before) <= 1, "no jump at the bend"
    for n in range(1, 30):
        second.calibrate_clock(50.5 + n, 100.0 + n)
    print_time = 81.0
    system_s = main.estimate_clock_systime(main.print_time_to_clock(print_time))
    error_s = (second.print_time_to_clock(print_time) - second.line.clock_at(system_s)) / FREQ
    # each second takes away a quarter of the error: 1 ms * 0.75**30
    assert abs(error_s) < 1e-6


def test_secondary_converts_both_ways() -> None:
    reactor = Reactor()
    main = synced(reactor, ClockLine(0.0, 0.0, FREQ))
    second = SecondarySync(reactor, main)
    synced(reactor, ClockLine(0.0, 3e6, FREQ * 1.0001), second)
    second._adjusted_freq, second._offset_s = FREQ * 1.0001, -0.04
    assert second.clock_to_print_time(second.print_time_to_clock(12.5)) == pytest.approx(12.5, abs=1e-7)


# --- the strip between the bounds ---


def test_the_strip_leans_on_the_luckiest_answers() -> None:
    highs = [(0.0, 5.0), (1.0, 2.0), (2.0, 9.0), (3.0, 2.5)]
    lows = [(0.0, -3.0), (1.0, 0.0), (2.0, 1.0), (3.0, -8.0)]
    # highs' hull is 2 at x=1 and 2.25 at x=2; closest to the lows at x=2 (distance 1.25), where it has slope 0.25
    assert widest_strip(highs, lows) == pytest.approx(0.25)


def test_one_answer_says_nothing_of_the_slope() -> None:
    assert widest_strip([(0.0, 1.0)], [(0.0, -1.0)]) == 0.0


@pytest.mark.parametrize("step_s", [0.97, 0.05])
@pytest.mark.parametrize("count", [1, 2, 3, 47])
def test_the_fit_is_its_plain_twin_s_to_the_last_bit(count: int, step_s: float) -> None:
    for seed in range(50):
        rng = random.Random(seed)
        oscillator = Oscillator(rng.uniform(-80.0, 80.0))
        samples = [
            sample(oscillator, n * step_s, lambda rng=rng: rng.choice([0.0, rng.expovariate(1 / 50e-6)]))
            for n in range(count)
        ]
        curvature = rng.uniform(-1e-7, 1e-7)
        assert fit_strip(samples, FREQ, curvature) == clockfit_reference.fit_strip(samples, FREQ, curvature)


@pytest.mark.parametrize("drift_ppm_min", [0.0, 2.0, -2.0])
@pytest.mark.parametrize("seed", range(2))
def test_often_asked_boards_agree_to_some_us_whatever_the_crystals_do(
    seed: int, drift_ppm_min: float
) -> None:
    """Half a millisecond of jitter in a round trip, a second after the answers that the line is drawn from."""
    rng = random.Random(seed)
    osc = Oscillator(80.0, drift_ppm_min=drift_ppm_min)
    estimator = ClockEstimator(FREQ)
    time_s, errors = 0.0, []
    while time_s < 150.0:
        time_s += 0.02 if time_s < 12.0 else 0.1
        line = estimator.add(sample(osc, time_s, lambda: rng.uniform(0.0, 250e-6)))
        errors.append((time_s, abs(line.clock_at(time_s + 1.0) - osc.at(time_s + 1.0)) / FREQ))
    assert max(error for at_s, error in errors if at_s > 8.0) < 10e-6
    # seen afterwards: the drift is known by then
    assert estimator.curvature * 60e6 == pytest.approx(drift_ppm_min, abs=0.2)


def test_without_motion_the_secondary_follows_by_itself() -> None:
    reactor = Reactor()
    now = reactor.monotonic()
    main = synced(reactor, ClockLine(now, 50.0 * FREQ, FREQ))
    second = SecondarySync(reactor, main)
    synced(reactor, ClockLine(now, 7.0 * FREQ, FREQ), second)
    second._adjusted_freq, second._offset_s = FREQ, 43.0 - 0.001  # 1 ms off
    second._take_sample = lambda params: None  # type: ignore[method-assign]
    second._on_clock({})
    print_time = main.estimated_print_time(now) + 5.0
    error_s = second.print_time_to_clock(print_time) / FREQ - (print_time - 43.0)
    assert abs(error_s) < 0.5e-3, "nobody asked for a calibration, and it was made"
