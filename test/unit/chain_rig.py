"""Single stages of the C chain, for tests: one block in, the records of thermal/records.py out."""

from __future__ import annotations

from typing import Any

import chelper
from thermal import actuator, blocks, chain, estimator, features, laws, model, supervise, track
from thermal.records import SampleBlock, TempEstimate

FFI, LIB = chelper.get_ffi()


def new_chain(
    front: features.FeatureParameters | None = None,
    read: estimator.EstimatorParameters | None = None,
    watch: supervise.SuperviseParameters | None = None,
    drive: actuator.DriveLaw | None = None,
    filtered: track.TrackParameters | None = None,
) -> chain.Chain:
    made = chain.Chain()
    made.use(
        front or features.FeatureParameters(),
        read or estimator.EstimatorParameters(laws.ExpLaw()),
        watch or supervise.SuperviseParameters(0.0, 300.0),
        drive or actuator.DriveLaw(),
        filtered or track.TrackParameters(model.LossLaw()),
    )
    return made


def told(made: chain.Chain) -> Any:
    """C's struct chain_params."""
    return made._parameters


def estimate(
    parameters: estimator.EstimatorParameters, error: float, phase: int, noise: float = 0.03
) -> TempEstimate:
    """What a good block of this error says."""
    one = blocks.Blocks()
    one.count = 1
    raw = one.raw[0]
    raw.error_units, raw.noise_units, raw.phase_ticks = error, noise, phase
    LIB.chain_estimate(told(new_chain(read=parameters)), one.raw)
    return one.estimate(0)


def of_block(
    parameters: estimator.EstimatorParameters, front: features.FeatureParameters, block: SampleBlock
) -> TempEstimate:
    """Features and estimate of one block."""
    one = blocks.Blocks.of([block])
    new_chain(front, parameters).take(one)
    return one.estimate(0)
