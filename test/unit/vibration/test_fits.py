"""Spectra and shapers: against scipy, on a frame's computed response to the test's own motion."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from vibration.excitation import Excitation, split_at_rest
from vibration.fit_shaper import TEST_DAMPING_RATIOS, calibrate, find_resonance
from vibration.fit_spectrum import DataError, Spectrum, of_samples, read, read_spectrum, welch, write_spectrum
from vibration.shapers import parse

ROOT = Path(__file__).resolve().parents[3]
RATE = 3200.0
F0, Z0 = 54.0, 0.06


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    """What an accelerometer on a mass of F0, Z0 sees of a test, with noise. scipy integrates."""
    times, speeds = [0.0], [0.0]
    for duration, accel, _ in Excitation(max_hz=100.0).stretches():
        times.append(times[-1] + duration)
        speeds.append(speeds[-1] + accel * duration)
    t = np.arange(0.0, times[-1], 1.0 / RATE)
    motor = np.interp(t, times, speeds)
    w = 2.0 * np.pi * F0
    mass = signal.lsim(([2 * Z0 * w, w * w], [1.0, 2 * Z0 * w, w * w]), motor, t)[1]
    rng = np.random.default_rng(3)
    rows = rng.normal(0.0, 150.0, (len(t), 4))
    rows[:, 0] = t
    rows[:, 1] += np.gradient(mass, t)
    return rows


@pytest.mark.parametrize("count", [5000, 4096, 700])
def test_the_spectrum_is_scipys(count: int) -> None:
    values = np.random.default_rng(1).normal(size=(3, count)).cumsum(axis=1)
    frequency, density = welch(values, RATE)
    size = min(2048, count)
    expected = signal.welch(values, RATE, "hann", size, size // 2, detrend="constant")
    assert frequency == pytest.approx(expected[0])
    assert density == pytest.approx(expected[1], rel=1e-9)


def test_the_test_ends_where_it_began_at_rest() -> None:
    for excitation in (Excitation(max_hz=20.0), Excitation(max_hz=20.0, sweeping_period_s=0.0)):
        place = speed = 0.0
        for duration, accel, _ in excitation.stretches():
            for part, start in split_at_rest(duration, speed, accel):
                place += start * part + 0.5 * accel * part**2
            speed += accel * duration
        assert (place, speed) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_pulses_rise_at_the_rate_asked_for() -> None:
    pulses = list(Excitation(min_hz=10.0, max_hz=40.0, hz_per_s=2.0).pulses())
    assert sum(duration for duration, _, _ in pulses) == pytest.approx(15.0, rel=0.02)
    assert all(b[2] >= a[2] for a, b in pairwise(pulses))
    assert {round(abs(accel) / hz, 6) for _, accel, hz in pulses} == {60.0}


def test_the_resonance_is_found(samples: np.ndarray) -> None:
    hz, damping = find_resonance(of_samples(samples), 0)
    assert hz == pytest.approx(F0, abs=0.5)
    assert damping == pytest.approx(Z0, rel=0.25)


def _left_by_simulation(text: str, shaper_hz: float, frequency_hz: float, damping: float) -> float:
    """What an oscillator of scipy's still does when the last impulse is over, as a share of one impulse."""
    amplitudes, times = parse(text).pulses(shaper_hz, 0.1)
    w = 2.0 * np.pi * frequency_hz
    system = signal.StateSpace(
        [[0.0, 1.0], [-w * w, -2 * damping * w]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1))
    )
    state, last = np.zeros(2), 0.0
    for amplitude, t in zip(amplitudes, times, strict=True):
        if t > last:
            state = signal.lsim(system, np.zeros(2), [0.0, t - last], X0=state)[2][-1]
        state = state + np.array([0.0, amplitude])
        last = t
    damped = w * np.sqrt(1.0 - damping**2)
    return float(np.hypot(state[0] * damped, state[1] + damping * w * state[0]))


def test_the_choice_is_within_two_percent_of_an_independent_computation(samples: np.ndarray) -> None:
    """scipy's spectrum, and an oscillator that scipy moves, on a grid of 1 Hz around the found frequencies."""
    report, _ = calibrate(of_samples(samples))
    frequency, density = signal.welch(samples[:, 1:].T, RATE, "hann", 2048, 1024, detrend="constant")
    kept = (frequency >= 20.0) & (frequency <= 100.0)
    weight = density.sum(axis=0)[kept] / frequency[kept]
    over = weight > weight.max() / 20.0
    for choice in report["shapers"][:2]:
        grid = np.arange(choice["frequency_hz"] - 1.0, choice["frequency_hz"] + 1.1, 0.5)
        lefts = []
        for shaper_hz in grid:
            worst = 0.0
            for z in TEST_DAMPING_RATIOS:
                left = np.array(
                    [_left_by_simulation(choice["shaper"], shaper_hz, f, z) for f in frequency[kept][over]]
                )
                rest = np.maximum(left * weight[over] - weight.max() / 20.0, 0.0).sum()
                worst = max(worst, rest / (weight[over] - weight.max() / 20.0).sum())
            lefts.append(worst)
        best = grid[np.flatnonzero(np.array(lefts) <= min(lefts) + 0.001)[-1]]
        assert choice["frequency_hz"] == pytest.approx(best, rel=0.02)


def test_smoother_shapers_are_left_out_on_request(samples: np.ndarray) -> None:
    spectrum = of_samples(samples)
    free, _ = calibrate(spectrum)
    tight, _ = calibrate(spectrum, max_smoothing=0.06)
    assert any(c["smoothing_mm"] > 0.06 for c in free["shapers"])
    assert all(c["smoothing_mm"] <= 0.06 for c in tight["shapers"])
    with pytest.raises(DataError, match="No shaper keeps the smoothing"):
        calibrate(spectrum, max_smoothing=0.001)


def test_files_are_read_as_they_are_written(tmp_path: Path, samples: np.ndarray) -> None:
    _, spectrum = calibrate(of_samples(samples))
    write_spectrum(tmp_path / "a.csv", spectrum)
    again = read_spectrum([tmp_path / "a.csv"])
    assert again.psd == pytest.approx(spectrum.psd, rel=1e-3)
    assert again.shapers.keys() == spectrum.shapers.keys()
    raw = "#time,accel_x,accel_y,accel_z\n1,2,3,4\n"
    for text, problem in (("freq,psd_x\n1,2\n", "neither raw data"), (raw, "1 samples")):
        (tmp_path / "b.csv").write_text(text)
        with pytest.raises(DataError, match=problem):
            read(tmp_path / "b.csv")


def test_the_scripts_make_pictures(tmp_path: Path, samples: np.ndarray) -> None:
    raw = tmp_path / "raw.csv"
    np.savetxt(raw, samples[:20000], "%.6f", ",", header="time,accel_x,accel_y,accel_z", comments="#")
    for script, options in (
        ("calibrate_shaper.py", ["--csv", tmp_path / "s.csv"]),
        ("graph_accelerometer.py", []),
        ("graph_accelerometer.py", ["--raw"]),
    ):
        picture = tmp_path / "p.png"
        command = [sys.executable, ROOT / "scripts" / script, raw, "-o", picture, *options]
        subprocess.run(command, check=True, capture_output=True)
        assert picture.read_bytes()[:4] == b"\x89PNG"
        picture.unlink()
    assert isinstance(read(tmp_path / "s.csv"), Spectrum)
