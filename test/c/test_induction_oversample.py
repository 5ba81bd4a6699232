"""src/oversample.c and src/filters.c against plain references, bit for bit."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pure_harness import load_induction

ffi, lib = load_induction()
U16 = 0xFFFF


@dataclass
class Block:
    first: int
    value: int
    sum: int
    count: int
    phase: int
    min: int
    max: int
    discarded: int
    lost: int


def ema_reference(state: int | None, value: int, shift: int) -> tuple[int, int]:
    """(new state, output): y += (x - y) / 2^shift in 1/256 steps, half up."""
    scaled = value * 256
    if state is None or shift == 0:
        return scaled, value
    state += (scaled - state + (1 << (shift - 1))) >> shift
    return state, (state + 128) >> 8


class Reference:
    """The documented behaviour, one sample at a time, no regard for speed."""

    def __init__(self, y: int, settle: int, shift: int, length: int = 0) -> None:
        self.y, self.settle, self.shift, self.length = y, settle, shift, length or 4**y
        self.phase = self.settle_left = self.discarded = self.lost = 0
        self.held: list[int] = []
        self.first = 0
        self.state: int | None = None
        self.blocks: list[Block] = []

    def _finish(self, whole: bool) -> None:
        total = sum(self.held)
        value = total >> self.y
        if whole:
            self.state, value = ema_reference(self.state, value, self.shift)
        low, high, count = min(self.held), max(self.held), len(self.held)
        discarded, lost = min(self.discarded, U16), min(self.lost, U16)
        self.blocks.append(Block(self.first, value, total, count, self.phase, low, high, discarded, lost))
        self.held, self.discarded, self.lost = [], 0, 0

    def _cut(self) -> None:
        if 16 * len(self.held) >= self.length:
            self._finish(whole=False)
        else:
            self.discarded += len(self.held)
            self.held = []
        self.state = None

    def step(self, phase: int) -> None:
        if phase != self.phase:
            self._cut()
            self.phase, self.settle_left = phase, self.settle

    def gap(self, count: int) -> None:
        if count:
            self._cut()
            self.lost += count
            self.settle_left = max(0, self.settle_left - count)

    def feed(self, samples: list[int], first: int) -> None:
        for index, sample in enumerate(samples, first):
            if self.settle_left:
                self.settle_left -= 1
                self.discarded += 1
                continue
            if not self.held:
                self.first = index & 0xFFFFFFFF
            self.held.append(sample)
            if len(self.held) == self.length:
                self._finish(whole=True)


def test_skipped_samples_end_a_block_and_count_as_discarded_and_as_settling() -> None:
    fast = Fast(4, 20, 0, 192)
    fast.step(1000)
    assert lib.oversample_skip(fast.c, 8, fast.block) == 0
    fast.feed([100] * 112, 8)  # 12 of them settle
    assert lib.oversample_skip(fast.c, 30, fast.block) == 1
    assert (fast.block.first, fast.block.count, fast.block.discarded) == (20, 100, 20)
    assert lib.oversample_skip(fast.c, 30, fast.block) == 0
    fast.feed([100] * 5, 180)
    assert lib.oversample_skip(fast.c, 1, fast.block) == 0, "too few for a block"
    fast.feed([100] * 192, 186)
    assert (fast.blocks[-1].first, fast.blocks[-1].count, fast.blocks[-1].discarded) == (186, 192, 66)


class Fast:
    """The firmware's code, driven as its interrupt drives it."""

    def __init__(self, y: int, settle: int, shift: int, length: int = 0) -> None:
        self.c = ffi.new("struct oversample *")
        self.block = ffi.new("struct oversample_block *")
        self.blocks: list[Block] = []
        config = {"y": y, "ema_shift": shift, "settle_samples": settle, "block_len": length}
        assert lib.oversample_init(self.c, config) == 1

    def _take(self, finished: int) -> None:
        assert finished in (0, 1)
        if finished:
            self.blocks.append(Block(*(getattr(self.block, name) for name in Block.__dataclass_fields__)))

    def step(self, phase: int) -> None:
        self._take(lib.oversample_step(self.c, phase, self.block))

    def gap(self, count: int) -> None:
        self._take(lib.oversample_gap(self.c, count, self.block))

    def feed(self, samples: list[int], first: int) -> None:
        taken = ffi.new("uint16_t *")
        while samples:
            data = ffi.new("uint16_t[]", samples)
            self._take(lib.oversample_feed(self.c, data, len(samples), first & 0xFFFFFFFF, taken, self.block))
            samples, first = samples[taken[0] :], first + taken[0]


runs = st.tuples(st.just("feed"), st.integers(1, 200), st.integers(0, U16))
steps = st.tuples(st.just("step"), st.integers(0, 3), st.just(0))
gaps = st.tuples(st.just("gap"), st.integers(0, 100), st.just(0))


@settings(max_examples=200, deadline=None)
@given(
    y=st.integers(3, 4),
    settle=st.integers(0, 60),
    shift=st.integers(0, 8),
    length=st.sampled_from([0, 4, 15, 16, 37, 64]),  # of 4^3 samples at least a sixteenth
    start=st.sampled_from([0, 5, 2**32 - 150]),
    events=st.lists(st.one_of(runs, runs, steps, gaps), max_size=40),
)
def test_blocks_equal_the_reference_whatever_comes(y, settle, shift, length, start, events):
    length = max(length, 4 ** (y - 2)) if length else 0
    fast, reference = Fast(y, settle, shift, length), Reference(y, settle, shift, length)
    index, seen, lost = start, 0, 0
    for kind, count, seed in events:
        if kind == "feed":
            samples = np.random.default_rng(seed).integers(0, U16 + 1, count).tolist()
            fast.feed(samples, index)
            reference.feed(samples, index)
            index, seen = index + count, seen + count
        elif kind == "step":
            fast.step(count)
            reference.step(count)
        else:
            fast.gap(count)
            reference.gap(count)
            index, lost = index + count, lost + count
    assert fast.blocks == reference.blocks
    reported = sum(block.count + block.discarded + block.lost for block in fast.blocks)
    held = fast.c.count + fast.c.discarded + fast.c.lost
    assert reported + held == seen + lost, "every sample is accounted for"


@pytest.mark.parametrize("counts", [(65535,), (65535, 1), (65534, 1), (70_000, 1000), (1, 65535)])
def test_more_lost_samples_than_a_block_can_count_are_its_maximum(counts):
    fast = Fast(3, 0, 0)
    for count in counts:
        fast.gap(count)
    fast.feed([5] * 64, 100_000)
    assert [block.lost for block in fast.blocks] == [65535]


@settings(max_examples=50, deadline=None)
@given(cuts=st.lists(st.integers(1, 100), min_size=1, max_size=60), seed=st.integers(0, U16))
def test_blocks_do_not_depend_on_how_samples_are_dealt_out(cuts, seed):
    samples = np.random.default_rng(seed).integers(0, 4096, 2000).tolist()
    whole, parts = Fast(3, 20, 2), Fast(3, 20, 2)
    for fast in (whole, parts):
        fast.step(1000)
    whole.feed(samples, 0)
    at = 0
    for cut in cuts:
        parts.feed(samples[at : at + cut], at)
        at += min(cut, len(samples) - at)
    parts.feed(samples[at:], at)
    assert parts.blocks == whole.blocks


@pytest.mark.parametrize("y", [3, 4, 5, 6, 7])
def test_largest_samples_do_not_overflow_a_whole_block(y):
    fast = Fast(y, 0, 8)
    fast.feed([U16] * (3 * 4**y), 0)
    assert [block.value for block in fast.blocks] == [(U16 * 4**y) >> y] * 3


@pytest.mark.parametrize("config", [(2, 0, 0), (8, 0, 0), (5, 9, 0), (4, 0, 257), (4, 0, 15)])
def test_configuration_out_of_range_is_refused(config):
    y, shift, length = config
    c = ffi.new("struct oversample *")
    assert not lib.oversample_init(c, {"y": y, "ema_shift": shift, "settle_samples": 0, "block_len": length})


def test_block_is_cut_at_a_phase_step_and_keeps_its_phase():
    fast = Fast(5, 20, 0)
    fast.step(2000)
    fast.feed([300] * (20 + 500), 0)
    fast.step(9000)
    fast.feed([200] * (20 + 1024), 520)
    assert [(b.first, b.count, b.phase, b.discarded) for b in fast.blocks] == [
        (20, 500, 2000, 20),
        (540, 1024, 9000, 20),
    ]
    assert fast.blocks[0].value == 500 * 300 >> 5


@pytest.mark.parametrize(("held", "worth"), [(63, False), (64, True)])
def test_cut_block_below_a_sixteenth_is_discarded(held, worth):
    fast = Fast(5, 0, 0)
    fast.feed([100] * held, 0)
    fast.step(1)
    assert bool(fast.blocks) == worth
    assert fast.c.discarded == (0 if worth else held)


def test_dropped_block_is_reported_as_lost_with_the_next():
    fast = Fast(3, 10, 0)
    fast.step(7)
    fast.feed([1] * 74, 0)
    lib.oversample_drop(fast.c, fast.block)
    fast.feed([1] * 64, 74)
    assert (fast.blocks[1].lost, fast.blocks[1].discarded) == (64, 10)


@pytest.mark.parametrize("more", [5535, 5536, 5537, 60000])
def test_counts_of_lost_samples_saturate(more):
    fast = Fast(3, 0, 0)
    fast.gap(60000)
    fast.gap(more)
    fast.feed([1] * 64, 0)
    assert fast.blocks[0].lost == U16


def test_a_dropped_block_hands_on_what_was_lost_before_it():
    fast = Fast(3, 10, 0)
    fast.gap(100)
    fast.feed([1] * 64, 100)
    lib.oversample_drop(fast.c, fast.block)
    fast.feed([1] * 64, 164)
    assert [block.lost for block in fast.blocks] == [100, 164]


@pytest.mark.parametrize(("length", "held", "worth"), [(4, 0, 0), (4, 1, 1), (33, 2, 0), (33, 3, 1)])
def test_a_cut_block_is_worth_a_message_from_a_sixteenth_on(length, held, worth):
    fast = Fast(3, 0, 0, length)
    fast.feed([100] * held, 0)
    fast.step(1)
    assert len(fast.blocks) == worth


def test_noise_turns_into_bits():
    """Eq 2: 4^5 samples of 12 bits carry 17, given noise (here half an LSB rms).

    The mean's own spread is 0.5/32 LSB, so 6 sigma is 0.1 LSB = 3 units of the 17-bit value; without
    oversampling steps of 0.3 LSB would not show at all.
    """
    generator = np.random.default_rng(1)
    for level in (1000.0, 1000.3, 1000.7):
        fast = Fast(5, 0, 0)
        fast.feed(np.floor(level + 0.5 * generator.standard_normal(1024) + 0.5).astype(int).tolist(), 0)
        assert fast.blocks[0].value == pytest.approx(level * 32, abs=3)


@settings(max_examples=100, deadline=None)
@given(
    shift=st.integers(0, 8),
    inputs=st.lists(st.integers(0, 2**23 - 1) | st.sampled_from([0, 2**23 - 1]), min_size=1, max_size=50),
)
def test_ema_equals_its_reference_at_any_input(shift, inputs):
    f = ffi.new("struct ema *")
    lib.ema_init(f, shift)
    state: int | None = None
    for value in inputs:
        state, expected = ema_reference(state, value, shift)
        assert lib.ema_update(f, value) == expected
        assert min(inputs) * 256 <= f.state <= max(inputs) * 256


def test_ema_follows_equation_4_within_its_rounding():
    """Each step rounds by at most 1/512 in 1/256 units and later steps shrink it: 2^shift / 512 in all."""
    shift, f, exact = 4, ffi.new("struct ema *"), None
    lib.ema_init(f, shift)
    for value in np.random.default_rng(2).integers(30000, 31000, 400).tolist():
        exact = value if exact is None else exact * (1 - 2**-shift) + value * 2**-shift
        assert lib.ema_update(f, value) == pytest.approx(exact, abs=0.5 + 2**shift / 512)


def test_ema_starts_anew_after_a_phase_step_and_leaves_cut_blocks_alone():
    fast = Fast(3, 0, 3)
    fast.feed([100] * 64 + [200] * 64, 0)
    fast.feed([400] * 30, 128)
    fast.step(5)
    fast.feed([50] * 64, 158)
    first, second, cut, anew = (block.value for block in fast.blocks)
    assert (first, second) == (800, 800 + 800 // 8)
    assert cut == 30 * 400 >> 3
    assert anew == 50 * 8


def test_blocks_are_values_not_views():
    fast = Fast(3, 0, 0)
    fast.feed(list(range(128)), 0)
    assert astuple(fast.blocks[0])[5:7] == (0, 63)
    assert astuple(fast.blocks[1])[5:7] == (64, 127)
