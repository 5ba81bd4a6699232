"""The band-power meter of mount_band.c: its filters, and its windows.

The filters are those of Orfanidis (Introduction to Signal Processing, 1996, ch. 11): with w0 the frequency and bw the
width at -3 dB in radians a sample,

    gain = 1/(1 + tan(bw/2))        peak: (1 - gain)(1 - z^-2)            notch: gain (1 - 2 cos w0 z^-1 + z^-2)
                                    denominator of both: 1 - 2 gain cos w0 z^-1 + (2 gain - 1) z^-2
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from chelper import get_ffi

Section = tuple[float, float, float, float, float]  # b0, b1, b2, a1, a2
WINDOWS_MAX = 64  # of a call
PEAKS = 2  # one after the other: 12 dB an octave to each side


def _shape(hz: float, width_hz: float, rate_hz: float) -> tuple[float, float]:
    gain = 1.0 / (1.0 + math.tan(math.pi * width_hz / rate_hz))
    return gain, math.cos(2.0 * math.pi * hz / rate_hz)


def peak(hz: float, width_hz: float, rate_hz: float) -> Section:
    """Passes a band."""
    gain, cosine = _shape(hz, width_hz, rate_hz)
    return 1.0 - gain, 0.0, gain - 1.0, -2.0 * gain * cosine, 2.0 * gain - 1.0


def notch(hz: float, width_hz: float, rate_hz: float) -> Section:
    """Takes a band out."""
    gain, cosine = _shape(hz, width_hz, rate_hz)
    return gain, -2.0 * gain * cosine, gain, -2.0 * gain * cosine, 2.0 * gain - 1.0


def design(
    hz: float, width_hz: float, notches: Sequence[tuple[float, float]], rate_hz: float
) -> list[Section]:
    """The band, and the notches (frequency, width) below half the rate."""
    cut = [notch(at_hz, wide_hz, rate_hz) for at_hz, wide_hz in notches if at_hz + wide_hz < 0.45 * rate_hz]
    return [peak(hz, width_hz, rate_hz)] * PEAKS + cut


@dataclass(frozen=True, slots=True)
class SampleFormat:
    """How a chip's samples come, and what they are along the axis of interest."""

    sample_bytes: int
    is_big_endian: bool
    clip_counts: int
    weight_m_s2: tuple[float, float, float]  # of a count of x, y, z


class BandMeter:
    """One sensor's stream."""

    def __init__(self, format: SampleFormat, window_samples: int, settle_samples: int) -> None:
        ffi, self._lib = get_ffi()
        self._band: Any = ffi.new("struct mount_band *")
        self._windows: Any = ffi.new("struct band_window[]", WINDOWS_MAX)
        band = self._band
        band.packed, band.is_big_endian = format.sample_bytes == 5, format.is_big_endian
        band.clip_counts, band.weight = format.clip_counts, format.weight_m_s2
        band.window_samples, band.settle_samples = window_samples, settle_samples
        self._sample_bytes = format.sample_bytes
        self._slice_bytes = (WINDOWS_MAX - 1) * window_samples * format.sample_bytes

    def set_sections(self, sections: Sequence[Section]) -> None:
        """Other filters from the next sample on; their memory stays."""
        self._band.section_count = len(sections)
        for number, section in enumerate(sections):
            self._band.sections[number] = section

    def take(self, first: int, data: bytes) -> Iterator[Any]:
        """The windows (struct band_window) that end in some samples; each is valid until the next one."""
        size = self._slice_bytes
        for at in range(0, len(data), size):
            part = data[at : at + size]
            count = self._lib.mount_band_take(
                self._band, first + at // self._sample_bytes, part, len(part), self._windows, WINDOWS_MAX
            )
            for number in range(count):
                yield self._windows[number]
