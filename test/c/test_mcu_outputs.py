"""Digital outputs, software and hardware PWM, slow analog inputs of the simulated MCU."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcu_harness import Mcu

PIN = 17
MISSED = "Missed scheduling of next digital out event"
EXCEED = "Scheduled digital out event will exceed max_duration"


def digital(max_duration: int = 0, value: int = 0, default: int = 0, cycle: int = 0) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    output = {"oid": 0, "pin": PIN, "value": value, "default_value": default, "max_duration": max_duration}
    mcu.configure(1, ("config_digital_out", output))
    if cycle:
        mcu.send("set_digital_out_pwm_cycle", oid=0, cycle_ticks=cycle)
    return mcu


def queue(mcu: Mcu, *updates: tuple[int, int]) -> None:
    for clock, on_ticks in updates:
        mcu.send("queue_digital_out", oid=0, clock=clock & 0xFFFFFFFF, on_ticks=on_ticks)


def test_updates_happen_at_their_clock_exactly() -> None:
    mcu = digital()
    start = mcu.now + 5000
    queue(mcu, (start, 1), (start + 1, 0), (start + 700, 1), (start + 90_000, 0))
    mcu.run(0.01)
    assert mcu.edges(PIN)[1:] == [(start, 1), (start + 1, 0), (start + 700, 1), (start + 90_000, 0)]


def test_updates_work_across_the_wrap_of_the_clock() -> None:
    mcu = digital()
    mcu.run_to(2**32 - 1000)
    queue(mcu, (2**32 - 10, 1), (2**32 + 10, 0))
    mcu.run(0.01)
    assert mcu.edges(PIN)[1:] == [(2**32 - 10, 1), (2**32 + 10, 0)]


def test_an_update_in_the_past_shuts_down() -> None:
    mcu = digital()
    queue(mcu, (mcu.now - 1, 1))
    assert mcu.shutdown_reason() == "Timer too close"


def test_initial_value_is_set_by_the_configuration() -> None:
    assert digital(value=1).edges(PIN)[0][1] == 1


@pytest.mark.parametrize("default", [0, 1])
def test_a_silent_host_is_noticed_after_max_duration(default: int) -> None:
    limit = 72_000
    mcu = digital(limit, value=default, default=default)
    start = mcu.now + 1000
    queue(mcu, (start, 1 - default))
    mcu.run_to(start + limit - 1)
    assert mcu.shutdown_reason() is None
    mcu.run_to(start + limit)
    assert mcu.shutdown_reason() == MISSED
    assert mcu.edges(PIN)[-1] == (start + limit, default)


def test_regular_updates_keep_an_output_on_beyond_max_duration() -> None:
    limit = 72_000
    mcu = digital(limit)
    first = mcu.now + 1000
    for i in range(20):
        queue(mcu, (first + i * limit, 1))
        mcu.run_to(first + i * limit - 500)
    queue(mcu, (first + 20 * limit, 0))
    mcu.run(1.0)
    assert mcu.shutdown_reason() is None
    assert mcu.edges(PIN)[1:] == [(first, 1), (first + 20 * limit, 0)]


@pytest.mark.parametrize("queued_together", [True, False])
def test_an_update_beyond_max_duration_shuts_down(queued_together: bool) -> None:
    limit = 72_000
    mcu = digital(limit)
    start = mcu.now + 1000
    queue(mcu, (start, 1))
    if not queued_together:
        mcu.run_to(start + 10)
    queue(mcu, (start + limit + 1, 1))
    mcu.run_to(start + limit)
    assert mcu.shutdown_reason() == EXCEED
    assert mcu.edges(PIN)[-1][1] == 0


def test_an_update_just_within_max_duration_may_come_late() -> None:
    limit = 72_000
    mcu = digital(limit)
    start = mcu.now + 1000
    queue(mcu, (start, 1))
    mcu.run_to(start + limit - 100)
    queue(mcu, (start + limit, 0))
    mcu.run(0.1)
    assert mcu.shutdown_reason() is None
    assert mcu.edges(PIN)[1:] == [(start, 1), (start + limit, 0)]


def test_the_default_value_may_stand_for_ever() -> None:
    mcu = digital(72_000)
    queue(mcu, (mcu.now + 1000, 1), (mcu.now + 2000, 0))
    mcu.run(5.0)
    assert mcu.shutdown_reason() is None


def test_immediate_update_is_guarded_too_and_refused_while_updates_wait() -> None:
    mcu = digital(72_000)
    mcu.send("update_digital_out", oid=0, value=1)
    assert mcu.edges(PIN)[-1] == (mcu.now, 1)
    mcu.run(0.01)
    assert mcu.shutdown_reason() == MISSED
    mcu = digital()
    queue(mcu, (mcu.now + 1000, 1))
    mcu.send("update_digital_out", oid=0, value=1)
    assert mcu.shutdown_reason() == "update_digital_out not valid with active queue"


def test_each_immediate_update_begins_the_guarded_time_anew() -> None:
    limit = 72_000
    mcu = digital(limit)
    mcu.send("update_digital_out", oid=0, value=1)
    mcu.run_to(mcu.now + limit // 2)
    mcu.send("update_digital_out", oid=0, value=1)
    again = mcu.now
    mcu.run_to(again + limit - 1)
    assert mcu.shutdown_reason() is None
    mcu.run_to(again + limit)
    assert mcu.shutdown_reason() == MISSED
    mcu = digital(limit)
    mcu.send("update_digital_out", oid=0, value=1)
    mcu.send("update_digital_out", oid=0, value=0)
    mcu.run(0.01)
    assert mcu.shutdown_reason() is None and mcu.edges(PIN)[-1][1] == 0


def test_an_update_gives_its_place_in_the_move_queue_back() -> None:
    mcu = digital()
    places = mcu.ask("get_config")["move_count"]
    for i in range(places + 10):
        queue(mcu, (mcu.now + 2000, i % 2))
        mcu.run_to(mcu.now + 3000)
    assert mcu.shutdown_reason() is None
    assert len(mcu.edges(PIN)) > places


@pytest.mark.parametrize("cycle", [0, 7200])
def test_what_was_going_on_in_a_shutdown_is_over_when_it_is_cleared(cycle: int) -> None:
    limit = 72_000
    mcu = digital(limit, cycle=cycle)
    queue(mcu, (mcu.now + 1000, 1000), (mcu.now + 70_000, 1000))
    mcu.run_to(mcu.now + 5000)
    mcu.send("emergency_stop")
    mcu.run(0.01)
    mcu.send("clear_shutdown")
    seen, start = len(mcu.edges(PIN)), mcu.now + 2 * limit
    queue(mcu, (start, 10_000), (start + 100, 0))
    mcu.run_to(start + 2 * limit)
    assert mcu.edges(PIN)[seen:] == [(start, 1), (start + 100, 0)]


def test_set_digital_out_works_without_configuration() -> None:
    mcu = Mcu()
    mcu.send("set_digital_out", pin=99, value=1)
    mcu.send("set_digital_out", pin=99, value=0)
    assert [level for _, level in mcu.edges(99)] == [1, 0]


# ---------------------------------------------------------------- software PWM


@given(on_ticks=st.integers(1, 719_999))
@settings(max_examples=10, deadline=None)
def test_software_pwm_has_exact_on_times_and_period(on_ticks: int) -> None:
    cycle = 720_000  # 10 ms
    mcu = digital(cycle=cycle)
    start = mcu.now + 1000
    queue(mcu, (start, on_ticks))
    mcu.run_to(start + 10 * cycle - 1)
    expected = [
        edge for i in range(10) for edge in ((start + i * cycle, 1), (start + i * cycle + on_ticks, 0))
    ]
    assert mcu.edges(PIN)[1:] == expected


@pytest.mark.parametrize(("on_ticks", "level"), [(0, 0), (720_000, 1), (10**7, 1)])
def test_software_pwm_at_its_ends_has_no_pulses(on_ticks: int, level: int) -> None:
    mcu = digital(cycle=720_000)
    queue(mcu, (mcu.now + 1000, 1000), (mcu.now + 721_000, on_ticks))
    mcu.run(0.1)
    assert mcu.edges(PIN)[-1][1] == level
    assert len(mcu.edges(PIN)) == 3 + level


def test_new_software_pwm_value_takes_effect_at_its_clock() -> None:
    mcu = digital(cycle=720_000)
    start = mcu.now + 1000
    queue(mcu, (start, 400_000), (start + 300_000, 100_000))
    mcu.run_to(start + 1_100_000)
    assert mcu.edges(PIN)[1:] == [
        (start, 1), (start + 400_000, 0), (start + 1_020_000, 1),
    ]  # fmt: skip


@pytest.mark.parametrize(("at", "off_at"), [(300_000, 350_000), (500_000, 400_000)], ids=["before", "after"])
def test_a_value_that_comes_while_software_pwm_runs_takes_effect_at_its_clock(at: int, off_at: int) -> None:
    """Before and after the next edge of the value in force."""
    mcu = digital(cycle=720_000)
    start = mcu.now + 1000
    queue(mcu, (start, 400_000))
    mcu.run_to(start + 100_000)
    queue(mcu, (start + at, 50_000))
    mcu.run_to(start + at + 720_000)
    again = [] if at < off_at else [(start + at, 1), (start + at + 50_000, 0)]
    assert mcu.edges(PIN)[1:] == [(start, 1), (start + off_at, 0), *again, (start + at + 720_000, 1)]


def test_software_pwm_goes_on_while_the_next_value_waits_within_max_duration() -> None:
    mcu = digital(3 * 720_000, cycle=720_000)
    start = mcu.now + 1000
    queue(mcu, (start, 300_000), (start + 3 * 720_000, 0))
    mcu.run(1.0)
    assert mcu.shutdown_reason() is None
    edges = [(start + n * 720_000 + on * 300_000, 1 - on) for n in range(3) for on in (0, 1)]
    assert mcu.edges(PIN)[1:] == edges


def test_a_running_software_pwm_refuses_an_immediate_update() -> None:
    mcu = digital(cycle=720_000)
    queue(mcu, (mcu.now + 1000, 300_000))
    mcu.run(0.01)
    mcu.send("update_digital_out", oid=0, value=1)
    assert mcu.shutdown_reason() == "update_digital_out not valid with active queue"


def test_software_pwm_is_guarded_by_max_duration_and_ends_at_the_default() -> None:
    limit = 3 * 720_000
    mcu = digital(limit, cycle=720_000)
    start = mcu.now + 1000
    queue(mcu, (start, 300_000))
    mcu.run(0.2)
    assert mcu.shutdown_reason() == MISSED
    assert mcu.edges(PIN)[-1] == (start + 2 * 720_000 + 300_000, 0)
    assert mcu.replies("shutdown")[0]["clock"] == start + limit


def test_software_pwm_cycle_cannot_change_while_updates_wait() -> None:
    mcu = digital(cycle=720_000)
    queue(mcu, (mcu.now + 1000, 300_000))
    mcu.send("set_digital_out_pwm_cycle", oid=0, cycle_ticks=1000)
    assert mcu.shutdown_reason() == "Can not set soft pwm cycle ticks while updates pending"


# ---------------------------------------------------------------- hardware PWM


def hardware_pwm(**changes: int) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    values = {"oid": 0, "pin": PIN, "cycle_ticks": 3000, "value": 0, "default_value": 0, "max_duration": 0}
    mcu.configure(1, ("config_pwm_out", values | changes))
    return mcu


def test_hardware_pwm_updates_happen_at_their_clock() -> None:
    mcu = hardware_pwm(value=7)
    start = mcu.now + 1000
    mcu.send("queue_pwm_out", oid=0, clock=start, value=200)
    mcu.send("queue_pwm_out", oid=0, clock=start + 55, value=255)
    mcu.run(0.1)
    assert [write[1:] for write in mcu.pwm_writes[:1]] == [(PIN, 3000, 7)]
    assert mcu.pwm_writes[-2:] == [(start, PIN, 3000, 200), (start + 55, PIN, 3000, 255)]


def test_hardware_pwm_is_guarded_by_max_duration() -> None:
    mcu = hardware_pwm(max_duration=72_000, default_value=5, value=5)
    start = mcu.now + 1000
    mcu.send("queue_pwm_out", oid=0, clock=start, value=200)
    mcu.run(0.1)
    assert mcu.shutdown_reason() == "Missed scheduling of next hard pwm event"
    assert mcu.pwm_writes[-1] == (start + 72_000, PIN, 3000, 5)
    mcu = hardware_pwm(max_duration=72_000)
    start = mcu.now + 1000
    mcu.send("queue_pwm_out", oid=0, clock=start, value=200)
    mcu.send("queue_pwm_out", oid=0, clock=start + 72_001, value=0)
    mcu.run(0.1)
    assert mcu.shutdown_reason() == "Scheduled pwm event will exceed max_duration"


# ---------------------------------------------------------------- analog inputs


def analog(code: Any, pin: int = 40, **changes: int) -> tuple[Mcu, int]:
    """An MCU sampling a pin, 4 samples 100 ticks apart every 7200 ticks; the clock of the first."""
    mcu = Mcu()
    mcu.run(0.001)
    mcu.adc_code = code
    mcu.configure(1, ("config_analog_in", {"oid": 0, "pin": pin}))
    start = mcu.now + 1000
    query = {
        "oid": 0, "clock": start, "sample_ticks": 100, "sample_count": 4, "rest_ticks": 7200,
        "bytes_per_report": 2, "min_value": 0, "max_value": 65535, "range_check_count": 0,
    }  # fmt: skip
    mcu.send("query_analog_in", **query | changes)
    return mcu, start


def test_a_report_is_the_sum_of_samples_taken_at_their_clocks() -> None:
    asked: list[tuple[int, int]] = []

    def code(pin: int, clock: int) -> int:
        asked.append((pin, clock))
        return len(asked)

    mcu, start = analog(code)
    mcu.run_to(start + 2 * 7200 + 300)
    assert asked == [(40, start + group * 7200 + i * 100) for group in range(3) for i in range(4)]
    reports = mcu.replies("analog_in_state")
    assert [int.from_bytes(r["values"], "little") for r in reports] == [10, 26, 42]
    assert [r["next_clock"] for r in reports] == [start + (i + 1) * 7200 for i in range(3)]
    assert [r.clock for r in reports] == [start + i * 7200 + 300 for i in range(3)]


def test_the_chips_temperature_is_an_analog_input_and_nothing_else() -> None:
    pin = Mcu().dictionary.plain["enumerations"]["pin"]["ADC_TEMPERATURE"]
    mcu, start = analog(lambda asked, clock: 1700 if asked == pin else 0, pin=pin)
    mcu.run_to(start + 300)
    (report,) = mcu.replies("analog_in_state")
    assert int.from_bytes(report["values"], "little") == 4 * 1700
    output = {"oid": 0, "pin": pin, "value": 0, "default_value": 0, "max_duration": 0}
    for config, shutdown in (
        (("config_digital_out", output), "Not an output pin"),
        (("config_analog_in", {"oid": 0, "pin": pin - 1}), "Not a valid ADC pin"),
    ):
        mcu = Mcu()
        mcu.send("allocate_oids", count=1)
        mcu.send(config[0], **config[1])
        assert mcu.shutdown_reason() == shutdown


def test_values_are_gathered_into_reports_of_the_size_asked_for() -> None:
    mcu, start = analog(lambda pin, clock: 1000 + (clock // 7200) % 50, bytes_per_report=8)
    mcu.run_to(start + 8 * 7200)
    reports = mcu.replies("analog_in_state")
    assert [len(r["values"]) for r in reports] == [8, 8]
    assert [r["next_clock"] for r in reports] == [start + 4 * 7200, start + 8 * 7200]
    first = [int.from_bytes(reports[0]["values"][i : i + 2], "little") for i in range(0, 8, 2)]
    assert first == [4 * (1000 + ((start + i * 7200) // 7200) % 50) for i in range(4)]


@pytest.mark.parametrize("size", [0, 1, 3, 50])
def test_report_sizes_that_cannot_be_are_refused(size: int) -> None:
    mcu, _ = analog(lambda pin, clock: 5, bytes_per_report=size)
    assert mcu.shutdown_reason() == "Invalid analog_in bytes_per_report"


@pytest.mark.parametrize(("code", "trips"), [(99, True), (100, False), (200, False), (201, True)])
def test_range_check_is_on_the_sum_and_includes_its_ends(code: int, trips: bool) -> None:
    mcu, _ = analog(lambda pin, clock: code, min_value=400, max_value=800, range_check_count=1)
    mcu.run(0.01)
    assert mcu.shutdown_reason() == ("ADC out of range" if trips else None)


def test_range_check_counts_values_in_a_row() -> None:
    values = iter([0, 0, 0, 150, 0, 0, 0, 0])
    mcu, start = analog(
        lambda pin, clock: next(values), sample_count=1, min_value=100, max_value=200, range_check_count=4
    )
    mcu.run_to(start + 7 * 7200 - 1)
    assert mcu.shutdown_reason() is None
    mcu.run_to(start + 7 * 7200)
    assert mcu.shutdown_reason() == "ADC out of range"


def test_sampling_stops_when_asked_and_in_a_shutdown() -> None:
    mcu, _ = analog(lambda pin, clock: 1)
    mcu.run(0.01)
    stop = {
        "oid": 0,
        "clock": 0,
        "sample_ticks": 0,
        "sample_count": 0,
        "rest_ticks": 0,
        "bytes_per_report": 0,
    }
    mcu.send("query_analog_in", **stop, min_value=0, max_value=0, range_check_count=0)
    before = len(mcu.replies("analog_in_state"))
    mcu.run(0.1)
    assert len(mcu.replies("analog_in_state")) == before > 0
    assert mcu.shutdown_reason() is None


def test_sampling_without_pause_is_stopped_instead_of_hanging_the_mcu() -> None:
    mcu, _ = analog(lambda pin, clock: 1, rest_ticks=0, sample_ticks=0)
    mcu.run(0.01)
    assert mcu.shutdown_reason() == "Rescheduled timer in the past"


def test_a_sum_beyond_sixteen_bits_saturates() -> None:
    mcu, _ = analog(lambda pin, clock: 4095, sample_count=20)
    mcu.run(0.01)
    assert mcu.replies("analog_in_state")[0]["values"] == b"\xff\xff"
