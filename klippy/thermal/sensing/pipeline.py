"""The chain of one nozzle's blocks, in C (thermal/sensing/pipeline.h): its parameters, its memory, what came out.

    Blocks ─► features ─► estimate ─► supervision's watch ─► filter ─► newest TempEstimate, samples

One call for the blocks of a message. Equations and parameters are explained where those are: features.py,
block_temperature.py, laws.py, temperature_filter.py, supervision.py.
"""

from __future__ import annotations

import math
from typing import Any

import chelper
from thermal.models.drive_law import DriveLaw
from thermal.records import TempEstimate
from thermal.sensing.samples import Samples

from . import features, laws
from .block_temperature import EMPTY_MARGIN_C, EstimatorParameters
from .blocks import Blocks
from .supervision import SuperviseParameters
from .temperature_filter import FilterParameters, filter_params

STEP_SHARE = 0.1  # of p = (phase/45000)^2: a step of the drive that may move the reading
USUAL_S = 0.1  # memory of the usual p

SAMPLES_USUAL = 64  # of a step; of one that comes late there are more ...
SAMPLES_MAX = 512  # ... and beyond this, 0.8 s, they are forgotten


class Chain:
    """One nozzle's. `state` is C's struct chain_state: memory of watch, filter, noise and heat."""

    def __init__(self) -> None:
        ffi, self._lib = chelper.get_ffi()
        self._parameters = ffi.new("struct chain_params *")
        self.state: Any = ffi.new("struct chain_state *")
        self._filter = ffi.addressof(self.state, "filter")
        self.watch: Any = ffi.addressof(
            self.state, "watch"
        )  # what supervision has seen, C's struct chain_watch
        self.witness: Any = ffi.addressof(self.state, "witness")  # C's struct witness_state
        self._ffi, self._samples_type = ffi, ffi.typeof("struct model_sample[]")
        self._samples, self._room = ffi.new(self._samples_type, SAMPLES_USUAL), SAMPLES_USUAL
        self.waiting = 0  # samples that nobody has taken yet
        self.watch.last_block_s = self.watch.last_valid_s = math.inf
        self.restart_filter()

    def use(
        self,
        front: features.FeatureParameters,
        estimator: EstimatorParameters,
        supervise: SuperviseParameters,
        drive: DriveLaw,
        filter: FilterParameters,
        has_looks: bool = False,
    ) -> None:
        """Work with these from the next block on. The one place where parameters become C's.

        `has_looks`: a strong drive has looks at the sensing phase, and its reading is corrected by what they show.
        """
        p = self._parameters
        p.front = features.front_params(front)
        p.law = laws.packed(estimator.law)[0][0]
        p.residual_units, p.supply = estimator.law.residual_units, estimator.supply
        p.temp_low_c, p.temp_high_c = estimator.temp_low_c, estimator.temp_high_c
        p.empty_c = estimator.temp_high_c + EMPTY_MARGIN_C
        p.phase_low_ticks = estimator.phase_low_ticks
        p.limit_low_c, p.limit_high_c = supervise.temp_low_c, supervise.trip_high_c
        p.limit_blocks, p.is_calibrated = supervise.limit_blocks, supervise.calibrated
        p.has_looks = has_looks and supervise.calibrated
        p.power_max_w, p.power_exponent = drive.power_max_w, drive.exponent
        p.power_phase_max_ticks = drive.phase_max_ticks
        p.filter = filter_params(filter)
        p.span_samples, p.span_blocks = features.SPAN_SAMPLES, features.NOISE_BLOCKS
        p.span_per_noise = features.SPAN_PER_NOISE
        p.phase_max_ticks = front.phase_max_ticks
        p.step_share, p.usual_s = STEP_SHARE, USUAL_S

    def correct(self, estimator: EstimatorParameters, moved_c: float, drive_moved_c: float) -> None:
        """A corrected law from now on: readings rise by `moved_c`, those of full drive by `drive_moved_c` more."""
        self._parameters.law = laws.packed(estimator.law)[0][0]
        self._filter.temp_c += moved_c
        self.state.drive.full_c += drive_moved_c
        self.witness.temp_c += moved_c
        self.witness.base_c += moved_c
        self.state.drive.time_s = math.nan  # the newest reading was by the law before

    def set_doubt(self, sigma_c: float) -> None:
        """1 sigma of what the law may have drifted."""
        self._parameters.drift_sigma_c = sigma_c

    def restart_filter(self) -> None:
        """The filter knows nothing any more."""
        self._lib.filter_reset(self._filter)
        self._lib.drive_offset_reset(self._ffi.addressof(self.state, "drive"))
        self._lib.witness_reset(self.witness)

    def take(self, blocks: Blocks) -> TempEstimate | None:
        """Blocks in order of time; the newest filtered estimate among them, if any."""
        count = blocks.count
        if self.waiting + count > self._room:
            self._make_room(count)
        into = self._samples + self.waiting
        newest = self._lib.chain_take(self._parameters, self.state, blocks.raw, count, into)
        self.waiting += count
        return blocks.tracked(newest) if newest >= 0 else None

    def _make_room(self, count: int) -> None:
        """For so many more samples. What nobody has taken for so long nobody wants."""
        if self.waiting + count > SAMPLES_MAX:
            self.waiting = 0
        held, self._room = self._samples, max(self._room, 2 * (self.waiting + count))
        self._samples = self._ffi.new(self._samples_type, self._room)
        self._ffi.memmove(self._samples, held, self.waiting * self._ffi.sizeof("struct model_sample"))

    def samples(self) -> Samples:
        """Of the blocks taken since last asked: each one's own temperature, and the heat since the one before."""
        taken = Samples(self._samples, self.waiting)
        if self.waiting:
            self._samples, self._room = self._ffi.new(self._samples_type, SAMPLES_USUAL), SAMPLES_USUAL
            self.waiting = 0
        return taken

    def held(self) -> list[Any]:
        """Samples that nobody has taken yet, C's struct model_sample."""
        return [self._samples[i] for i in range(self.waiting)]

    def hold(self, count: int) -> list[Any]:
        """Room for so many in place of those: to be filled, for a memory that is restored."""
        self.waiting = 0
        self._make_room(count)
        self.waiting = count
        return self.held()

    def noise_lsb(self) -> float | None:
        """Standard deviation of one ADC sample in LSB; None before enough blocks."""
        noise_lsb = float(self._lib.chain_noise_lsb(self._parameters, self.state))
        return None if math.isnan(noise_lsb) else noise_lsb

    def take_heat_j(self) -> float:
        """Heat put in since the last time somebody asked; NaN if blocks were missing."""
        heat_j, self.state.heat_j = self.state.heat_j, 0.0
        return float(heat_j)
