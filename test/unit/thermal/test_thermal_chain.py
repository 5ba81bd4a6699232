"""The chain in C against the one written out in Python: the same messages, the same of everything."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import block_codec
from chain_rig import new_chain
from reference import chain_reference
from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.sensing import (
    block_temperature,
    blocks,
    convert,
    features,
    laws,
    supervision,
    temperature_filter,
)

CLOCK_HZ, PERIOD_TICKS = 72e6, 600
LAWS = {"exp": laws.ExpLaw(), "eq5": laws.Eq5Law(), "tank": laws.TankLaw()}
SAME = 1e-9  # relative: other groupings of the same sums; the filter forgets rounding within 10 ms
WIRE = convert.ConvertParameters(4, PERIOD_TICKS, CLOCK_HZ, 192)


def same(got: Any, wanted: Any, absolute: float = 1e-9) -> None:
    """Records with the same fields: NaN like NaN, texts as they are, numbers within rounding."""
    assert type(got) is type(wanted)
    for name, a, b in zip(got._fields, got, wanted, strict=True):
        wanted_value = b if isinstance(b, str) else pytest.approx(b, rel=SAME, abs=absolute, nan_ok=True)
        assert a == wanted_value, name


def a_message(rng: random.Random, law: laws.Law, temp_c: float, supply: float) -> list[block_codec.Row]:
    """What an MCU may send: mostly a nozzle near one temperature, sometimes anything."""
    rows: list[block_codec.Row] = []
    for _ in range(rng.randint(1, 7)):
        phase = rng.choice([0, 1500, 2012, 5600, 5600, 5600, 9000, 20000, 45000, rng.randrange(45001)])
        count = rng.choice([192, 192, 192, 192, 100, 96, 95, 12, rng.randint(1, 255)])
        error = law.error(temp_c, phase, supply) if phase else 0.0
        mean = min(4080.0, max(3.0, 256.0 + error + rng.gauss(0.0, 0.1)))
        if rng.random() < 0.08:
            mean = rng.choice([20.0, 1500.0, 3900.0])  # no nozzle's
        low, high = max(0, int(mean) - rng.randint(1, 4)), min(4095, int(mean) + rng.randint(1, 4))
        if rng.random() < 0.04:
            low, high = rng.choice([(0, high), (low, 4095), (low, min(4095, low + 300))])
        lost = rng.choice([0] * 30 + [5, 65535])
        discarded = rng.choice([0, 0, 20, 65535 if rng.random() < 0.02 else 40])
        rows.append(block_codec.Row(count, int(mean * count) >> 4, phase, low, high, discarded, lost))
    while len(block_codec.pack(rows, 192)) > 54:  # what fits one message
        rows.pop()
    return rows


def parameters(law: laws.Law, rng: random.Random, supply: float) -> tuple[Any, ...]:
    loss = heat_loss.LossLaw(0.0187 * rng.uniform(0.7, 1.4), 1e-4, rng.uniform(15.0, 40.0))
    return (
        features.FeatureParameters(256.0, 1.0, rng.uniform(0.3, 2.0)),
        block_temperature.EstimatorParameters(law, supply=supply),
        supervision.SuperviseParameters(0.0, 245.0, limit_blocks=4, calibrated=rng.random() < 0.8),
        DriveLaw(vdc_v=24.0 * supply),
        temperature_filter.FilterParameters(
            loss, heat_loss.HeatCapacity(0.414 * rng.uniform(0.6, 1.6)), outliers_max=3
        ),
    )


def compare(chain: Any, reference: chain_reference.Chain, got: blocks.Blocks, newest: Any) -> None:
    """One message's blocks, after both have taken them."""
    samples = chain.samples()
    assert len(samples) == len(got)
    last = None
    reference.begin_message()
    for i, block in enumerate(got):
        own, found, sample = reference.take(block)
        same(got.estimate(i), own)
        assert (got.tracked(i) is None) == (found is None)
        if found is not None:
            same(got.tracked(i), found)
        same(samples[i], sample)
        last = found or last
    assert (newest is None) == (last is None)
    if last is not None:
        same(newest, last)
    seen = chain.watch
    assert (seen.last_block_s, seen.last_valid_s) == (reference.last_block_s, reference.last_valid_s)
    assert (blocks.REASONS[seen.fault], seen.beyond) == (reference.reason, reference.beyond)
    tripped_c = seen.tripped_c if seen.is_tripped else math.nan
    assert tripped_c == pytest.approx(reference.tripped_c, rel=SAME, nan_ok=True)
    assert chain.state.heat_j == pytest.approx(reference.heat_j, rel=SAME, nan_ok=True)
    assert chain.state.spans == min(len(reference.spans), features.NOISE_BLOCKS)
    assert chain.state.span_lsb == pytest.approx(reference.span_lsb(), rel=SAME)
    assert chain.state.filter.rate_k_s == pytest.approx(reference.x[1], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", LAWS)
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), supply=st.sampled_from([1.0, 1.0, 0.85, 1.1]))
def test_a_stream_gives_what_its_equations_say(name: str, seed: int, supply: float) -> None:
    rng, law = random.Random(seed), LAWS[name]
    given = parameters(law, rng, supply)
    chain, reference = new_chain(*given), chain_reference.Chain(*given)
    stream = convert.Stream(WIRE)
    index = rng.choice([0, 65530])
    clock, temp_c = 72_000_000 * rng.randint(1, 10**6), rng.uniform(30.0, 260.0)
    missing = 0
    for _ in range(12):
        rows = a_message(rng, law, temp_c, supply)
        while len(block_codec.pack(rows, 192)) > 48:  # what a message has room for
            rows.pop()
        offset = -(rows[0].discarded + rows[0].lost)
        placed = []
        for row in rows:
            offset += row.discarded + row.lost
            placed.append(replace(row, offset=offset))
            offset += row.count
        got = block_codec.take(stream, CLOCK_HZ, (index, clock, block_codec.pack(rows, 192)))
        wanted = chain_reference.convert(placed, index, clock, 4, PERIOD_TICKS, CLOCK_HZ)
        assert len(got) == len(wanted)
        for block, other in zip(got, wanted, strict=True):
            same(block, other)
        compare(chain, reference, got, chain.take(got))
        assert stream.counters.missing_blocks == missing
        gap = rng.choice([0, 0, 0, 0, 3])
        index, missing = index + len(rows) + gap, missing + gap
        # now and then a long silence, or print time that jumps back
        clock += PERIOD_TICKS * (offset + rng.choice([0, 0, 20, 192, 60000, -3000]))
        temp_c += rng.choice([0.0, 0.0, rng.uniform(-1.0, 1.0), rng.uniform(-60.0, 60.0)])


@pytest.mark.parametrize("name", LAWS)
@settings(deadline=None)
@given(
    temp=st.floats(-15.0, 900.0),
    error=st.floats(-3000.0, 5000.0),
    phase=st.integers(1, 45000),
    supply=st.floats(0.7, 1.2),
)
def test_each_law_is_its_equation_both_ways(
    name: str, temp: float, error: float, phase: int, supply: float
) -> None:
    law = LAWS[name]
    # the reference solves the tank's equation by bisection: to 1e-15 rad, a thousand units each
    assert law.error(temp, phase, supply) == pytest.approx(
        chain_reference.error_of(law, temp, phase, supply), rel=SAME, abs=1e-9
    )
    wanted = chain_reference.invert(law, error, phase, supply)
    # where the law is nearly flat its slope is a difference of large numbers, summed in another order here
    assert law.invert(error, phase, supply) == pytest.approx(wanted, rel=1e-8, nan_ok=True)


def test_parameters_changed_between_messages_hold_from_the_next_one_on() -> None:
    rng = random.Random(7)
    law = LAWS["tank"]
    given = parameters(law, rng, 1.0)
    chain, reference = new_chain(*given), chain_reference.Chain(*given)
    stream = convert.Stream(WIRE)
    for n, (supply, factor) in enumerate([(1.0, 1.0), (0.9, 1.0), (0.9, 1.3), (1.05, 0.8)]):
        front, read, watch, drive, filtered = given
        read = replace(read, law=law.rezeroed(210.0, law.error(200.0, 5600), 5600), supply=supply)
        drive = replace(drive, vdc_v=24.0 * supply)
        filtered = replace(filtered, heat=heat_loss.HeatCapacity(0.4 * factor))
        chain.use(front, read, watch, drive, filtered, has_looks=True)
        reference.estimator, reference.drive, reference.filter = read, drive, filtered
        rows = [block_codec.Row(192, int((256.0 + law.error(200.0, 5600)) * 192) >> 4, 5600, 400, 420)] * 3
        clock = 576 * PERIOD_TICKS * n
        got = block_codec.take(stream, CLOCK_HZ, (3 * n, clock, block_codec.pack(rows, 192)))
        compare(chain, reference, got, chain.take(got))


def test_a_filter_that_is_reset_starts_anew() -> None:
    chain = new_chain()
    law = laws.ExpLaw()
    rows = [block_codec.Row(192, int((256.0 + law.error(200.0, 5600)) * 192) >> 4, 5600, 400, 420)] * 3
    stream = convert.Stream(WIRE)
    first = chain.take(block_codec.take(stream, CLOCK_HZ, (0, 0, block_codec.pack(rows, 192))))
    again = chain.take(block_codec.take(stream, CLOCK_HZ, (3, 576 * 600, block_codec.pack(rows, 192))))
    assert first is not None and again is not None and again.sigma_noise_c < first.sigma_noise_c
    chain.restart_filter()
    got = block_codec.take(stream, CLOCK_HZ, (6, 1152 * 600, block_codec.pack(rows[:1], 192)))
    anew = chain.take(got)
    assert anew is not None and anew == got.estimate(0)


def test_more_blocks_than_a_message_holds_are_refused() -> None:
    block = blocks.SampleBlock(0, 0, 0.0, 0.0016, 192, 400.0, 398, 402, 5600, 0, 0)
    with pytest.raises(ValueError, match="more than"):
        blocks.Blocks.of([block] * (blocks.BLOCKS_MAX + 1))
    assert math.isinf(blocks.Blocks().end_s)
    with pytest.raises(IndexError):
        blocks.Blocks.of([block])[1]
