"""The C protocol machine against a reference MCU over lines of all qualities, in virtual time."""

from __future__ import annotations

import itertools
import random
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import chelper
import msgproto
from virtual_link import Damage, Line, ReferenceMcu, Rig, blocks_of

BYTE_S = 10 / 250_000  # 250 kBd


def make_rig(
    seed: int = 1, damage: Damage | None = None, mcu: ReferenceMcu | None = None, **line: float
) -> Rig:
    rng = random.Random(seed)
    damage = damage or Damage()
    return Rig(mcu or ReferenceMcu(), Line(rng, damage, **line), Line(rng, damage, **line))


def numbered(count: int, length: int = 8) -> list[bytes]:
    """Commands of equal length that carry their number: none can be lost, doubled or swapped unnoticed."""
    return [n.to_bytes(4, "big") + bytes(length - 4) for n in range(count)]


def executed(rig: Rig, length: int = 8) -> list[bytes]:
    stream = b"".join(content for _, content in rig.mcu.executed)
    return [stream[i : i + length] for i in range(0, len(stream), length)]


def greet(rig: Rig) -> None:
    """One command with an answer, as identify: settles the numbering."""
    rig.mcu._answer = lambda content: [b"\x00"] if content == b"\x01" else []
    cq = rig.queue()
    for _ in range(50):
        rig.send(cq, b"\x01")
        rig.run(rig.now + 1.0, lambda: bool(rig.received))
        if rig.received:
            break
    rig.run(rig.now + 1.0)
    assert rig.received, "no answer over this line"
    rig.mcu.executed.clear()


# --- a clean line ---


def test_first_block_is_the_documented_bytes_after_the_mcus_nak() -> None:
    rig = make_rig()
    rig.send(rig.queue(), bytes.fromhex("010028"))
    rig.run(1.1)
    assert rig.written[0][1].hex()[2:4] == "11", "the host starts at sequence 1"
    # the MCU expects 0: its nak moves the host there; a sync byte precedes what is sent again
    assert rig.written[1][1].hex() == "7e08100100285e9f7e"
    assert [c.hex() for _, c in rig.mcu.executed] == ["010028"]


@pytest.mark.parametrize("expected", range(16))
def test_host_finds_the_mcu_wherever_its_sequence_stands(expected: int) -> None:
    rig = make_rig(mcu=ReferenceMcu(expected=expected))
    greet(rig)
    cq = rig.queue()
    commands = numbered(100)
    for c in commands:
        rig.send(cq, c)
    rig.run(rig.now + 5.0)
    assert executed(rig) == commands


def test_commands_arrive_in_order_and_blocks_are_full() -> None:
    rig = make_rig()
    greet(rig)
    cq = rig.queue()
    commands = numbered(1000)
    for c in commands:
        rig.send(cq, c)
    rig.run(rig.now + 10.0)
    assert executed(rig) == commands
    full = 59 // 8 * 8
    assert [len(c) for _, c in rig.mcu.executed[:-1]] == [full] * (len(rig.mcu.executed) - 1)


@pytest.mark.parametrize("window", [0, 64, 192, 495])
def test_window_limits_are_never_exceeded(window: int) -> None:
    rig = make_rig(latency_s=0.02)
    rig.lib.serialqueue_set_wire(rig.sq, 250_000, window)
    greet(rig)
    cq = rig.queue()
    for c in numbered(500):
        rig.send(cq, c)
    rig.run(rig.now + 20.0)
    assert len(executed(rig)) == 500
    assert rig.max_unacked_blocks <= 12
    if window:
        assert rig.max_unacked_bytes <= window
    else:
        assert rig.max_unacked_blocks == 12, "an unlimited window must be used"


def test_throughput_at_250_kbaud_is_near_the_line_rate() -> None:
    rig = make_rig(byte_s=BYTE_S)
    rig.lib.serialqueue_set_wire(rig.sq, 250_000, 192)
    greet(rig)
    cq = rig.queue()
    start = rig.now
    commands = numbered(2000)
    for c in commands:
        rig.send(cq, c)
    rig.run(rig.now + 60.0, lambda: len(rig.mcu.executed) * 7 >= 2000)
    line_time_s = 2000 / 7 * 61 * BYTE_S
    # 192 bytes are in flight for 7.7 ms while the ack of a block needs 1.2 ms: nothing but start-up is lost
    assert rig.now - start < 1.05 * line_time_s


def test_send_is_prompt_when_the_line_is_idle() -> None:
    rig = make_rig()
    greet(rig)
    rig.lib.serialqueue_set_clock_est(rig.sq, 1e6, rig.now, 1_000_000)
    before = rig.now
    rig.send(rig.queue(), b"\x05")
    rig.run(rig.now + 0.010)
    assert rig.mcu.executed[-1][0] - before == pytest.approx(rig.to_mcu.latency_s, abs=1e-9)


# --- clocks ---


def with_clock(rig: Rig) -> int:
    """1 MHz from now on; returns the clock now."""
    greet(rig)
    rig.lib.serialqueue_set_clock_est(rig.sq, 1e6, rig.now, 1_000_000)
    return 1_000_000


def test_command_waits_until_it_is_needed_within_100_ms() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    start = rig.now
    rig.send(rig.queue(), b"\x05", req_clock=clock + 500_000)
    rig.run(rig.now + 1.0)
    ((when, _),) = rig.mcu.executed
    assert when - start == pytest.approx(0.400 + rig.to_mcu.latency_s, abs=1e-5)


def test_full_block_does_not_wait() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    start = rig.now
    cq = rig.queue()
    for c in numbered(8):
        rig.send(cq, c, req_clock=clock + 500_000)
    rig.run(rig.now + 0.1)
    assert len(executed(rig)) == 7, "one block is full"
    assert rig.mcu.executed[0][0] - start < 0.001
    rig.run(rig.now + 1.0)
    assert len(executed(rig)) == 8


def test_no_command_is_sent_before_its_min_clock() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    start = rig.now
    cq = rig.queue()
    for n, c in enumerate(numbered(50)):
        rig.send(cq, c, min_clock=clock + n * 10_000, req_clock=clock + n * 10_000 + 1)
    rig.run(rig.now + 2.0)
    assert executed(rig) == numbered(50)
    number = 0
    for when, content in rig.mcu.executed:
        number += len(content) // 8
        assert when - start >= (number - 1) * 0.010


def test_queues_are_merged_by_need() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    slow, fast = rig.queue(), rig.queue()
    for n in range(200):
        rig.send(slow, b"S" + bytes(19), req_clock=clock + 3_000_000 + n)
    rig.send(fast, b"F", req_clock=clock + 50_000)
    rig.run(rig.now + 0.05)
    order = b"".join(c for _, c in rig.mcu.executed).replace(bytes(19), b"")
    # only what was in the window and in the draft when it came may be ahead of it
    assert order.index(b"F") <= 2 * 13


def test_order_within_a_queue_is_kept_although_later_commands_are_more_urgent() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    cq = rig.queue()
    commands = numbered(20)
    for n, c in enumerate(commands):
        rig.send(cq, c, req_clock=clock + 2_000_000 - n * 50_000)
    rig.run(rig.now + 3.0)
    assert executed(rig) == commands


def test_background_commands_yield_to_all_others() -> None:
    rig = make_rig()
    clock = with_clock(rig)
    display, steps = rig.queue(), rig.queue()
    for _ in range(100):
        rig.send(display, b"D" + bytes(29), req_clock=0x7FFFFFFF00000000)
    for _ in range(100):
        rig.send(steps, b"S" + bytes(29), req_clock=clock + 1)
    rig.run(rig.now + 5.0)
    order = [c[0:1] for _, c in rig.mcu.executed]
    assert order.count(b"D") == order.count(b"S") == 100
    assert max(i for i, c in enumerate(order) if c == b"S") < 102


# --- bad lines ---

DAMAGES = {
    "corrupts": Damage(corrupt=0.003),
    "drops": Damage(drop=0.003),
    "doubles bytes": Damage(duplicate=0.003),
    "truncates": Damage(truncate=0.05),
    "repeats": Damage(repeat=0.05),
    "reorders": Damage(swap=0.05),
    "everything": Damage(0.001, 0.001, 0.001, 0.01, 0.01, 0.01),
}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", DAMAGES)
def test_everything_is_executed_once_and_in_order_over_a_line_that(kind: str, seed: int) -> None:
    rig = make_rig(seed)
    greet(rig)
    rig.to_mcu.damage = rig.to_host.damage = DAMAGES[kind]
    cq = rig.queue()
    commands = numbered(400)
    for c in commands:
        rig.send(cq, c)
    rig.run(rig.now + 300.0, lambda: len(executed(rig)) >= 400 and rig.stats().unacked_blocks == 0)
    assert executed(rig) == commands
    rig.run(rig.now + 1.0)
    assert executed(rig) == commands, "nothing is executed twice later"
    if kind not in ("repeats", "doubles bytes"):
        assert rig.stats().bytes_retransmit > 0, "the line did no harm: the test shows nothing"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**32),
    rates=st.tuples(*[st.floats(0.0, 0.01)] * 3, *[st.floats(0.0, 0.1)] * 3),
    lengths=st.lists(st.integers(4, 59), min_size=1, max_size=80),
    window=st.sampled_from([0, 64, 192]),
    latency_s=st.floats(0.0, 0.02),
)
def test_any_traffic_survives_any_line(
    seed: int, rates: tuple[float, ...], lengths: list[int], window: int, latency_s: float
) -> None:
    rig = make_rig(seed, latency_s=latency_s)
    greet(rig)
    rig.lib.serialqueue_set_wire(rig.sq, 250_000, window)
    rig.to_mcu.damage = rig.to_host.damage = Damage(*rates)
    cq = rig.queue()
    commands = [n.to_bytes(4, "big") + bytes(length - 4) for n, length in enumerate(lengths)]
    for n, c in enumerate(commands):
        rig.send(cq, c, notify_id=n + 1)
    sent = b"".join(commands)

    def done() -> bool:
        return sum(len(c) for _, c in rig.mcu.executed) >= len(sent) and rig.stats().unacked_blocks == 0

    rig.run(rig.now + 600.0, done)
    assert b"".join(c for _, c in rig.mcu.executed) == sent
    rig.run(rig.now + 0.1)
    assert [n for _, _, _, n in rig.received if n] == list(range(1, len(commands) + 1)), (
        "each notice once, in order"
    )


def test_lost_block_is_sent_again_at_once_when_a_later_one_is_refused() -> None:
    rig = make_rig()
    greet(rig)
    cq = rig.queue()
    rig.send(cq, b"\x0b" * 59)
    rig.run(rig.now + 0.2)
    rig.to_mcu.damage = Damage(drop=1.0)  # this one is lost
    rig.send(cq, b"\x0c" * 59)
    rig._transmit()
    rig.to_mcu.damage = Damage()
    start = rig.now
    for c in (b"\x0d", b"\x0e"):
        rig.send(cq, c * 59)
    rig.run(rig.now + 0.010)
    assert [c[0] for _, c in rig.mcu.executed] == [11, 12, 13, 14]
    # one round trip (the nak) and the way there: long before the time-out of at least 25 ms
    assert rig.mcu.executed[1][0] - start == pytest.approx(3 * rig.to_mcu.latency_s, abs=1e-6)
    resent = rig.written[-1][1]
    assert resent[0] == msgproto.BLOCK_SYNC and len(blocks_of(resent)) == 3


def test_one_lost_block_costs_one_retransmission_although_many_naks_come() -> None:
    rig = make_rig(latency_s=0.01)
    greet(rig)
    cq = rig.queue()
    before = rig.stats().bytes_retransmit
    rig.to_mcu.damage = Damage(drop=1.0)
    rig.send(cq, b"\x0c" * 59)
    rig._transmit()
    rig.to_mcu.damage = Damage()
    for n in range(11):
        rig.send(cq, bytes([n]) * 59)
    rig.run(rig.now + 2.0)
    assert len(rig.mcu.executed) == 12
    assert rig.stats().bytes_retransmit - before <= 12 * 64 + 1


def test_late_acknowledgement_is_not_taken_for_one_of_a_whole_window() -> None:
    rig = make_rig()
    greet(rig)
    cq = rig.queue()
    for n in range(20):
        rig.send(cq, bytes([n]) * 59)
    rig.run(rig.now + 0.2)
    assert len(rig.mcu.executed) == 20
    rig.to_mcu.damage = Damage(drop=1.0)
    for n in range(12):
        rig.send(cq, bytes([n]) * 59)
    rig._transmit()
    assert rig.stats().unacked_blocks == 12
    late = msgproto.encode_block(rig.mcu.expected - 4, b"")  # = + 12: as if the whole window had arrived
    rig._host_receive(late)
    rig._host_receive(late)
    assert rig.stats().unacked_blocks == 12
    rig.to_mcu.damage = Damage()
    rig.run(rig.now + 1.0)
    assert len(rig.mcu.executed) == 32


def test_acknowledgements_lost_in_a_row_are_accepted_after_the_next_retransmission() -> None:
    rig = make_rig()
    greet(rig)
    cq = rig.queue()
    rig.to_host.damage = Damage(drop=1.0)
    for n in range(12):
        rig.send(cq, bytes([n]) * 59)
    rig.run(rig.now + 0.005)
    rig.to_host.damage = Damage()
    rig.run(rig.now + 1.0)
    assert len(rig.mcu.executed) == 12 and rig.stats().unacked_blocks == 0


# --- time-outs ---


def test_time_out_starts_as_rfc6298_says_doubles_after_a_second_and_ends_at_5_s() -> None:
    rig = make_rig(latency_s=0.010)
    greet(rig)
    for _ in range(50):  # let the estimate settle on a line without jitter
        rig.send(rig.queue(), b"\x05")
        rig.run(rig.now + 0.1)
    assert rig.stats().srtt == pytest.approx(0.020, rel=0.01)
    assert rig.stats().rto == pytest.approx(0.025, abs=1e-6), "the lower bound"
    rig.to_mcu.damage = Damage(drop=1.0)
    rig.send(rig.queue(), b"\x06")
    start = rig.now
    rig.run(rig.now + 60.0)
    times = [t - start for t, _ in rig.written if t >= start]
    gaps = [b - a for a, b in itertools.pairwise(times)]
    expected = [
        0.025,
        *[0.05] * 20,
        0.1,
        0.2,
        0.4,
        0.8,
        1.6,
        3.2,
    ]  # a line cut for a moment is used soon after
    assert gaps[: len(expected)] == pytest.approx(expected, rel=1e-3)
    assert max(gaps) == pytest.approx(5.0, rel=1e-6)
    rig.to_mcu.damage = Damage()
    rig.run(rig.now + 6.0)
    assert rig.mcu.executed[-1][1] == b"\x06", "the line is back: the command arrives within one time-out"


def test_time_out_follows_the_round_trip() -> None:
    rig = make_rig(latency_s=0.050, jitter_s=0.020)
    greet(rig)
    before = rig.stats().timeouts  # the first block may run into the time-out of the start, 0.1 s
    for _ in range(100):
        rig.send(rig.queue(), b"\x05")
        rig.run(rig.now + 0.5)
    stats = rig.stats()
    assert 0.100 < stats.srtt < 0.140
    # jitter 0..20 ms each way: mean deviation about 6.7 ms, RFC 6298 takes four times that
    assert stats.srtt + 0.010 < stats.rto < stats.srtt + 0.060
    assert stats.timeouts == before


def test_time_on_the_wire_is_not_taken_for_a_lost_block() -> None:
    # 12 full blocks need 31 ms at 250 kBd, longer than the shortest time-out
    rig = make_rig(byte_s=BYTE_S)
    rig.lib.serialqueue_set_wire(rig.sq, 250_000, 0)
    greet(rig)
    cq = rig.queue()
    for c in numbered(1000):
        rig.send(cq, c)
    rig.run(rig.now + 10.0)
    assert rig.stats().bytes_retransmit <= 64, "only the first block, before the numbers were settled"


# --- the host's side ---


def test_answer_and_notice_carry_when_the_command_had_left() -> None:
    rig = make_rig(byte_s=BYTE_S)
    greet(rig)
    rig.lib.serialqueue_set_wire(rig.sq, 250_000, 192)
    rig.received.clear()
    rig.mcu._answer = lambda content: [b"\x07\x08"]
    start = rig.now
    rig.send(rig.queue(), b"\x05\x06", notify_id=42)
    rig.run(rig.now + 0.1)
    (_, nothing, sent0, notify), (_, content, sent1, no_notify) = rig.received
    assert (nothing, notify, content, no_notify) == (b"", 42, b"\x07\x08", 0), (
        "the notice comes before the answer"
    )
    assert sent0 == sent1 == pytest.approx(start + 7 * BYTE_S)


def test_sent_time_is_unknown_for_what_was_sent_twice() -> None:
    rig = make_rig()
    greet(rig)
    rig.received.clear()
    rig.mcu._answer = lambda content: [b"\x07"]
    rig.to_mcu.damage = Damage(drop=1.0)
    rig.send(rig.queue(), b"\x05")
    rig._transmit()
    rig.to_mcu.damage = Damage()
    rig.run(rig.now + 1.0)
    assert [(c, sent) for _, c, sent, _ in rig.received] == [(b"\x07", 0.0)]


@pytest.mark.parametrize("length", [0, 60, 64])
def test_impossible_lengths_are_refused(length: int) -> None:
    rig = make_rig()
    assert rig.lib.serialqueue_send(rig.sq, rig.queue(), bytes(64), length, 0, 0, 0) == -1


def test_reset_forgets_the_old_connection() -> None:
    rig = make_rig()
    greet(rig)
    cq = rig.queue()
    rig.send(cq, b"old")
    rig.to_mcu.damage = Damage(drop=1.0)
    rig.run(rig.now + 0.01)
    rig.lib.serialqueue_reset(rig.sq, 0)
    rig.to_mcu.damage = Damage()
    rig.mcu.expected = 0
    greet(rig)
    rig.send(cq, b"new")
    rig.run(rig.now + 1.0)
    assert [c for _, c in rig.mcu.executed] == [b"new"]


# --- file mode ---


def test_file_mode_writes_all_blocks_with_rolling_sequence() -> None:
    ffi, lib = chelper.get_ffi()
    sq = ffi.gc(lib.serialqueue_alloc(1), lib.serialqueue_free)
    cq = lib.serialqueue_alloc_commandqueue(sq)
    commands = numbered(1000)
    for c in commands:
        assert lib.serialqueue_send(sq, cq, c, len(c), 2**40, 2**41, 0) == 0
    assert lib.serialqueue_file_pending(sq, 1) > 0
    out, wake, data = ffi.new("uint8_t[1000]"), ffi.new("double *"), b""
    while n := lib.serialqueue_transmit(sq, out, 1000, 0.0, wake):
        data += bytes(ffi.buffer(out, n))
    blocks = blocks_of(data)
    assert b"".join(b.content for b in blocks) == b"".join(commands)
    assert [b.seq for b in blocks] == [(n + 1) & 15 for n in range(len(blocks))]
    assert sum(len(b.content) + 5 for b in blocks) == len(data)


def test_batches_of_step_commands_are_fast_enough_for_files() -> None:
    ffi, lib = chelper.get_ffi()
    sq = ffi.gc(lib.serialqueue_alloc(1), lib.serialqueue_free)
    cq = lib.serialqueue_alloc_commandqueue(sq)
    out, wake = ffi.new("uint8_t[65536]"), ffi.new("double *")
    spent = 0.0
    for _ in range(20):
        head = ffi.NULL
        for _ in range(1000):
            m = lib.message_alloc()
            m.len, m.next = 9, head
            head = m
        begun = time.process_time()
        assert lib.serialqueue_send_batch(sq, cq, head) == 1000
        while lib.serialqueue_transmit(sq, out, 65536, 0.0, wake):
            pass
        spent += time.process_time() - begun
    # peers print 43,000 moves a second with some 20 commands each; this must be a small part of that second:
    # 20,000 commands in 20 ms are a million a second
    assert spent < 0.020


# --- messages that may wait for the host ---


def test_only_a_batch_waits_and_only_for_so_many_and_so_long() -> None:
    ffi, lib = chelper.get_ffi()
    sq = ffi.gc(lib.serialqueue_alloc(0), lib.serialqueue_free)
    pulled = ffi.new("struct pull_message[]", 8)
    never = 1e30
    soon = pytest.approx(7.015, abs=0.003)  # less its time on the wire

    def receive(content: bytes, now: float) -> tuple[int, float]:
        block = msgproto.encode_block(1, content)
        return lib.serialqueue_receive(sq, block, len(block), now), float(lib.serialqueue_host_due(sq))

    def batch(now: float) -> list[bytes]:
        count = lib.serialqueue_pull_batch(sq, pulled, 8, now)
        return [ffi.buffer(pulled[i].data, pulled[i].len)[2:] for i in range(count)]

    lib.serialqueue_set_batch(sq, b"\x81\x05", 2, 0.015, 3)
    assert lib.serialqueue_host_due(sq) == never
    assert receive(b"\x81\x05one", 7.0) == (0, soon)
    assert receive(b"\x81\x05two", 7.005) == (0, soon)
    assert batch(7.005) == []
    assert receive(b"\x81\x05three", 7.010) == (3, 0.0)  # as many as may wait
    assert batch(7.010) == [b"one", b"two", b"three"]
    assert lib.serialqueue_host_due(sq) == never
    receive(b"\x81\x05late", 7.5)
    assert batch(7.51) == [] and batch(7.52) == [b"late"]
    # another message is the host's at once, and leaves what waits where it is
    assert receive(b"\x81\x05still", 8.0)[0] == 0
    assert receive(b"\x81\x06", 8.0) == (1, 0.0)
    assert lib.serialqueue_pull(sq, pulled, 8) == 1
    assert batch(8.0) == []
    lib.serialqueue_set_batch(sq, b"\x81\x05", 2, 0.015, 0)  # patience is over
    assert lib.serialqueue_host_due(sq) == 0.0
    assert batch(8.0) == [b"still"]
    assert receive(b"\x81\x05now", 9.0) == (1, 0.0)
    lib.serialqueue_reset(sq, 0)  # another connection: another firmware's ids
    assert lib.serialqueue_host_due(sq) == never
    assert receive(b"\x81\x05", 10.0) == (1, 0.0)
    assert lib.serialqueue_pull(sq, pulled, 8) == 1
