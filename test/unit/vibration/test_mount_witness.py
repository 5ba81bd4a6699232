"""The vibration witness of [nozzle_monitor] on signals of a ringing mount: diameters of Tlegenov 2018, its tests."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from thermal.models.nozzle_flow import AMPLITUDES
from vibration import mount_witness
from vibration.band_meter import BandMeter, SampleFormat, design
from vibration.mount_witness import MountParameters, MountState, MountWindow

DIRECT = MountParameters()
BOWDEN = MountParameters(16.0, 10.0, 0.35, 4.91)
# Tables 2 and 3: diameter mm, measured m/s^2
TABLES = {
    "direct": (DIRECT, 10.0, [0.4, 0.3969, 0.3901, 0.3813, 0.3659, 0.3454],
               [0.6479, 0.6554, 0.6848, 0.7414, 0.8769, 1.1128]),
    "bowden": (BOWDEN, 60.0, [0.35, 0.3441, 0.3374, 0.3239, 0.3069, 0.2839],
               [0.252, 0.2635, 0.28, 0.3403, 0.4596, 0.6705]),
}  # fmt: skip
RATE_HZ = 800.0
WINDOW = 40
FORMAT = SampleFormat(6, False, 32000, (0.0, 0.0, 0.002))


def ringing(p: MountParameters, amplitude: float, seconds: float, seed: int) -> bytes:
    """Samples of a mount that rings at random with an amplitude (sqrt(2) rms), gravity and noise on it."""
    rng = np.random.default_rng(seed)
    count = int((seconds + 20.0 * p.lag_s) * RATE_HZ)
    turn, fall = 2.0 * math.pi * p.frequency_hz / RATE_HZ, math.pi * p.frequency_hz / p.quality / RATE_HZ
    pole = math.exp(-fall) * np.exp(1j * turn)
    ring = signal.lfilter([1.0], np.poly([pole, pole.conjugate()]).real, rng.standard_normal(count))
    # gain of white noise in such a resonance, so that the size is not fitted to this very stretch
    _, h = signal.freqz([1.0], np.poly([pole, pole.conjugate()]).real, worN=1 << 16)
    ring *= amplitude / math.sqrt(2.0) / math.sqrt(np.mean(np.abs(h) ** 2))
    z = (ring + 9.81 + rng.normal(0.0, 0.08, count))[-int(seconds * RATE_HZ) :]
    counts = np.zeros((len(z), 3))
    counts[:, 2] = np.round(z / FORMAT.weight_m_s2[2])
    return counts.astype("<i2").tobytes()


def settled(p: MountParameters) -> MountState:
    """Before the first extrusion: a second at rest has been seen."""
    state = mount_witness.start(p)
    mount_witness.observe(p, state, MountWindow(-1.0, 1.0, 1e-6, 0.0, 230.0))
    return state


def mean_power(p: MountParameters, amplitude: float, seconds: float, seed: int) -> list[float]:
    settle_s = 12.0 * p.lag_s
    meter = BandMeter(FORMAT, WINDOW, round(settle_s * RATE_HZ))
    meter.set_sections(design(p.frequency_hz, p.width_hz, [], RATE_HZ))
    data = ringing(p, amplitude, seconds + settle_s + 0.1, seed)
    return [
        w.power
        for at in range(0, len(data), 240)
        for w in meter.take(at // 6, data[at : at + 240])
        if w.settled
    ]


@pytest.mark.parametrize("kind", TABLES)
def test_the_diameters_of_the_source_are_found_in_still_air(kind: str) -> None:
    p, seconds, diameters, measured = TABLES[kind]
    law = AMPLITUDES[kind]
    factors = [math.log(a / law.amplitude_m_s2(d)) for d, a in zip(diameters, measured, strict=True)]
    factor = math.exp(sum(factors) / len(factors))  # the laws fit the tables' theory, 4 to 7 % lower
    clear = mean_power(p, 1.0, 10.0 * seconds, 1)
    gain = math.sqrt(2.0 * sum(clear) / len(clear))  # of the band, as a calibration has it
    p = replace(p, amplitude_m_s2=law.base_m_s2 * factor * gain)
    for seed, (diameter, amplitude) in enumerate(zip(diameters, measured, strict=True), 2):
        state = settled(p)
        for number, power in enumerate(mean_power(p, amplitude, seconds, seed)):
            lasts_s = WINDOW / RATE_HZ
            window = MountWindow(
                number * lasts_s, lasts_s, power, mount_witness.FLOW_MM3_S, mount_witness.TEMP_C
            )
            mount_witness.observe(p, state, window)
        assert p.hole_mm * math.exp(state.log_diameter) == pytest.approx(diameter, rel=0.03)


class Mount:
    """Band power by its statistics: that of 2 B t squared Gaussian numbers, by a law of its own."""

    def __init__(self, seed: int = 1, p: MountParameters | None = None, flow_exponent: float = 1.0) -> None:
        self.p = p or MountParameters()
        self.state = settled(self.p)
        self.random = random.Random(seed)
        self.time_s = 0.0
        self.flow_exponent = flow_exponent
        self.alarms = 0

    def run(
        self, seconds: float, hole_mm: float = 0.4, share: float = 1.0, flow: float = 4.0
    ) -> float | None:
        """Returns the seconds until a test found a change."""
        begin_s = self.time_s
        weight = self.p.noise_width_hz * 0.25
        while self.time_s < begin_s + seconds:
            self.time_s += 0.25
            planned = flow * (1.0 + 0.3 * math.sin(self.time_s / 3.0))
            amplitude = (
                0.5
                * (0.4 / hole_mm) ** (0.95 * self.p.exponent)
                * (share * planned / 5.0) ** self.flow_exponent
            )
            power = 0.5 * amplitude**2 * self.random.gammavariate(weight, 1.0 / weight) + 1e-6
            before = self.state.is_narrowed, self.state.is_lost
            mount_witness.observe(self.p, self.state, MountWindow(self.time_s, 0.25, power, planned, 230.0))
            if (self.state.is_narrowed, self.state.is_lost) != before:
                self.alarms += 1
                return self.time_s - begin_s
        return None


@pytest.mark.parametrize("flow_exponent", [0.7, 1.0, 1.3])
def test_a_tenth_of_the_diameter_is_found_within_ten_seconds(flow_exponent: float) -> None:
    for seed in range(20):
        mount = Mount(seed, flow_exponent=flow_exponent)
        assert mount.run(120.0) is None
        found_s = mount.run(10.0, hole_mm=0.36)
        assert found_s is not None and mount.state.is_narrowed and not mount.state.is_lost
        assert mount.run(10.0, hole_mm=0.36) is None  # a diameter takes ten seconds
        assert 0.4 * math.exp(mount.state.log_diameter) == pytest.approx(0.36, rel=0.05)
        assert mount.run(30.0) is not None and not mount.state.is_narrowed


def test_a_bowden_mount_needs_less_than_45_seconds() -> None:
    for seed in range(20):
        mount = Mount(seed, MountParameters(16.0, 10.0, 0.4, 4.91))
        assert mount.run(600.0) is None
        assert mount.run(45.0, hole_mm=0.36) is not None


@pytest.mark.parametrize("share", [0.7, 0.0])
def test_lost_flow_is_found_within_twenty_seconds_by_vibration_alone(share: float) -> None:
    for seed in range(20):
        mount = Mount(seed)
        assert mount.run(120.0) is None
        assert mount.run(20.0, share=share) is not None
        assert mount.state.is_lost and not mount.state.is_narrowed


def test_clean_hours_have_no_alarm_even_if_the_flow_changes_later() -> None:
    for seed, flow_exponent in enumerate((0.7, 1.0, 1.3)):
        mount = Mount(seed, flow_exponent=flow_exponent)
        for flow in (3.0, 8.0, 2.0, 5.0):
            assert mount.run(2000.0, flow=flow) is None


def test_a_clog_that_grows_through_the_first_layer_is_not_learned() -> None:
    mount = Mount()
    assert mount.run(60.0) is None
    for hole_um in range(400, 340, -1):
        if mount.run(10.0, hole_mm=1e-3 * hole_um) is not None:
            break
    assert mount.state.is_narrowed and hole_um >= 360


def test_motion_in_the_band_slow_flow_and_weak_signals_are_not_judged() -> None:
    mount = Mount()
    mount.run(60.0)
    strong = MountWindow(0.0, 2.0, 9.9, 4.0, 230.0)
    for window in (replace(strong, is_disturbed=True), replace(strong, flow_mm3_s=0.5)):
        assert not mount_witness.observe(mount.p, mount.state, window)
    noisy = Mount()
    noisy.state.noise_power = 1.0
    assert noisy.run(600.0, hole_mm=0.3) is None and not noisy.state.is_ready
