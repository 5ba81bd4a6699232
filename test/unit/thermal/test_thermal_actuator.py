"""Watts to phase and back, and mean power at requests too small to measure with."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge_rig import actuate, actuator_state, ahead
from thermal.control import actuator
from thermal.models.drive_law import DriveLaw
from thermal.records import PhaseCommand, Planned

LAW = DriveLaw()
PULSE_S = (1024 + 20 + 4) / 120e3
PARAMETERS = actuator.ActuatorParameters(LAW, PULSE_S)
STEP_S = 2 * 1024 / 120e3


@given(st.floats(0.0, 81.3))
def test_power_to_phase_to_power_is_exact(power: float) -> None:
    assert LAW.power_w(LAW.phase_ticks(power)) == pytest.approx(power, abs=1e-9)


@given(st.integers(0, 45000))
def test_phase_to_power_to_phase_is_exact(phase: int) -> None:
    # asin is flat at full phase: half a tick there is 1e-9 of the power, so allow 0.01 ticks.
    assert LAW.phase_ticks(LAW.power_w(phase)) == pytest.approx(phase, abs=1e-2)


def test_drive_law_has_the_seeds_values() -> None:
    assert LAW.power_w(45000) == pytest.approx(81.3)
    assert LAW.power_w(2012) == pytest.approx(81.3 * math.sin(math.pi * 2012 / 90000) ** 1.5)
    assert LAW.power_w(2012) == pytest.approx(1.51, abs=0.01)


def test_supply_voltage_scales_the_power_with_the_drive_exponent() -> None:
    weak = DriveLaw(vdc_v=12.0)
    assert weak.power_max_w == pytest.approx(81.3 * 0.5**1.5)
    assert weak.power_w(20000) == pytest.approx(LAW.power_w(20000) * 0.5**1.5)


def test_a_request_beyond_the_drive_gives_full_phase() -> None:
    assert LAW.phase_ticks(1000.0) == pytest.approx(45000)


@given(st.floats(1.52, 81.3))
def test_quantised_phase_costs_less_than_a_thousandth(power: float) -> None:
    command = actuate(PARAMETERS, actuator_state(), power, 1.0, False)[0]
    # A tick at the minimum phase is 1.5/2012 of the power = 0.075 %; half of it is lost in rounding.
    assert command.power_w == pytest.approx(power, rel=4e-4)
    assert command.time_s == 1.0


def mean_power(request: float, duration_s: float, idle: bool = False) -> tuple[float, list[PhaseCommand]]:
    """Mean delivered power and all commands of a constant request, stepped as the loop does."""
    state = actuator_state()
    commands: list[PhaseCommand] = []
    time_s = 0.0
    while time_s < duration_s:
        at_s = max(time_s, commands[-1].time_s if commands else 0.0)
        is_on = bool(commands and commands[-1].phase_ticks)
        commands += actuate(PARAMETERS, state, request, at_s, is_on, idle)
        time_s += STEP_S
    ends = [c.time_s for c in commands[1:]] + [duration_s]
    energy = sum(c.power_w * (min(e, duration_s) - c.time_s) for c, e in zip(commands, ends, strict=True))
    return energy / duration_s, commands


@pytest.mark.parametrize("request_w", [0.2, 0.4, 0.75, 1.0, 1.3, 1.45])
def test_small_requests_are_met_on_average_by_pulses(request_w: float) -> None:
    got, commands = mean_power(request_w, 20.0)
    # Debt is bounded by four pulses of 13 mJ; over 20 s that is under 3 mW.
    assert got == pytest.approx(request_w, abs=0.003)
    assert {c.phase_ticks for c in commands} <= {0, 2012}


@pytest.mark.parametrize(("idle", "interval_s", "max_w"), [(False, 0.1, 0.14), (True, 0.5, 0.03)])
def test_measuring_goes_on_without_a_request(idle: bool, interval_s: float, max_w: float) -> None:
    got, commands = mean_power(0.0, 10.0, idle)
    starts = [c.time_s for c in commands if c.phase_ticks]
    gaps = [b - a for a, b in itertools.pairwise(starts)]
    assert max(gaps) <= interval_s + PULSE_S + STEP_S + 1e-9  # a pulse's length and one step of waiting
    assert got < max_w  # 1.51 W * 8.73 ms / interval, at most


DEBT_PULSES = 4  # what is owed or overdrawn is kept up to so many pulses
PULSE_J = PARAMETERS.power_low_w * PULSE_S


def test_heat_owed_through_a_pause_of_the_host_is_paid_back_by_four_pulses_at_most() -> None:
    state = actuator_state()
    actuate(PARAMETERS, state, 1.45, 0.0, False)
    time_s, energy_j = 10.0, 0.0  # 14.5 J were asked for meanwhile
    while time_s < 10.4:  # before the next pulse for sensing is due
        commands = actuate(PARAMETERS, state, 0.0, time_s, False, idle=True)
        energy_j += sum(b.time_s - a.time_s for a, b in zip(commands[::2], commands[1::2], strict=True))
        time_s = max(time_s + STEP_S, commands[-1].time_s if commands else 0.0)
    assert energy_j * PARAMETERS.power_low_w == pytest.approx(DEBT_PULSES * PULSE_J)


def test_heat_of_sensing_is_taken_off_later_requests_up_to_four_pulses() -> None:
    state = actuator_state()
    time_s = 0.0
    while time_s < 60.0:  # 600 pulses nobody asked for
        actuate(PARAMETERS, state, 0.0, time_s, False)
        time_s += STEP_S
    start_s = time_s
    while not actuate(PARAMETERS, state, 1.0, time_s, False, idle=True):
        time_s += 0.001
    # from four pulses overdrawn to half a pulse owed
    assert time_s - start_s == pytest.approx((DEBT_PULSES + 0.5) * PULSE_J / 1.0, abs=0.002)


def test_each_pulse_holds_a_whole_block_and_ends_by_itself() -> None:
    _, commands = mean_power(0.3, 5.0)
    for on, off in zip(commands[0::2], commands[1::2], strict=True):
        assert (on.phase_ticks, off.phase_ticks) == (2012, 0)
        assert off.time_s - on.time_s >= (1024 + 20) / 120e3


def test_from_driving_to_no_request_turns_the_bridge_off() -> None:
    state = actuator_state()
    actuate(PARAMETERS, state, 20.0, 0.0, False)
    assert actuate(PARAMETERS, state, 0.0, STEP_S, True) == [PhaseCommand(STEP_S, 0, 0.0)]


def test_no_request_withdraws_what_was_said_ahead_to_a_bridge_that_is_off() -> None:
    state = actuator_state()
    actuate(PARAMETERS, state, 20.0, 0.0, False)
    off = actuate(PARAMETERS, state, 0.0, STEP_S, True)[0]
    assert ahead(PARAMETERS, off, [Planned(3 * STEP_S, 1.5)])
    assert actuate(PARAMETERS, state, 0.0, 2 * STEP_S, True) == [PhaseCommand(2 * STEP_S, 0, 0.0)]


@given(st.lists(st.floats(0.0, 90.0), min_size=1, max_size=60))
def test_commands_come_in_order_and_never_exceed_full_phase(requests: list[float]) -> None:
    state = actuator_state()
    time_s, last_s, is_on = 0.0, -1.0, False
    for request in requests:
        for command in actuate(PARAMETERS, state, request, time_s, is_on):
            is_on = command.phase_ticks > 0
            assert command.time_s >= last_s
            assert 0 <= command.phase_ticks <= 45000
            last_s = command.time_s
        time_s = max(time_s + STEP_S, last_s + 1e-6)
