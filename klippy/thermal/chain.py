"""The chain of one nozzle's blocks, in C (chelper/blockchain.h): its parameters, its memory, what came out.

    Blocks ─► features ─► estimate ─► supervision's watch ─► track ─► newest TempEstimate, samples for a model law

One call for the blocks of a message. Equations and parameters are explained where those are: features.py,
estimator.py, laws.py, track.py, supervise.py.
"""

from __future__ import annotations

import math
import struct
from functools import partial
from typing import Any

import chelper

from . import features, laws
from .actuator import DriveLaw
from .blocks import BLOCKS_MOST, Blocks
from .control_api import Sample
from .estimator import EMPTY_MARGIN_C, EstimatorParameters
from .records import TempEstimate
from .supervise import SuperviseParameters
from .track import TrackParameters, track_params

STEP_SHARE = 0.1  # of p = (phase/45000)^2: a step of the drive that may move the reading
USUAL_S = 0.1  # memory of the usual p
DOUBT_C = 40.0  # 1 sigma of the law's error per unit of p away from it; C1 +0.1 % makes it 17 to 29 degC

_SAMPLE = struct.Struct("5d?7x")  # struct model_sample
_new_sample = partial(tuple.__new__, Sample)  # Sample._make without a Python frame for each


class Chain:
    """One nozzle's. `state` is C's struct chain_state: memory of watch, filter, noise and heat."""

    def __init__(self) -> None:
        ffi, self._lib = chelper.get_ffi()
        self._parameters = ffi.new("struct chain_params *")
        self.state: Any = ffi.new("struct chain_state *")
        self._watch, self._track = ffi.addressof(self.state, "watch"), ffi.addressof(self.state, "track")
        self._samples = ffi.new("struct model_sample[]", BLOCKS_MOST)
        self._sample_bytes = ffi.buffer(self._samples)
        self._count = 0
        self._watch.heard_s = self._watch.believed_s = math.inf
        self.restart_track()

    def use(
        self,
        front: features.FeatureParameters,
        estimator: EstimatorParameters,
        supervise: SuperviseParameters,
        drive: DriveLaw,
        track: TrackParameters,
    ) -> None:
        """Work with these from the next block on. The one place where parameters become C's."""
        p = self._parameters
        p.front = features.front_params(front)
        p.law = laws.packed(estimator.law)[0][0]
        p.residual_units, p.supply = estimator.law.residual_units, estimator.supply
        p.temp_low_c, p.temp_high_c = estimator.temp_low_c, estimator.temp_high_c
        p.empty_c = estimator.temp_high_c + EMPTY_MARGIN_C
        p.phase_low_ticks = estimator.phase_low_ticks
        p.limit_low_c, p.limit_high_c = supervise.temp_low_c, supervise.temp_high_c
        p.limit_blocks, p.is_calibrated = supervise.limit_blocks, supervise.calibrated
        p.power_max_w, p.power_exponent = drive.power_max_w, drive.exponent
        p.power_phase_max_ticks = drive.phase_max_ticks
        p.track = track_params(track)
        p.span_samples, p.span_blocks = features.SPAN_SAMPLES, features.NOISE_BLOCKS
        p.phase_max_ticks = front.phase_max_ticks
        p.step_share, p.usual_s, p.doubt_c = STEP_SHARE, USUAL_S, DOUBT_C

    @property
    def watch(self) -> Any:
        """C's struct chain_watch: what supervision has seen."""
        return self._watch

    def restart_track(self) -> None:
        """The filter knows nothing any more."""
        self._lib.track_reset(self._track)

    def take(self, blocks: Blocks) -> TempEstimate | None:
        """Blocks in order of time; the newest filtered estimate among them, if any."""
        self._count = blocks.count
        newest = self._lib.chain_take(self._parameters, self.state, blocks.raw, blocks.count, self._samples)
        return blocks.tracked(newest) if newest >= 0 else None

    def samples(self) -> list[Sample]:
        """Of the blocks taken last: each one's own temperature, and the heat since the one before."""
        rows = _SAMPLE.iter_unpack(self._sample_bytes[: self._count * _SAMPLE.size])
        return list(map(_new_sample, rows))

    def noise_lsb(self) -> float | None:
        """Standard deviation of one ADC sample in LSB; None before enough blocks."""
        return features.noise_lsb(self.state.span_lsb, self.state.spans)

    def take_heat_j(self) -> float:
        """Heat put in since the last time somebody asked."""
        heat_j, self.state.heat_j = self.state.heat_j, 0.0
        return float(heat_j)
