"""The whole induction unit through its messages: the real firmware on a simulated MCU."""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass

import pytest

from block_codec import one_step, unpack
from mcu_harness import FREQ, Mcu
from pure_harness import Plant

PERIOD = 600  # ticks: 120 kHz
MAX_DURATION = FREQ // 10
SETTLE = 20
CLIPPED = "Induction coil signal at the end of the ADC's range"
TIMEOUT = "Induction bridge off: no phase command from the host in time"


@dataclass(frozen=True)
class Record:
    number: int  # running, from the message's sequence
    clock: int  # of its first sample
    count: int
    value: int
    phase: int
    min: int
    max: int
    discarded: int
    lost: int
    message: int  # which message brought it
    sent: int  # when that was sent


class Unit:
    def __init__(
        self,
        *limits: tuple[int, int, int, int],
        y: int = 5,
        shift: int = 0,
        block: tuple[int, int] | None = None,
        tests: dict[str, int] | None = None,
        **changes: int,
    ) -> None:
        self.mcu = Mcu()
        self.block_len = block[0] if block else 4**y
        config = {"oid": 0, "bridge": 0, "adc_pin": 3, "period_ticks": PERIOD, "phase_max": 45000}
        config |= {"max_duration": MAX_DURATION} | changes
        sense = {"oid": 0, "oversample": y, "settle_samples": SETTLE, "ema_shift": shift}
        rows = [
            dict(zip(("oid", "phase", "low", "high", "trip_blocks"), (0, *row), strict=True))
            for row in limits
        ]
        self.mcu.configure(
            1,
            ("config_induction", config),
            ("config_induction_sense", sense),
            *(
                [("config_induction_block", {"oid": 0, "samples": block[0], "records": block[1]})]
                if block
                else []
            ),
            *(("config_induction_limit", row) for row in rows),
            *([("config_induction_test", {"oid": 0, **tests})] if tests else []),
        )

    def phase(self, phase: int, delay_s: float = 0.001) -> int:
        clock = self.mcu.now + round(delay_s * FREQ)
        self.mcu.send("queue_induction_plan", oid=0, clock=clock & 0xFFFFFFFF, steps=one_step(phase))
        return clock

    def hold(self, phase: int, seconds: float) -> None:
        """Keep sending the same phase, as a live host does."""
        end = self.mcu.now + round(seconds * FREQ)
        while self.mcu.now < end:
            self.phase(phase)
            self.mcu.run_to(min(end, self.mcu.now + FREQ // 25))

    def report(self, enable: int = 1) -> None:
        self.mcu.send("induction_report", oid=0, enable=enable)

    def state(self):
        return self.mcu.ask("induction_query", oid=0)

    def records(self) -> list[Record]:
        out: list[Record] = []
        for index, message in enumerate(self.mcu.replies("induction_block")):
            for place, row in enumerate(unpack(bytes(message["data"]), self.block_len)):
                clock = message["clock"] + row.offset * PERIOD
                fields = (row.count, row.value, row.phase, row.low, row.high, row.discarded, row.lost)
                out.append(
                    Record(message["sequence"] + place, clock, *fields, message=index, sent=message.clock)
                )
        return out


def test_blocks_follow_one_another_without_a_hole():
    unit = Unit(block=(1024, 2))
    unit.report()
    unit.mcu.run(0.2)
    records = unit.records()
    assert len(records) == 22  # 0.2 s / 8.53 ms = 23.4 blocks, the last whole pair sent
    assert [r.number for r in records] == list(range(22))
    for before, after in itertools.pairwise(records):
        assert after.clock == before.clock + before.count * PERIOD
    assert {(r.count, r.value, r.phase, r.min, r.max, r.discarded, r.lost) for r in records} == {
        (1024, 1000 * 32, 0, 1000, 1000, 0, 0)
    }


def test_records_go_out_in_pairs_unless_that_would_take_too_long():
    pairs = Unit(block=(1024, 2))
    pairs.report()
    pairs.mcu.run(0.1)
    assert [r.message for r in pairs.records()][:6] == [0, 0, 1, 1, 2, 2]
    single = Unit(y=6)  # 34 ms a block: waiting for a second one would be longer than 20 ms
    single.report()
    single.mcu.run(0.15)
    records = single.records()
    assert len(records) == 4 and len({r.message for r in records}) == 4
    for record in records:  # sent at the half buffer that completes it
        end = record.clock + (record.count - 1) * PERIOD
        assert 0 <= record.sent - end <= 32 * PERIOD


def test_short_blocks_go_out_three_together():
    unit = Unit(y=4, block=(192, 3))
    unit.report()
    unit.mcu.run(0.1)
    records = unit.records()
    assert len(records) == 60  # 0.1 s / 1.6 ms = 62.5 blocks, the last three whole
    assert [r.message for r in records][:6] == [0, 0, 0, 1, 1, 1]
    assert {(r.count, r.value) for r in records} == {(192, 192 * 1000 >> 4)}
    for before, after in itertools.pairwise(records):
        assert after.clock == before.clock + 192 * PERIOD


def test_long_batches_of_long_records_are_divided_and_whole():
    unit = Unit(y=4, block=(192, 7), max_duration=FREQ)
    unit.mcu.sample_code = lambda clock: 20 if clock // PERIOD % 2 else 4000
    unit.report()
    unit.mcu.run(0.001)
    for i in range(40):  # a phase step in the middle of every second block: cut, gap, phase and wide
        unit.phase(9000 + 100 * (i % 2), 0.0005)
        unit.mcu.run(0.0027)
    records = unit.records()
    assert len(records) > 60
    sizes = [len(list(group)) for _, group in itertools.groupby(records, lambda r: r.message)]
    assert min(sizes[:-1]) >= 3 and max(sizes) < 7
    assert [r.number for r in records] == list(range(len(records)))
    for before, after in itertools.pairwise(records):
        between = (after.clock - before.clock) // PERIOD - before.count
        assert between == after.discarded + after.lost


def test_the_same_phase_again_feeds_the_watchdog_and_costs_no_block():
    unit = Unit(y=4, block=(192, 3))
    unit.report()
    clock = unit.mcu.now + FREQ // 100
    steps = b"".join(struct.pack("<HH", at, 9000) for at in (0, 9600, 9600))  # again after 80 and 160 ms
    unit.mcu.send("queue_induction_plan", oid=0, clock=clock & 0xFFFFFFFF, steps=steps)
    unit.mcu.run(0.010 + 0.160 + 0.099)
    assert not unit.mcu.shutdown_reason()
    held = [r for r in unit.records() if r.phase == 9000]
    assert len(held) > 150 and {r.count for r in held} == {192}
    assert [r.discarded for r in held] == [SETTLE] + [0] * (len(held) - 1)
    assert unit.mcu.bridge_sets[-1][1] == 9000
    unit.mcu.run(0.005)
    assert unit.mcu.bridge_sets[-1][1] == 0


@pytest.mark.parametrize("records", [0, 8])
def test_a_batch_out_of_range_is_refused(records):
    unit = Unit(y=4)
    unit.mcu.send("config_induction_block", oid=0, samples=192, records=records)
    unit.mcu.run(0.01)
    assert unit.mcu.shutdown_reason() == "Invalid induction configuration"


def test_a_wide_span_and_a_long_pause_come_through_whole():
    unit = Unit(y=4, block=(192, 3))
    unit.mcu.sample_code = lambda clock: 20 if clock // PERIOD % 2 else 4000
    unit.report()
    unit.phase(9000, 0.010)
    unit.mcu.run(0.05)
    records = unit.records()
    assert {(r.min, r.max) for r in records} == {(20, 4000)}
    assert sum(r.discarded for r in records) == SETTLE


@pytest.mark.parametrize(("samples", "records"), [(257, 2), (15, 2), (192, 0), (192, 8)])
def test_block_settings_out_of_range_are_refused(samples, records):
    unit = Unit(y=4)
    unit.mcu.send("config_induction_block", oid=0, samples=samples, records=records)
    unit.mcu.run(0.01)
    assert unit.mcu.shutdown_reason() == "Invalid induction configuration"


def test_phase_takes_effect_at_its_clock_and_cuts_the_block_there():
    unit = Unit()
    unit.report()
    unit.mcu.run(0.010)
    clock = unit.phase(20000, 0.005)
    unit.mcu.run(0.05)
    changed = next(at for at, phase in unit.mcu.bridge_sets if phase == 20000)
    assert clock < changed <= clock + PERIOD  # the next period edge
    records = unit.records()
    cut = next(i for i, r in enumerate(records) if r.phase == 20000)
    before, after = records[cut - 1], records[cut]
    assert before.phase == 0 and before.count < 1024
    assert before.clock + before.count * PERIOD == changed
    assert after.clock == changed + SETTLE * PERIOD
    assert after.discarded == SETTLE and after.count == 1024
    assert before.value == before.count * 1000 >> 5


def test_every_sample_is_reported():
    unit = Unit(max_duration=FREQ)
    unit.report()
    for phase, delay in ((5000, 0.013), (5100, 0.0135), (9000, 0.03), (0, 0.0441), (7000, 0.0442)):
        unit.phase(phase, delay)
    unit.mcu.run(0.2)
    records = unit.records()
    for before, after in itertools.pairwise(records):
        between = (after.clock - before.clock) // PERIOD - before.count
        assert between == after.discarded + after.lost
    assert [r.phase for r in records if r.count < 1024] == [0, 5100, 9000]


def test_queued_phases_are_applied_in_order():
    unit = Unit()
    clocks = [unit.phase(1000 * (i + 1), 0.001 * (i + 1)) for i in range(20)]
    unit.mcu.run(0.03)
    sent = [(at, phase) for at, phase in unit.mcu.bridge_sets if phase]
    assert [phase for _, phase in sent] == [1000 * (i + 1) for i in range(20)]
    assert all(0 < at - clock <= PERIOD for (at, _), clock in zip(sent, clocks, strict=True))


def plan(unit: Unit, delay_s: float, *steps: tuple[int, int]) -> int:
    """Send a plan from `delay_s` on: (periods after the step before, phase); its clock."""
    clock = unit.mcu.now + round(delay_s * 72e6)
    unit.mcu.send(
        "queue_induction_plan", oid=0, clock=clock, steps=b"".join(struct.pack("<HH", *s) for s in steps)
    )
    return clock


def test_a_plan_takes_the_place_of_what_was_pending_from_its_clock_on():
    unit = Unit()
    start = unit.mcu.now
    plan(unit, 0.002, (0, 1000), (240, 2000), (240, 3000), (240, 4000))  # 2, 4, 6, 8 ms
    plan(unit, 0.005, (0, 5000), (480, 0))  # 5, 9 ms
    unit.mcu.run(0.015)
    sent = [(round((at - start) / 72e3), phase) for at, phase in unit.mcu.bridge_sets if at > start]
    assert sent == [(2, 1000), (4, 2000), (5, 5000), (9, 0)]


def test_a_plan_that_comes_late_goes_on_where_it_should_be_now():
    unit = Unit()
    unit.mcu.run(0.020)
    plan(unit, -0.010, (0, 1000), (600, 2000), (1200, 3000))  # 10 and 5 ms ago, in 5 ms
    unit.mcu.run(0.002)
    assert unit.mcu.bridge_sets[-1][1] == 2000
    unit.mcu.run(0.004)
    assert unit.mcu.bridge_sets[-1][1] == 3000


def test_plans_give_their_places_in_the_queue_back():
    unit = Unit()
    for _ in range(500):  # many times the move queue
        plan(unit, 0.010, *[(120, 3000 + i) for i in range(10)])
        unit.mcu.run(0.001)
    assert unit.mcu.shutdown_reason() is None


def test_a_torn_plan_is_refused():
    unit = Unit()
    unit.mcu.send("queue_induction_plan", oid=0, clock=unit.mcu.now, steps=b"123")
    unit.mcu.run(0.001)
    assert unit.mcu.shutdown_reason() is not None


def test_a_late_phase_is_applied_at_once():
    unit = Unit()
    unit.mcu.run(0.01)
    unit.phase(3000, -0.005)
    unit.phase(4000, -0.004)
    unit.mcu.run(0.001)
    assert unit.mcu.bridge_sets[-1][1] == 4000
    assert unit.mcu.shutdown_reason() is None


def test_power_that_comes_later_than_max_duration_is_not_given_but_off_is_off():
    unit = Unit()
    unit.mcu.run(0.3)
    unit.phase(3000, -0.102)
    unit.mcu.run(0.001)
    assert unit.mcu.bridge_sets[-1][1] == 0
    unit.phase(3000, -0.098)
    unit.mcu.run(0.001)
    assert unit.mcu.bridge_sets[-1][1] == 3000
    unit.phase(0, -0.097)
    unit.mcu.run(0.001)
    assert unit.mcu.bridge_sets[-1][1] == 0
    assert unit.mcu.shutdown_reason() is None


def test_phase_above_the_configured_maximum_is_held_to_it():
    unit = Unit(phase_max=20125)
    unit.phase(30000)
    unit.mcu.run(0.01)
    assert unit.mcu.bridge_sets[-1][1] == 20125


@pytest.mark.parametrize("last_phase", [2012, 45000])
def test_a_dead_host_has_the_bridge_off_within_max_duration_and_the_board_stopped_after_three_seconds(
    last_phase,
):
    unit = Unit()
    clock = unit.phase(last_phase)
    unit.mcu.run(2.99)
    at, phase = unit.mcu.bridge_sets[-1]
    assert phase == 0
    assert clock < at <= clock + MAX_DURATION + PERIOD
    assert unit.mcu.shutdown_reason() is None
    unit.mcu.run(0.02)
    assert unit.mcu.shutdown_reason() == TIMEOUT
    assert unit.state()["trip"] == 5


def test_a_late_host_has_the_bridge_off_until_its_next_command():
    unit = Unit()
    unit.phase(2012)
    unit.mcu.run(0.8)
    assert unit.mcu.bridge_sets[-1][1] == 0
    clock = unit.phase(3000)
    unit.mcu.run(0.05)
    at, phase = unit.mcu.bridge_sets[-1]
    assert phase == 3000 and clock < at <= clock + PERIOD
    unit.phase(0)
    unit.mcu.run(4.0)
    assert unit.mcu.shutdown_reason() is None
    assert unit.state()["trip"] == 0


def test_a_phase_queued_too_far_ahead_does_not_turn_the_bridge_on_again():
    unit = Unit()
    clock = unit.phase(2012)
    unit.phase(2012, 0.15)
    unit.mcu.run(0.3)
    assert unit.mcu.bridge_sets[-1][1] == 0
    assert unit.mcu.bridge_sets[-1][0] <= clock + MAX_DURATION + PERIOD
    for _ in range(500):  # many times the move queue: what was forgotten is free again
        unit.phase(2012, 0.15)
        unit.phase(2012, 0.05)
        unit.mcu.run(0.2)
    assert unit.mcu.shutdown_reason() is None


def test_a_live_host_keeps_it_on_and_phase_0_needs_no_host():
    unit = Unit()
    unit.hold(2012, 0.5)
    unit.phase(0)
    unit.mcu.run(1.0)
    assert unit.mcu.shutdown_reason() is None
    assert unit.state()["trip"] == 0


def test_shutdown_switches_off_at_once_and_forgets_what_was_queued():
    unit = Unit()
    unit.report()
    unit.hold(9000, 0.05)
    unit.phase(45000, 0.02)
    now = unit.mcu.now
    unit.mcu.send("emergency_stop")
    assert unit.mcu.bridge_sets[-1] == (now, 0)
    sent = len(unit.records())
    unit.mcu.run(0.1)
    assert unit.mcu.bridge_sets[-1][1] == 0
    assert len(unit.records()) == sent, "no reports to a host that is not listening"
    assert unit.state()["phase"] == 0


def test_after_clear_shutdown_it_works_again():
    unit = Unit()
    unit.hold(9000, 0.05)
    unit.mcu.send("emergency_stop")
    unit.mcu.run(0.01)
    unit.mcu.send("clear_shutdown")
    unit.report()
    unit.hold(9000, 0.1)
    assert unit.mcu.bridge_sets[-1][1] == 9000
    records = unit.records()
    assert records[0].number == 0 and records[-1].phase == 9000
    assert sum(r.lost for r in records) == 0


@pytest.mark.parametrize(
    ("codes", "reason", "trip"),
    [
        (lambda clock: 100 + clock // PERIOD % 2, "Induction coil signal below its limit", 1),
        (lambda clock: 2000 + clock // PERIOD % 2, "Induction coil signal above its limit", 2),
        (
            lambda clock: 0 if clock // PERIOD % 3 == 0 else 900,
            "Induction coil signal at the end of the ADC's range",
            3,
        ),
    ],
)
def test_guard_trips_after_its_blocks_with_the_bridge_off(codes, reason, trip):
    unit = Unit((2000, 300, 1500, 3))
    unit.mcu.sample_code = lambda clock: 800 + clock // PERIOD % 2
    unit.hold(5000, 0.1)
    assert unit.mcu.shutdown_reason() is None
    unit.mcu.sample_code = codes
    broke = unit.mcu.now
    unit.hold(5000, 0.1)
    assert unit.mcu.shutdown_reason() == reason
    off = unit.mcu.bridge_sets[-1]
    assert off[1] == 0
    assert off[0] - broke < (4 * 1024 + 64) * PERIOD, "three whole blocks after the one it broke in, at most"
    state = unit.state()
    assert state["trip"] == trip
    mean = sum(codes(i * PERIOD) for i in range(6)) / 6
    assert state["value"] == pytest.approx(mean * 32, abs=16)


def test_one_code_trips_once_the_phase_has_moved():
    unit = Unit((2000, 300, 1500, 3))
    unit.mcu.sample_code = lambda clock: 700
    unit.hold(5000, 0.3)
    assert unit.mcu.shutdown_reason() is None, "a front end without noise shows one code at one phase"
    moved = unit.phase(20000)
    unit.mcu.run(0.1)
    assert unit.mcu.shutdown_reason() == "Induction coil signal stands still"
    off = unit.mcu.bridge_sets[-1]
    assert off[1] == 0
    assert off[0] - moved < (4 * 1024 + 64) * PERIOD
    assert unit.state()["trip"] == 4


def test_a_tripped_guard_refuses_power_after_clear_shutdown():
    unit = Unit()
    unit.phase(2012)
    unit.mcu.run(3.1)
    unit.mcu.send("clear_shutdown")
    unit.phase(2012)
    unit.mcu.run(0.01)
    assert unit.mcu.bridge_sets[-1][1] == 0
    assert unit.mcu.shutdown_reason() == TIMEOUT


def test_without_limits_a_dead_sensor_does_not_trip():
    unit = Unit()
    unit.mcu.sample_code = lambda clock: 0
    unit.hold(5000, 0.2)
    assert unit.mcu.shutdown_reason() is None


@pytest.mark.parametrize(
    ("name", "values", "reason"),
    [
        ("queue_induction_plan", {"clock": 10**6, "steps": one_step(45001)}, "Induction phase out of range"),
        ("config_induction_sense", {"oversample": 8, "settle_samples": 0, "ema_shift": 0}, None),
        ("config_induction_limit", {"phase": 1, "low": 9, "high": 3, "trip_blocks": 1}, None),
    ],
)
def test_values_out_of_range_shut_down_with_a_reason(name, values, reason):
    unit = Unit()
    unit.mcu.send(name, oid=0, **values)
    unit.mcu.run(0.01)
    assert unit.mcu.shutdown_reason() == (reason or "Invalid induction configuration")


def test_a_step_more_than_half_the_clock_after_the_one_before_is_refused():
    unit = Unit(period_ticks=40000)
    steps = one_step(1000) + struct.pack("<HH", 65535, 2000)
    unit.mcu.send("queue_induction_plan", oid=0, clock=unit.mcu.now + FREQ // 100, steps=steps)
    unit.mcu.run(0.03)
    assert unit.mcu.shutdown_reason() == "Induction phase commands out of order"
    assert unit.mcu.bridge_sets[-1][1] == 0


def test_a_stalled_reader_is_reported_what_it_missed():
    """Reports off and on again start a new sequence; blocks in between are not kept."""
    unit = Unit()
    unit.report()
    unit.mcu.run(0.05)
    unit.report(0)
    sent = len(unit.records())
    unit.mcu.run(0.05)
    assert len(unit.records()) == sent
    unit.report()
    unit.mcu.run(0.05)
    assert unit.records()[sent].number == 0


TESTS = {"moved_low": 16 * 72, "moved_high": 16 * 98, "off_low": 246, "off_high": 266, "interval": 1200}
TESTS |= {"tolerance": 26, "slack": 16, "phase": 2012, "jump": 240, "rise": 16, "fall": 1}


def answering(frozen_s: float = 9.0, stuck_s: float = 9.0, stopped_s: float = 9.0) -> Unit:
    """A unit with all tests on a signal that answers them, until a fault sets in."""
    unit = Unit(y=4, block=(192, 3), tests=TESTS)

    def code(clock: int) -> int:
        noise = clock // PERIOD * 7 % 3 - 1
        if clock > frozen_s * FREQ:
            return 450 + noise
        phase = max(((at, phase) for at, phase in unit.mcu.bridge_sets if at <= clock), default=(0, 0))[1]
        late = max(((at, ticks) for at, ticks in unit.mcu.sampling_moves if at <= clock), default=(0, 0))[1]
        driven = phase or clock > stuck_s * FREQ
        return noise + (450 + 12 * late if driven else 256)

    unit.mcu.sample_code = code
    unit.report()
    return unit


def test_tests_of_the_signal_run_while_the_bridge_is_driven_and_their_samples_reach_no_block():
    unit = answering()
    unit.hold(14230, 0.2)
    assert unit.state()["trip"] == 0
    moves = [clock for clock, ticks in unit.mcu.sampling_moves if ticks]
    assert max(b - a for a, b in itertools.pairwise(moves[:4])) < 0.002 * FREQ, "these are learned from"
    assert unit.state()["moved"] == 16 * 84
    moves = moves[3:]
    offs = [clock for clock, phase in unit.mcu.bridge_sets[2:] if not phase]
    assert 6 <= len(moves) <= 10 and 6 <= len(offs) <= 10
    driven = [r for r in unit.records() if r.phase == 14230]
    assert {(r.min, r.max) for r in driven} == {(449, 451)}
    for before, after in itertools.pairwise(driven):
        assert after.clock == before.clock + (before.count + after.discarded + after.lost) * PERIOD
    assert max(b - a for a, b in itertools.pairwise(moves)) < 0.027 * FREQ


@pytest.mark.parametrize(
    ("fault", "text", "within_s"),
    [
        ("frozen_s", "Induction coil signal does not follow its sampling instant", 0.030),
        ("stuck_s", "Induction coil carries current though the bridge is off", 0.030),
    ],
)
def test_a_signal_that_does_not_answer_shuts_down_with_the_bridge_off(fault, text, within_s):
    unit = answering(**{fault: 0.1})
    unit.hold(14230, 0.1 + within_s)
    assert unit.mcu.shutdown_reason() == text
    assert unit.mcu.bridge_sets[-1][1] == 0
    assert not unit.mcu.sampling_moves or unit.mcu.sampling_moves[-1][1] == 0


def test_a_step_of_the_drive_in_a_test_takes_effect_at_its_clock():
    """Plans that step every 0.7 ms leave no room for a whole test; each step is carried out all the same."""
    unit = answering()
    clocks = []
    for n in range(60):
        clocks.append(unit.phase(14230 + n % 2, 0.0005))
        unit.mcu.run(0.0007)
    steps = [(clock, phase) for clock, phase in unit.mcu.bridge_sets if phase >= 14230]
    for clock, n in zip(clocks[1:], range(1, 60), strict=True):
        assert any(phase == 14230 + n % 2 and 0 <= at - clock <= PERIOD for at, phase in steps)


def test_the_plants_temperature_comes_through_the_whole_chain():
    """Plant at 300 degC, 10 % power, through ADC, block sum and message: the law's error, as Table 1 has it.

    Tolerance: the phasor fits Table 1 within 4.5 units; the mean of 1024 samples adds 0.03 LSB."""
    unit, plant = Unit(), Plant(start_c=300.0, seed=7)
    clock_reported = [0]

    def code(clock: int) -> int:
        for at, phase in unit.mcu.bridge_sets[clock_reported[0] :]:
            if at <= clock:
                plant.phase(phase)
                clock_reported[0] += 1
        return int(plant.sample(1)[0])

    unit.mcu.sample_code = code
    unit.report()
    unit.hold(14230, 0.08)
    means = [r.value * 32 / r.count for r in unit.records() if r.phase == 14230 and r.count == 1024]
    expected = 256 + 0.801361 * 300 * 2.718281828 ** (-1.058014 * 0.1) + 1.397019 + 0.5139702
    assert len(means) >= 6
    assert max(means) - min(means) < 0.3  # 8 sigma of a block mean
    assert means[-1] == pytest.approx(expected, abs=4.5)
