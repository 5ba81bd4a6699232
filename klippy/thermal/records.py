"""The records that travel between the stages of the thermal chain.

Every quantity carries its unit in its name. `time_s` is always print time: seconds on the clock the whole
printer shares. Raw values are ADC codes (LSB); signal units are those of Oskolkov 2021's "error", about 0.8 per
degree at low power. Named tuples: hundreds are made every second, in a third of a frozen dataclass's time.
"""

from __future__ import annotations

from typing import NamedTuple

PHASE_MAX_TICKS = (
    45000  # 180 degrees: full drive (Oskolkov 2021, section 2.2); the MCU exports it as BRIDGE_PHASE_MAX
)


class SampleBlock(NamedTuple):
    """A sum of consecutive synchronous samples that were all taken under one bridge phase."""

    sequence: int  # running index of the block, unwrapped to any length
    clock: int  # MCU clock of the first sample, 64 bit
    time_s: float  # print time of the first sample
    duration_s: float  # count bridge periods
    count: int  # type: ignore[assignment]  # samples in the sum
    mean_raw: float  # mean ADC code
    min_raw: int
    max_raw: int
    phase_ticks: int  # phase in force, 0 = bridge off
    discarded: int  # samples left out since the block before (settling, too short a cut block)
    lost: int  # samples overwritten before they were summed

    @property
    def centre_s(self) -> float:
        """Print time of the middle of the block, the instant its mean belongs to."""
        return self.time_s + 0.5 * self.duration_s


class Features(NamedTuple):
    """What the estimator needs of one block."""

    time_s: float  # centre of the block
    signal_units: float
    noise_units: float  # standard deviation of signal_units from sample noise
    phase_ticks: int
    power_fraction: float  # p = (phase/45000)^2, the "power %" of Oskolkov 2021 as a fraction
    count: int  # type: ignore[assignment]
    fault: str  # "" or why the block cannot be used


class TempEstimate(NamedTuple):
    """A temperature with its uncertainty, or an explicit "invalid": then temp_c is NaN, never a number."""

    time_s: float
    temp_c: float
    sigma_c: float  # 1 sigma, sample noise and law residual together
    sigma_noise_c: float  # 1 sigma of the random part alone: what filtering can reduce
    dtemp_derror: float  # degC per error unit at this working point
    phase_ticks: int
    valid: bool
    reason: str  # "" when valid


class PowerRequest(NamedTuple):
    """What the controller wants from `time_s` on, with the terms it was made of, kept for the log."""

    time_s: float
    power_w: float  # limited, what the actuator shall deliver
    unlimited_w: float
    proportional_w: float
    integral_w: float
    derivative_w: float
    feedforward_w: float


class PhaseCommand(NamedTuple):
    """The bridge shall run at `phase_ticks` from `time_s` on."""

    time_s: float
    phase_ticks: int
    power_w: float  # heat that phase gives by the drive law


class FlowSegment(NamedTuple):
    """A piece of the planned motion with one extrusion rate."""

    start_s: float
    end_s: float
    flow_mm3_s: float
    path_mm: float


class Sample(NamedTuple):
    """One measurement, and the output in force from the end of the sample before until `end_s`."""

    time_s: float  # the instant temp_c belongs to
    end_s: float
    temp_c: float  # NaN: nothing measured, the output still counts
    sigma_c: float  # 1 sigma of its random part; 0: the parameters' own
    output: float
    rebased: bool = False  # the sensing law jumped here: no slope, nothing to learn from


class Planned(NamedTuple):
    """`value` (output units) from `time_s` on."""

    time_s: float
    value: float


class ParameterError(ValueError):
    """Parameters with which a controller cannot work; the text is for people."""


def require(condition: bool, text: str) -> None:
    """Raise ParameterError with this text unless the condition holds. NaN fails every comparison."""
    if not condition:
        raise ParameterError(text)
