"""Block messages become blocks with times, sequence and losses; garbage is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import chelper
from block_codec import Row, content, pack, take
from thermal.records import SampleBlock
from thermal.sensing import convert

PARAMETERS = convert.ConvertParameters(oversample=5, period_ticks=600, clock_hz=72e6)


def record(count: int = 1024, value: int = 8192, phase: int = 2012, **more: int) -> bytes:
    return pack([Row(count, value, phase, **({"low": 250, "high": 262} | more))], 1024)


def convert_one(stream: convert.Stream, sequence: int, data: bytes, clock: int = 7200) -> list[SampleBlock]:
    return list(take(stream, 72e6, (sequence, clock, data)))


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


def test_losses_reported_by_the_mcu_are_added_up() -> None:
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
        max_size=3,  # of 16 bytes at most
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
    stream = convert.Stream(PARAMETERS)
    blocks = convert_one(stream, 0, data)
    assert bool(blocks) != bool(stream.complaint()) and all(b.count > 0 for b in blocks)


@pytest.mark.parametrize("data", [b"", b"\0" * 6, record()[:-1], record(count=0)])
def test_a_malformed_message_is_refused_and_those_around_it_are_not(data: bytes) -> None:
    stream = convert.Stream(PARAMETERS)
    good = record()
    blocks = take(stream, 72e6, (0, 7200, good), (1, 700_000, data), (2, 1_400_000, good))
    assert [b.sequence for b in blocks] == [0, 2]
    assert stream.counters.senseless_messages == stream.counters.missing_blocks == 1
    assert stream.complaint() and not stream.complaint()


def test_a_message_cut_anywhere_gives_no_block() -> None:
    stream = convert.Stream(PARAMETERS)
    whole = content(0, 7200, record())
    pulled = chelper.get_ffi()[0].new("struct pull_message[]", 1)
    for cut in range(len(whole)):
        pulled[0].len, pulled[0].data = cut, whole[:cut]
        assert not stream.take(pulled, 1, 7200, 1e-4, 1.0 / 72e6)
        assert stream.complaint()


def test_a_batch_of_messages_comes_as_one_and_its_times_are_those_of_the_clock_given_with_it() -> None:
    stream = convert.Stream(PARAMETERS)
    pulled = chelper.get_ffi()[0].new("struct pull_message[]", 3)
    start = 5 << 32  # the messages' 32 bits wrap among them
    for i in range(3):
        packed = content(2 * i, (start + 2048 * 600 * (i - 1)) % 2**32, record() + record())
        pulled[i].len, pulled[i].data = len(packed), packed
    blocks = stream.take(pulled, 3, start - 1_000_000, 77.0, 1.001 / 72e6)
    assert [b.sequence for b in blocks] == list(range(6))
    assert [b.clock for b in blocks] == [start + 1024 * 600 * (i - 2) for i in range(6)]
    assert blocks[2].time_s == pytest.approx(77.0 + 1_000_000 * 1.001 / 72e6, abs=1e-12)
