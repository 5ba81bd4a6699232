"""Band power of raw accelerometer messages (mount_band.c): filters against scipy, streaming against offline."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from vibration.band_meter import BandMeter, SampleFormat, Section, design, notch, peak

RATE_HZ = 800.0
WINDOW = 40
LITTLE = SampleFormat(6, False, 32000, (0.0, -0.002, 0.001))


def counts(samples: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(-4000, 4000, (samples, 3))


def powers(format_: SampleFormat, data: bytes, sections: list[Section], chunks: list[int]) -> list[float]:
    """Of the windows of a stream that comes in messages of so many samples."""
    meter = BandMeter(format_, WINDOW, 0)
    meter.set_sections(sections)
    found, number, size = [], 0, format_.sample_bytes
    while number * size < len(data):
        chunk = chunks[len(found) % len(chunks)]
        message = data[number * size : (number + chunk) * size]
        found += [window.power for window in meter.take(number, message)]
        number += chunk
    return found


@pytest.mark.parametrize(("hz", "width_hz"), [(200.0, 20.0), (16.0, 3.2), (320.0, 40.0)])
def test_the_filters_are_those_of_scipy(hz: float, width_hz: float) -> None:
    for ours, theirs in (
        (peak(hz, width_hz, RATE_HZ), signal.iirpeak(hz, hz / width_hz, RATE_HZ)),
        (notch(hz, width_hz, RATE_HZ), signal.iirnotch(hz, hz / width_hz, RATE_HZ)),
    ):
        b, a = theirs
        assert ours == pytest.approx((*b, *a[1:]), abs=1e-12)
        at = np.linspace(1.0, 399.0, 300)
        _, response = signal.freqz(ours[:3], [1.0, *ours[3:]], worN=at, fs=RATE_HZ)
        assert np.abs(response) == pytest.approx(np.abs(signal.freqz(b, a, worN=at, fs=RATE_HZ)[1]), abs=1e-9)


@pytest.mark.parametrize("chunks", [[8], [1], [3, 17, 40], [400]])
def test_streaming_equals_offline(chunks: list[int]) -> None:
    raw = counts(2000)
    sections = design(200.0, 20.0, [(47.0, 9.0), (38.0, 8.0)], RATE_HZ)
    along = raw @ np.array(LITTLE.weight_m_s2)
    y = along - along[0]
    for b0, b1, b2, a1, a2 in sections:
        y = signal.lfilter([b0, b1, b2], [1.0, a1, a2], y)
    expected = (y**2).reshape(-1, WINDOW).mean(axis=1)
    assert powers(LITTLE, raw.astype("<i2").tobytes(), sections, chunks) == pytest.approx(expected, rel=1e-9)


def test_a_notch_beyond_half_the_rate_is_left_out() -> None:
    assert len(design(200.0, 20.0, [(47.0, 9.0), (500.0, 10.0)], RATE_HZ)) == 3


def packed(raw: np.ndarray) -> bytes:
    """The five bytes of an ADXL345 (src/accelerometers.c), a sample each."""
    rows = []
    for x, y, z in raw & 0x1FFF:
        rows.append(bytes([x & 255, y & 255, z & 255, x >> 8 | (z >> 8 & 7) << 5, y >> 8 | (z >> 11) << 5]))
    return b"".join(rows)


def test_all_byte_orders_are_the_same_samples() -> None:
    raw = counts(400)
    big = SampleFormat(6, True, 32000, LITTLE.weight_m_s2)
    five = SampleFormat(5, False, 32000, LITTLE.weight_m_s2)
    sections = [peak(200.0, 20.0, RATE_HZ)]
    expected = powers(LITTLE, raw.astype("<i2").tobytes(), sections, [8])
    assert len(expected) == 10
    assert powers(big, raw.astype(">i2").tobytes(), sections, [8]) == expected
    assert powers(five, packed(raw), sections, [10]) == expected


def test_what_shows_a_broken_sensor_is_counted() -> None:
    format_ = SampleFormat(5, False, 4000, (0.0, 0.0, 0.001))
    meter = BandMeter(format_, WINDOW, 100)
    raw = counts(3 * WINDOW) // 4
    raw[5:8, 1] = 4050
    raw[WINDOW : 2 * WINDOW] = (7, -8, 250)
    first = list(meter.take(0, packed(raw[:WINDOW])))
    assert (first[0].clipped, first[0].same, first[0].settled) == (4, 0, 0)  # and the way back
    second = list(meter.take(WINDOW, packed(raw[WINDOW : 2 * WINDOW])))
    assert (second[0].same, list(second[0].mean)) == (WINDOW - 1, [7.0, -8.0, 250.0])
    third = list(meter.take(2 * WINDOW, b"\xff" * 5 + packed(raw[2 * WINDOW : 3 * WINDOW - 1])))
    assert (third[0].failures, third[0].same) == (1, 0)


def test_damaged_data_are_counted_and_knocks_are_not() -> None:
    """At random bytes more than half of the samples jump by half the range; a knock rings for some samples."""
    meter = BandMeter(LITTLE, WINDOW, 0)
    meter.set_sections([])
    random = np.random.default_rng(1).integers(-32000, 32000, (400, 3)).astype("<i2").tobytes()
    assert all(window.clipped > WINDOW // 2 for window in meter.take(0, random))
    ringing = 12000.0 * np.exp(-np.arange(400) / 20.0) * np.sin(2.0 * np.pi * 0.25 * np.arange(400))
    meter = BandMeter(LITTLE, WINDOW, 0)
    meter.set_sections([])
    knock = np.stack([ringing, 0.5 * ringing, 4000 + ringing], axis=1).astype("<i2").tobytes()
    assert [window.clipped for window in meter.take(0, knock)] == [0] * 10


def test_after_a_gap_the_filters_settle_first() -> None:
    meter = BandMeter(LITTLE, WINDOW, 2 * WINDOW)
    meter.set_sections([peak(200.0, 20.0, RATE_HZ)])
    data = counts(10 * WINDOW).astype("<i2").tobytes()
    settled = [window.settled for window in meter.take(0, data)]
    assert settled == [0, 0] + 8 * [1]
    assert [(w.first, w.settled) for w in meter.take(12 * WINDOW + 7, data)][:3] == [
        (12 * WINDOW + 7, 0), (13 * WINDOW + 7, 0), (14 * WINDOW + 7, 1),
    ]  # fmt: skip
