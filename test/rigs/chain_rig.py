"""Single stages of the C chain, for tests: one block in, the records of thermal/records.py out."""

from __future__ import annotations

from typing import Any

import chelper
from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.records import SampleBlock, TempEstimate
from thermal.sensing import (
    block_temperature,
    blocks,
    features,
    laws,
    pipeline,
    supervision,
    temperature_filter,
)

FFI, LIB = chelper.get_ffi()


def new_chain(
    front: features.FeatureParameters | None = None,
    read: block_temperature.EstimatorParameters | None = None,
    watch: supervision.SuperviseParameters | None = None,
    drive: DriveLaw | None = None,
    filtered: temperature_filter.FilterParameters | None = None,
) -> pipeline.Chain:
    made = pipeline.Chain()
    made.use(
        front or features.FeatureParameters(),
        read or block_temperature.EstimatorParameters(laws.ExpLaw()),
        watch or supervision.SuperviseParameters(0.0, 300.0),
        drive or DriveLaw(),
        filtered or temperature_filter.FilterParameters(heat_loss.LossLaw()),
        has_looks=True,
    )
    return made


def c_params(made: pipeline.Chain) -> Any:
    """C's struct chain_params."""
    return made._parameters


def estimate(
    parameters: block_temperature.EstimatorParameters, error: float, phase: int, noise: float = 0.03
) -> TempEstimate:
    """What a good block of this error says."""
    one = blocks.Blocks()
    one.count = 1
    raw = one.raw[0]
    raw.signal_units, raw.noise_units, raw.phase_ticks = error, noise, phase
    LIB.chain_estimate(c_params(new_chain(read=parameters)), one.raw)
    return one.estimate(0)


def of_block(
    parameters: block_temperature.EstimatorParameters, front: features.FeatureParameters, block: SampleBlock
) -> TempEstimate:
    """Features and estimate of one block."""
    one = blocks.Blocks.of([block])
    new_chain(front, parameters).take(one)
    return one.estimate(0)
