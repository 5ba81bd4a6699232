"""Step generation, endstops and trigger synchronisation of the simulated MCU, to the tick."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcu_harness import FREQ, Mcu

STEP, DIR, ENDSTOP = 3, 4, 5
BOTH_EDGES = 0xFF  # -1 in a byte


def machine(invert_step: int = BOTH_EDGES, pulse_ticks: int = 0) -> Mcu:
    """oid 0 a stepper, 1 an endstop, 2 a trsync, 3 a second stepper on pins 6 and 7."""
    mcu = Mcu()
    mcu.run(0.001)
    stepper = {"invert_step": invert_step, "step_pulse_ticks": pulse_ticks}
    mcu.configure(
        4,
        ("config_stepper", {"oid": 0, "step_pin": STEP, "dir_pin": DIR} | stepper),
        ("config_endstop", {"oid": 1, "pin": ENDSTOP, "pull_up": 1}),
        ("config_trsync", {"oid": 2}),
        ("config_stepper", {"oid": 3, "step_pin": 6, "dir_pin": 7} | stepper),
    )
    return mcu


def start(mcu: Mcu, oid: int = 0, ahead: int = 1000) -> int:
    """Set the stepper's clock a little ahead; returns it."""
    mcu.send("reset_step_clock", oid=oid, clock=(mcu.now + ahead) & 0xFFFFFFFF)
    return mcu.now + ahead


def queue(
    mcu: Mcu, interval: int, count: int, add: int = 0, direction: int | None = None, oid: int = 0
) -> None:
    if direction is not None:
        mcu.send("set_next_step_dir", oid=oid, dir=direction)
    mcu.send("queue_step", oid=oid, interval=interval, count=count, add=add)


def step_clocks(segments: list[tuple[int, int, int]], clock: int) -> list[int]:
    """The documented meaning of queue_step, written plainly."""
    clocks = []
    for interval, count, add in segments:
        for i in range(count):
            clock += interval + i * add
            clocks.append(clock)
    return clocks


def position(mcu: Mcu, oid: int = 0) -> int:
    return int(mcu.ask("stepper_get_position", oid=oid)["pos"])


SEGMENT = st.tuples(st.integers(300, 5000), st.integers(1, 40), st.integers(-5, 5))


@given(segments=st.lists(SEGMENT, min_size=1, max_size=8))
@settings(max_examples=25, deadline=None)
def test_steps_on_both_edges_come_at_their_clocks(segments: list[tuple[int, int, int]]) -> None:
    mcu = machine()
    clock = start(mcu)
    for segment in segments:
        queue(mcu, *segment)
    mcu.run(0.5)
    clocks = step_clocks(segments, clock)
    assert mcu.edges(STEP)[1:] == [(c, (i + 1) % 2) for i, c in enumerate(clocks)]
    assert position(mcu) == -len(clocks)  # dir 0 counts down


@pytest.mark.parametrize("idle", [0, 1])
def test_pulses_begin_at_their_clocks_and_last_as_configured(idle: int) -> None:
    mcu = machine(invert_step=idle, pulse_ticks=144)
    clock = start(mcu)
    queue(mcu, 1000, 5, 10)
    mcu.run(0.01)
    clocks = step_clocks([(1000, 5, 10)], clock)
    expected = [edge for c in clocks for edge in ((c, 1 - idle), (c + 144, idle))]
    assert mcu.edges(STEP)[1:] == expected


def test_pulses_too_close_are_spread_and_later_steps_keep_their_clocks() -> None:
    mcu = machine(invert_step=0, pulse_ticks=100)
    clock = start(mcu)
    queue(mcu, 150, 2)
    queue(mcu, 1000, 1)
    mcu.run(0.01)
    rising = [c for c, level in mcu.edges(STEP)[1:] if level]
    assert rising == [clock + 150, clock + 350, clock + 1300]  # 100 on and 100 off at least


def test_direction_changes_between_the_last_step_and_the_first_of_the_next_segment() -> None:
    mcu = machine()
    clock = start(mcu)
    queue(mcu, 1000, 3, 0, 1)
    queue(mcu, 1000, 2, 0, 0)
    mcu.run(0.01)
    last_up, first_down = clock + 3000, clock + 4000
    turns = mcu.edges(DIR)[1:]
    assert [level for _, level in turns] == [1, 0]
    assert turns[0][0] < clock + 1000 and last_up <= turns[1][0] < first_down
    assert position(mcu) == 1


def test_position_is_right_in_the_middle_of_a_segment() -> None:
    mcu = machine()
    clock = start(mcu)
    queue(mcu, 1000, 10, 0, 1)
    queue(mcu, 1000, 10, 0, 0)
    seen = []
    for i in range(21):
        mcu.run_to(clock + i * 1000)
        seen.append(position(mcu))
    assert seen == [*range(11), *range(9, -1, -1)]


def test_steps_continue_from_the_last_step_after_a_pause_of_the_queue() -> None:
    mcu = machine()
    clock = start(mcu)
    queue(mcu, 1000, 1)
    mcu.run_to(clock + 1500)
    queue(mcu, 5000, 1)
    mcu.run(0.01)
    assert [c for c, _ in mcu.edges(STEP)[1:]] == [clock + 1000, clock + 6000]


def test_steps_work_across_the_wrap_of_the_clock() -> None:
    mcu = machine()
    mcu.run_to(2**32 - 5000)
    clock = start(mcu)
    queue(mcu, 1000, 10)
    mcu.run(0.01)
    assert [c for c, _ in mcu.edges(STEP)[1:]] == [clock + 1000 * i for i in range(1, 11)]


def test_step_in_the_past_and_count_zero_shut_down() -> None:
    mcu = machine()
    clock = start(mcu)
    mcu.run_to(clock + 10)
    queue(mcu, 5, 1)
    assert mcu.shutdown_reason() == "Stepper too far in past"
    mcu = machine()
    queue(mcu, 5, 0)
    assert mcu.shutdown_reason() == "Invalid count parameter"


def test_clock_of_a_moving_stepper_cannot_be_reset() -> None:
    mcu = machine()
    start(mcu)
    queue(mcu, 1000, 10)
    start(mcu)
    assert mcu.shutdown_reason() == "Can't reset time when stepper active"


def test_segments_give_their_queue_entries_back() -> None:
    mcu = machine()
    clock = start(mcu)
    for _ in range(3 * mcu.ask("get_config")["move_count"] // 2):
        queue(mcu, 500, 1)
        clock += 500
        mcu.run_to(clock - 499)
    mcu.run(0.1)
    assert mcu.shutdown_reason() is None
    assert mcu.edges(STEP)[-1][0] == clock


def test_shutdown_stops_steppers_where_they_are() -> None:
    mcu = machine()
    clock = start(mcu)
    queue(mcu, 1000, 100, 0, 1)
    mcu.run_to(clock + 10_500)
    mcu.send("emergency_stop")
    mcu.run(0.1)
    assert len(mcu.edges(STEP)[1:]) == 10
    mcu.send("clear_shutdown")
    assert position(mcu) == 10


# ---------------------------------------------------------------- homing


def home(mcu: Mcu, **changes: int) -> int:
    """Arm trsync 2 and endstop 1 as a host does, both steppers to be stopped; returns the endstop's first clock."""
    clock = mcu.now + 1000
    mcu.send("trsync_start", oid=2, report_clock=clock + FREQ // 50, report_ticks=FREQ // 50, expire_reason=4)
    for oid in (0, 3):
        mcu.send("stepper_stop_on_trigger", oid=oid, trsync_oid=2)
    values = {
        "oid": 1, "clock": clock, "sample_ticks": 1080, "sample_count": 4, "rest_ticks": 7200, "pin_value": 1,
        "trsync_oid": 2, "trigger_reason": 1,
    }  # fmt: skip
    mcu.send("endstop_home", **values | changes)
    return clock


def test_endstop_stops_all_its_steppers_and_reports_the_clock_of_the_touch() -> None:
    mcu = machine()
    touch = mcu.now + 200_000
    mcu.input_level = lambda pin, clock: int(clock >= touch)
    for oid in (0, 3):
        start(mcu, oid)
        queue(mcu, 1000, 60000, 0, 1, oid)
    first_look = home(mcu)
    mcu.run(0.1)
    first_match = first_look + -(-(touch - first_look) // 7200) * 7200
    confirmed = first_match + 4 * 1080
    (state,) = [r for r in mcu.replies("trsync_state") if not r["can_trigger"]]
    assert (state["trigger_reason"], state["clock"], state.clock) == (1, confirmed, confirmed)
    for oid, pin in ((0, STEP), (3, 6)):
        last = mcu.edges(pin)[-1][0]
        assert confirmed - 1000 < last <= confirmed
        assert position(mcu, oid) == len(mcu.edges(pin)) - 1
    endstop = mcu.ask("endstop_query_state", oid=1)
    assert (endstop["homing"], endstop["pin_value"]) == (0, 1)
    assert endstop["next_clock"] - 7200 == first_match


def test_a_glitch_shorter_than_the_samples_does_not_trigger() -> None:
    mcu = machine()
    glitch = mcu.now + 1000 + 10 * 7200
    mcu.input_level = lambda pin, clock: int(glitch <= clock < glitch + 3 * 1080 + 1)
    home(mcu)
    mcu.run(0.05)
    assert mcu.ask("endstop_query_state", oid=1)["homing"] == 1
    assert all(r["can_trigger"] for r in mcu.replies("trsync_state"))


def test_a_row_of_samples_longer_than_the_rest_starts_the_rhythm_anew() -> None:
    looks: list[int] = []

    def level(_pin: int, clock: int) -> int:
        looks.append(clock)
        return len(looks) % 2

    mcu = machine()
    mcu.input_level = level
    clock = home(mcu, sample_ticks=5000, rest_ticks=10)
    mcu.run_to(clock + 10_020)
    assert looks == [clock, clock + 5000, clock + 5010, clock + 10_010, clock + 10_020]


def test_endstop_can_wait_for_the_low_level_and_be_switched_off() -> None:
    mcu = machine()
    mcu.input_level = lambda pin, clock: 1
    home(mcu, pin_value=0)
    mcu.run(0.05)
    assert mcu.ask("endstop_query_state", oid=1)["homing"] == 1
    home(mcu, sample_count=0)
    assert mcu.ask("endstop_query_state", oid=1)["homing"] == 0
    mcu.run(0.05)
    assert mcu.shutdown_reason() is None


def test_trsync_reports_regularly_until_it_triggers() -> None:
    mcu = machine()
    clock = home(mcu)
    mcu.run(0.105)
    reports = mcu.replies("trsync_state")
    assert [r["clock"] for r in reports] == [clock + FREQ // 50 * i for i in range(1, 6)]
    assert all(r["can_trigger"] == 1 for r in reports)


def test_trsync_expires_when_the_host_stops_prolonging_it() -> None:
    mcu = machine()
    start(mcu)
    queue(mcu, 1000, 60000, 0, 1)
    home(mcu)
    limit = mcu.now + FREQ // 10
    mcu.send("trsync_set_timeout", oid=2, clock=mcu.now + FREQ // 40)
    mcu.send("trsync_set_timeout", oid=2, clock=limit)
    mcu.run(0.5)
    final = mcu.replies("trsync_state")[-1]
    assert (final["can_trigger"], final["trigger_reason"], final["clock"]) == (0, 4, limit)
    assert mcu.edges(STEP)[-1][0] <= limit


def test_time_limit_that_arrives_too_late_counts_as_expired() -> None:
    mcu = machine()
    home(mcu)
    mcu.send("trsync_set_timeout", oid=2, clock=mcu.now - 1)
    final = mcu.replies("trsync_state")[-1]
    assert (final["can_trigger"], final["trigger_reason"]) == (0, 4)
    assert mcu.shutdown_reason() is None


def test_host_can_trigger_and_always_gets_an_answer() -> None:
    mcu = machine()
    home(mcu)
    answer = mcu.ask("trsync_trigger", oid=2, reason=2)
    assert (answer["can_trigger"], answer["trigger_reason"]) == (0, 2)
    again = mcu.ask("trsync_trigger", oid=2, reason=3)
    assert (again["can_trigger"], again["trigger_reason"]) == (0, 2)


def test_stopped_stepper_ignores_steps_until_its_clock_is_reset() -> None:
    mcu = machine()
    start(mcu)
    queue(mcu, 1000, 1000, 0, 1)
    home(mcu)
    mcu.run(0.001)
    mcu.send("trsync_trigger", oid=2, reason=2)
    halted = position(mcu)
    queue(mcu, 1000, 10)
    mcu.run(0.01)
    assert position(mcu) == halted
    start(mcu)
    queue(mcu, 1000, 10)
    mcu.run(0.01)
    assert position(mcu) == halted + 10


def test_stepper_bound_to_a_trigger_that_has_fired_is_stopped_at_once() -> None:
    mcu = machine()
    start(mcu)
    queue(mcu, 1000, 1000, 0, 1)
    mcu.send("trsync_start", oid=2, report_clock=0, report_ticks=0, expire_reason=4)
    mcu.send("trsync_trigger", oid=2, reason=2)
    mcu.send("stepper_stop_on_trigger", oid=0, trsync_oid=2)
    mcu.run(0.01)
    assert len(mcu.edges(STEP)) == 1


def test_stepper_cannot_be_bound_to_a_trigger_twice() -> None:
    mcu = machine()
    home(mcu)
    mcu.send("stepper_stop_on_trigger", oid=0, trsync_oid=2)
    assert mcu.shutdown_reason() == "Can't add signal that is already active"


def test_homing_can_be_repeated() -> None:
    mcu = machine()
    mcu.input_level = lambda pin, clock: 1
    for _ in range(3):
        start(mcu)
        queue(mcu, 1000, 1000, 0, 1)
        home(mcu)
        mcu.run(0.05)
        assert mcu.replies("trsync_state")[-1]["trigger_reason"] == 1
    assert mcu.shutdown_reason() is None


def test_pulse_under_way_is_finished_and_counted_when_stopped() -> None:
    mcu = machine(invert_step=0, pulse_ticks=400)
    clock = start(mcu)
    queue(mcu, 1000, 1000, 0, 1)
    home(mcu)
    mcu.run_to(clock + 5000 + 100)
    mcu.send("trsync_trigger", oid=2, reason=2)
    assert mcu.edges(STEP)[-1] == (clock + 5100, 0)
    assert position(mcu) == 5
