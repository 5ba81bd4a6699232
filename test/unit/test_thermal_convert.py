"""Block messages become blocks with times, sequence and losses; garbage is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from loop.block_codec import Row, pack
from thermal import convert
from thermal.records import SampleBlock

PARAMETERS = convert.ConvertParameters(oversample=5, period_ticks=600, clock_hz=72e6)


def record(count: int = 1024, value: int = 8192, phase: int = 2012, **more: int) -> bytes:
    return pack([Row(count, value, phase, **({"low": 250, "high": 262} | more))], 1024)


def convert_one(stream: convert.Stream, sequence: int, data: bytes, clock: int = 7200) -> list[SampleBlock]:
    return list(stream.take(sequence, clock, data, clock / 72e6))


@given(st.lists(st.integers(0, 4095), min_size=64, max_size=1024))
def test_mean_of_the_samples_comes_back_whatever_the_count(samples: list[int]) -> None:
    value = sum(samples) >> 5
    block = convert_one(convert.Stream(PARAMETERS), 0, record(count=len(samples), value=value))[0]
    # The MCU's shift drops 0..31 of the sum, the host adds the mean of that: at most 15.5 off over the count.
    assert abs(block.mean_raw - sum(samples) / len(samples)) <= 15.5 / len(samples) + 1e-9


def test_clock_and_time_belong_to_the_first_sample_of_each_record() -> None:
    blocks = convert_one(convert.Stream(PARAMETERS), 0, record() + record(), clock=72_000_000)
    assert [b.clock for b in blocks] == [72_000_000, 72_000_000 + 1024 * 600]
    assert blocks[1].time_s == pytest.approx(1.0 + 1024 / 120e3, abs=1e-12)
    assert blocks[0].centre_s == pytest.approx(1.0 + 512 / 120e3, abs=1e-12)
    assert blocks[0].duration_s == pytest.approx(1024 / 120e3)


def test_a_gap_in_the_sequence_counts_missing_blocks_across_the_16_bit_wrap() -> None:
    stream = convert.Stream(PARAMETERS)
    convert_one(stream, 65534, record())
    convert_one(stream, 65535, record() + record())  # indices 65535 and 65536
    blocks = convert_one(stream, 4, record())  # 65537..65539 never came
    assert stream.counters.missing_blocks == 3
    assert blocks[0].sequence == 65540
    assert stream.counters.blocks == 4


def test_a_message_seen_before_is_dropped() -> None:
    stream = convert.Stream(PARAMETERS)
    convert_one(stream, 10, record() + record())
    assert convert_one(stream, 10, record() + record()) == []
    assert (stream.counters.blocks, stream.counters.missing_blocks) == (2, 0)


def test_losses_told_by_the_mcu_are_added_up() -> None:
    stream = convert.Stream(PARAMETERS)
    blocks = convert_one(stream, 0, record(discarded=20, lost=7) + record(discarded=3))
    assert (blocks[0].discarded, blocks[0].lost) == (20, 7)
    assert (stream.counters.discarded_samples, stream.counters.lost_samples) == (23, 7)


@given(
    st.lists(
        st.builds(
            Row,
            count=st.integers(1, 1024),
            value=st.integers(0, 2**23 - 1),
            phase=st.sampled_from([0, 2012, 45000]),
            low=st.integers(0, 2000),
            high=st.integers(2000, 4095),
            discarded=st.integers(0, 65535),
            lost=st.integers(0, 65535),
        ),
        min_size=1,
        max_size=9,
    )
)
def test_every_field_comes_back_as_it_was_packed(rows: list[Row]) -> None:
    blocks = convert_one(convert.Stream(PARAMETERS), 0, pack(rows, 1024), clock=6000)
    offset = -rows[0].discarded - rows[0].lost
    for block, row in zip(blocks, rows, strict=True):
        offset += row.discarded + row.lost
        assert block.clock == 6000 + 600 * offset
        offset += row.count
        assert (block.count, block.phase_ticks, block.min_raw, block.max_raw) == (
            row.count,
            row.phase,
            row.low,
            row.high,
        )
        assert (block.discarded, block.lost) == (row.discarded, row.lost)


@given(st.binary(max_size=48))
def test_any_bytes_are_blocks_or_refused(data: bytes) -> None:
    try:
        blocks = convert_one(convert.Stream(PARAMETERS), 0, data)
    except convert.ConvertError:
        return
    assert blocks and all(b.count > 0 for b in blocks)


@pytest.mark.parametrize("data", [b"", b"\0" * 6, record()[:-1], record(count=0)])
def test_a_malformed_message_is_refused(data: bytes) -> None:
    with pytest.raises(convert.ConvertError):
        convert_one(convert.Stream(PARAMETERS), 0, data)
