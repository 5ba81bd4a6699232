"""The chain of a coil's blocks written out in Python, as an independent reference for the one in C.

Block messages to blocks, blocks to signal units, those to a temperature by each of the three laws, the watch's
counting, the filter, the samples of predictive control: from the equations in the docstrings of klippy/thermal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import block_codec
from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.records import PHASE_MAX_TICKS, Sample, SampleBlock, TempEstimate
from thermal.sensing import block_temperature, features, laws, supervision, temperature_filter

NAN = math.nan
UNKNOWN_S = 0.020  # blocks missing for longer: the heat of that time is not known
NO_READING = (NAN, NAN)


def convert(
    rows: list[block_codec.Row], index: int, clock: int, oversample: int, period_ticks: int, clock_hz: float
) -> list[SampleBlock]:
    """Records with their offset, the first at the message's clock."""
    period_s = period_ticks / clock_hz
    out = []
    for n, row in enumerate(rows):
        mean = (row.value * 2**oversample + (2**oversample - 1) / 2) / row.count
        at = clock / clock_hz + row.offset * period_s
        place = (index + n, clock + row.offset * period_ticks, at, row.count * period_s)
        codes = (row.count, mean, row.low, row.high, row.phase)
        out.append(SampleBlock(*place, *codes, row.discarded, row.lost))
    return out


# Sensing laws


def error_of(law: laws.Law, temp_c: float, phase: float, supply: float = 1.0) -> float:
    p = (phase / PHASE_MAX_TICKS) ** 2
    if isinstance(law, laws.ExpLaw):
        return law.a * temp_c * math.exp(-law.b * p * supply**2) + law.c + law.d * p
    if isinstance(law, laws.Eq5Law):
        i, f = phase, phase * supply
        return (
            law.a * temp_c + law.b * i + law.ab * temp_c * f + law.bb * i**2 + law.abb * temp_c * f**2 + law.c
        )
    assert isinstance(law, laws.TankLaw)
    field = (math.sin(math.pi * phase / PHASE_MAX_TICKS / 2) * supply) ** 2
    low, high = -math.pi / 2, math.pi / 2  # bisection: tan(psi) less its right side grows with psi
    for _ in range(80):
        psi = (low + high) / 2
        u = field * math.cos(psi) ** 2
        wanted = ((temp_c - law.t0) * math.exp(-law.b * u - law.q * u**4) + law.delta) / law.w
        low, high = (psi, high) if math.tan(psi) < wanted else (low, psi)
    return law.g * psi + law.c + law.d * math.exp(-law.m * p)


def invert(law: laws.Law, error: float, phase: float, supply: float = 1.0) -> tuple[float, float]:
    """(degC, degC per unit)."""
    p = (phase / PHASE_MAX_TICKS) ** 2
    if isinstance(law, laws.ExpLaw):
        slope = law.a * math.exp(-law.b * p * supply**2)
        return (error - law.c - law.d * p) / slope, 1 / slope
    if isinstance(law, laws.Eq5Law):
        i, f = phase, phase * supply
        slope = law.a + law.ab * f + law.abb * f**2
        return ((error - law.c - law.b * i - law.bb * i**2) / slope, 1 / slope) if slope > 0 else NO_READING
    assert isinstance(law, laws.TankLaw)
    psi = (error - law.c - law.d * math.exp(-law.m * p)) / law.g
    if abs(psi) >= laws.PSI_MAX_RAD:
        return NO_READING
    field = (math.sin(math.pi * phase / PHASE_MAX_TICKS / 2) * supply) ** 2

    def temp(psi: float) -> float:
        u = field * math.cos(psi) ** 2
        return law.t0 + (law.w * math.tan(psi) - law.delta) * math.exp(law.b * u + law.q * u**4)

    u = field * math.cos(psi) ** 2
    du = -2 * u * math.tan(psi)
    share = math.exp(law.b * u + law.q * u**4)
    slope = law.w / math.cos(psi) ** 2 * share + (temp(psi) - law.t0) * (law.b + 4 * law.q * u**3) * du
    return (temp(psi), slope / law.g) if slope / law.g > 0 else NO_READING


def estimate(
    p: block_temperature.EstimatorParameters, front: features.FeatureParameters, block: SampleBlock
) -> TempEstimate:
    error = (block.mean_raw - front.adc_zero_raw) * front.units_per_lsb
    stuck = 6 / 12 * math.exp(-((2 * math.pi * front.noise_lsb) ** 2))  # six blocks in a row err alike
    noise = math.sqrt((front.noise_lsb**2 + 1 / 12) / block.count + stuck) * front.units_per_lsb
    temp_c, slope = NO_READING
    if block.phase_ticks == 0:
        reason = "bridge off"
    elif block.min_raw <= 0 or block.max_raw >= front.adc_max_raw:
        reason = "signal clipped"
    elif block.lost:
        reason = "samples lost"
    elif block.phase_ticks < p.phase_low_ticks:
        reason = "too little excitation"
    else:
        reason = "outside the range of the sensing law: wrong nozzle, or its thermometer is not calibrated?"
        temp_c, slope = invert(p.law, error, block.phase_ticks, p.supply)
        if p.temp_low_c <= temp_c <= p.temp_high_c:
            reason = ""
        elif error > error_of(p.law, p.temp_high_c + 150, block.phase_ticks, p.supply):
            reason = "signal far above any nozzle's: is the nozzle missing from the coil?"
    if reason:
        return TempEstimate(block.centre_s, NAN, NAN, NAN, NAN, block.phase_ticks, False, reason)
    sigma_c = math.sqrt(noise**2 + p.law.residual_units**2) * slope
    return TempEstimate(block.centre_s, temp_c, sigma_c, noise * slope, slope, block.phase_ticks, True, "")


# What remembers


@dataclass
class Chain:
    """Parameters and memory of one nozzle."""

    front: features.FeatureParameters
    estimator: block_temperature.EstimatorParameters
    supervise: supervision.SuperviseParameters
    drive: DriveLaw
    filter: temperature_filter.FilterParameters
    last_block_s: float = math.inf
    last_valid_s: float = math.inf
    reason: str = ""
    beyond: int = 0
    tripped_c: float = NAN
    heat_j: float = 0.0
    spans: list[float] = field(default_factory=list)
    usual: float = 0.0
    known: bool = False  # the filter has a state
    time_s: float = NAN
    end_s: float = NAN
    power_w: float = 0.0
    measured_s: float = NAN
    x: list[float] = field(default_factory=lambda: [NAN, 0.0])  # degC, K/s
    cov: list[list[float]] = field(default_factory=lambda: [[0.0, 0.0], [0.0, 0.0]])
    outliers: int = 0
    offset: tuple[float, float] = (
        0.0,
        60.0**2,
    )  # what full drive adds to the reading, degC, and its variance
    last: tuple[TempEstimate, float, float, float, float] | None = (
        None  # reading, degC, h, W, half its duration
    )
    swing_c: float = 0.0  # of readings at one strong drive, less their slow part ...
    ripple_c2: float = 100.0  # ... and its mean square
    strong: float = 0.0  # h of the newest strong drive
    strong_s: float = 0.0  # its centre
    noise_lsb: float = field(init=False)

    def __post_init__(self) -> None:
        self.noise_lsb = self.front.noise_lsb

    def begin_message(self) -> None:
        """The noise of the blocks so far counts for those of this message."""
        if len(self.spans) >= features.NOISE_BLOCKS // 4:
            self.noise_lsb = self.span_lsb() / 5.46

    def take(self, block: SampleBlock) -> tuple[TempEstimate, TempEstimate | None, Sample]:
        own = estimate(self.estimator, replace(self.front, noise_lsb=self.noise_lsb), block)
        end_s = block.time_s + block.duration_s
        sine = math.sin(math.pi / 2 * block.phase_ticks / self.drive.phase_max_ticks)
        heat_w = self.drive.power_max_w * sine**self.drive.exponent
        if block.time_s - self.last_block_s > UNKNOWN_S:
            self.heat_j = math.nan
        self.heat_j += heat_w * block.duration_s * (1 + block.discarded / block.count)
        if self.supervise.calibrated and own.valid:
            own = self._without_drive(block, own, heat_w)
        self._watch(own, end_s)
        if block.phase_ticks and block.count >= features.SPAN_SAMPLES // 2:
            longer = math.sqrt(math.log(features.SPAN_SAMPLES) / math.log(block.count))
            self.spans.append((block.max_raw - block.min_raw) * longer)
        found = self._filter(block, own, heat_w, end_s)
        return own, found, self._sample(block, own, heat_w, end_s)

    def span_lsb(self) -> float:
        """Mean of all so far; of more than its memory holds, exponentially forgotten."""
        mean = 0.0
        for n, span in enumerate(self.spans, 1):
            mean += (span - mean) / min(n, features.NOISE_BLOCKS)
        return mean

    def _watch(self, own: TempEstimate, end_s: float) -> None:
        self.last_block_s = end_s
        if self.tripped_c == self.tripped_c or not own.phase_ticks:
            return
        if not self.supervise.calibrated:
            self.last_valid_s = end_s
            return
        self.reason = own.reason
        if not own.valid:
            return
        self.last_valid_s = end_s
        low_c, high_c = self.supervise.temp_low_c, self.supervise.temp_high_c + self.supervise.over_c
        if own.sigma_c > 5.0 and low_c - 2.0 * own.sigma_c <= own.temp_c <= high_c + 2.0 * own.sigma_c:
            return
        within = low_c <= own.temp_c <= high_c
        self.beyond = 0 if within else self.beyond + 1
        if self.beyond >= self.supervise.limit_blocks:
            self.tripped_c = own.temp_c

    def _ripple_c(self) -> float:
        """1 sigma of what a ripple of the supply adds to one reading at full drive."""
        return math.sqrt(max(0.0, self.ripple_c2 - 6.25))

    def _without_drive(self, block: SampleBlock, own: TempEstimate, heat_w: float) -> TempEstimate:
        """A step of the reading with the drive, but for what the heat balance explains, is the drive's."""
        h = (block.phase_ticks / self.front.phase_max_ticks) ** 2.6
        k, variance = self.offset
        if self.last is not None and own.time_s > self.last[0].time_s:
            before, temp_c, h_before, before_w, half_s = self.last
            dt, p = own.time_s - before.time_s, self.filter
            first = min(half_s, dt)
            kelvin, air = temp_c + 273.15, p.loss.ambient_c + 273.15
            lost_w = p.loss.conductance_w_k * (kelvin - air)
            lost_w += heat_loss.STEFAN_BOLTZMANN * p.loss.radiation_m2 * (kelvin**4 - air**4)
            heat_j = before_w * first + heat_w * (dt - first) - max(0.0, lost_w) * dt
            rise_c = heat_j / p.heat.at(temp_c) + self.x[1] * dt
            other = abs(h - self.strong) if h > 0.02 else 0.0
            since = max(dt, min(1.0, own.time_s - self.strong_s)) if h > 0.02 else dt
            walk = (0.25 + 20 * h * h) ** 2 * since + 0.49 * abs(rise_c) + (9 + k * k / 4) * other
            variance = min(3600.0, variance + walk)
            step = h - h_before
            if dt < 0.006 and abs(step) > 0.02:
                off_c = own.temp_c - before.temp_c - rise_c - k * step
                noise = own.sigma_noise_c**2 + before.sigma_noise_c**2 + (0.15 * rise_c) ** 2
                noise += (self._ripple_c() * step) ** 2
                total = step**2 * variance + noise
                if off_c**2 > 25 * total:
                    variance = min(3600.0, variance + (off_c / step) ** 2)
                else:
                    k += variance * step / total * off_c
                    variance *= 1 - step**2 * variance / total
            elif dt < 0.006 and h > 0.25:
                differs_c = (own.temp_c - before.temp_c - rise_c) / h
                self.swing_c = (self.swing_c + differs_c) * 0.02 / (0.02 + dt)
                self.ripple_c2 += (self.swing_c**2 - self.ripple_c2) * dt / (0.02 + dt)
        variance = max(variance, self._ripple_c() ** 2)
        self.offset = k, variance
        if h > 0.02:
            self.strong, self.strong_s = h, own.time_s
        corrected = own.temp_c - k * h
        self.last = own, corrected, h, heat_w, block.duration_s / 2
        full_c = math.hypot(math.sqrt(variance), self._ripple_c())
        doubt = h * math.hypot(full_c, 0.15 * k * (1 - h))
        sigma_c, noise_c = math.hypot(own.sigma_c, doubt), math.hypot(own.sigma_noise_c, doubt)
        return own._replace(temp_c=corrected, sigma_c=sigma_c, sigma_noise_c=noise_c)

    def _filter(
        self, block: SampleBlock, own: TempEstimate, heat_w: float, end_s: float
    ) -> TempEstimate | None:
        p = self.filter
        silent = not self.known or end_s - self.measured_s > p.gap_s or block.time_s < self.time_s
        if not silent:
            self._predict(block.centre_s, heat_w)
        self.end_s, self.power_w = end_s, heat_w
        if silent:
            self.known = False
        if not own.valid:
            return None
        if silent:
            return self._begin(own)
        noise = own.sigma_noise_c**2
        total, off_c = self.cov[0][0] + noise, own.temp_c - self.x[0]
        if abs(off_c) > p.gate_sigma * math.sqrt(total) + p.gate_c:
            self.outliers += 1
            return self._begin(own) if self.outliers >= p.outliers_max else None
        self.outliers = 0
        (tt, tq), (_, qq) = self.cov
        k, kq = tt / total, tq / total
        self.x = [self.x[0] + k * off_c, self.x[1] + kq * off_c]
        self.cov = [[tt - k * tt, tq - k * tq], [tq - k * tq, qq - kq * tq]]
        self.measured_s = self.time_s
        noise_c = math.sqrt(self.cov[0][0])
        law_variance = max(0.0, own.sigma_c**2 - noise)
        sigma_c = math.sqrt(law_variance + self.cov[0][0])
        return TempEstimate(
            self.time_s, self.x[0], sigma_c, noise_c, own.dtemp_derror, own.phase_ticks, True, ""
        )

    def _begin(self, own: TempEstimate) -> TempEstimate:
        self.known, self.outliers = True, 0
        self.x, self.cov = [own.temp_c, 0.0], [[own.sigma_noise_c**2, 0.0], [0.0, 30.0**2]]
        self.time_s = self.measured_s = own.time_s
        return own

    def _predict(self, centre_s: float, heat_w: float) -> None:
        """F = [[1, dt], [0, 1]] around the heat balance; the drive's step lies where the block before ended."""
        p, dt = self.filter, centre_s - self.time_s
        before = min(max(0.0, self.end_s - self.time_s), dt)
        mean_w = (self.power_w * before + heat_w * (dt - before)) / dt if dt > 0 else heat_w
        kelvin, air = self.x[0] + 273.15, p.loss.ambient_c + 273.15
        lost_w = p.loss.conductance_w_k * (kelvin - air)
        lost_w += heat_loss.STEFAN_BOLTZMANN * p.loss.radiation_m2 * (kelvin**4 - air**4)
        rate = (mean_w - max(0.0, lost_w)) / p.heat.at(self.x[0])
        (tt, tq), (_, qq) = self.cov
        self.x = [self.x[0] + (rate + self.x[1]) * dt, self.x[1]]
        self.cov = [
            [tt + 2 * dt * tq + dt * dt * qq + dt * p.temp_noise, tq + dt * qq],
            [tq + dt * qq, qq + dt * p.rate_noise],
        ]
        self.time_s = centre_s

    def _sample(self, block: SampleBlock, own: TempEstimate, heat_w: float, end_s: float) -> Sample:
        if not own.valid:
            return Sample(block.centre_s, end_s, NAN, 0.0, heat_w, False)
        away = (block.phase_ticks / self.front.phase_max_ticks) ** 2 - self.usual
        if abs(away) > 0.1:
            self.usual += away
            return Sample(
                block.centre_s, end_s, own.temp_c, own.sigma_c, heat_w, not self.supervise.calibrated
            )
        self.usual += away * block.duration_s / (block.duration_s + 0.1)
        return Sample(block.centre_s, end_s, own.temp_c, own.sigma_c, heat_w, False)
