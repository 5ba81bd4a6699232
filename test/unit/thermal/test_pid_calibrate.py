"""PID autotune and the two-period law on plants written down here."""

from __future__ import annotations

import math

import pytest

from thermal.control import pid, two_period
from thermal.control.control_api import ControlInput
from thermal.identification import relay

DT_S = 0.3


class Plant:
    """Integrator with losses and a delay: dT/dt = gain u(t - delay) - T_excess / tau."""

    def __init__(self, gain: float, delay_s: float, tau_s: float) -> None:
        self.gain, self.tau_s, self.temp_c = gain, tau_s, 25.0
        self.queue = [0.0] * round(delay_s / DT_S)

    def step(self, output: float) -> float:
        self.queue.append(output)
        self.temp_c += DT_S * (self.gain * self.queue.pop(0) - (self.temp_c - 25.0) / self.tau_s)
        return self.temp_c


def tune(plant: Plant, target_c: float = 60.0, **more: float) -> relay.RelayRun:
    run = relay.RelayRun(relay.RelayPlan(target_c, 1.0, 0.2, **more))  # type: ignore[arg-type]
    time_s = 0.0
    temp_c = plant.temp_c
    while not run.over and time_s < 5000.0:
        temp_c = plant.step(run.decide(time_s, temp_c))
        time_s += DT_S
    return run


@pytest.mark.parametrize("delay_s", [3.0, 9.0])
def test_the_swing_reports_integrator_and_delay(delay_s: float) -> None:
    result = relay.evaluate(tune(Plant(0.4, delay_s, 2000.0)))
    assert result.gain_per_s == pytest.approx(0.4, rel=0.1)  # the losses are a bit of it
    assert result.delay_s == pytest.approx(delay_s, abs=0.2 * delay_s)


def test_the_gains_settle_the_plant_they_were_found_on() -> None:
    result = relay.evaluate(tune(Plant(0.4, 6.0, 400.0)))
    parameters = pid.PidParameters(result.kp, result.ki, result.kd, 0.0, 1.0, 1.0, gap_s=5.0)
    plant, state, temps = Plant(0.4, 6.0, 400.0), pid.PidState(), []
    temp_c = 25.0
    for i in range(3000):
        out, state = pid.pid_step(parameters, state, ControlInput(60.0, temp_c), i * DT_S)
        temp_c = plant.step(out.value)
        temps.append(temp_c)
    assert max(temps) < 60.0 + 5.0
    assert all(abs(t - 60.0) < 0.2 for t in temps[-1000:])


def test_a_swing_that_was_switched_late_does_not_spoil_the_others() -> None:
    """A lost message: for one swing of five the output is 3 s later than the plant's own delay of 6 s."""
    plant, late = Plant(0.4, 6.0, 2000.0), Plant(0.4, 6.0, 2000.0)
    clean = relay.evaluate(tune(plant))
    run = relay.RelayRun(relay.RelayPlan(60.0, 1.0, 0.2))
    wanted = [0.0] * 10
    for i in range(20000):
        wanted.append(run.decide(i * DT_S, late.temp_c))
        if run.over:
            break
        late.step(wanted[-11] if len(run.rises) == 4 else wanted[-1])
    result = relay.evaluate(run)
    assert result.delay_s == pytest.approx(clean.delay_s, rel=0.05)
    assert result.gain_per_s == pytest.approx(clean.gain_per_s, rel=0.05)


def test_swings_that_agree_on_nothing_are_refused() -> None:
    plant, run = Plant(0.4, 6.0, 300.0), relay.RelayRun(relay.RelayPlan(60.0, 1.0, 0.2))
    for i in range(20000):
        output = run.decide(i * DT_S, plant.temp_c)
        if run.over:
            break
        plant.gain = 0.15 * (1 + len(run.rises))  # another heater each time
        plant.step(output)
    with pytest.raises(relay.CalibrationError, match="differ too much"):
        relay.evaluate(run)


def test_a_heater_that_does_not_warm_ends_the_run() -> None:
    run = tune(Plant(0.0, 3.0, 400.0))
    assert "heater or sensor is broken" in run.fault
    assert run.decide(9999.0, 25.0) == 0.0
    with pytest.raises(relay.CalibrationError):
        relay.evaluate(run)


def test_abort_turns_off() -> None:
    run = relay.RelayRun(relay.RelayPlan(60.0, 1.0, 0.5))
    assert run.decide(0.0, 25.0) == 1.0
    run.abort("ended by ABORT")
    assert run.decide(0.3, 25.0) == 0.0
    assert run.target_c == 0.0


@pytest.mark.parametrize("bad", [(0.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, math.nan)])
def test_impossible_gains_are_refused(bad: tuple[float, float, float]) -> None:
    with pytest.raises(pid.ParameterError, match="PID"):
        pid.klipper_pid(*bad, 1.0, 1.0)


# The two-period law, Table 2 row by row


@pytest.mark.parametrize(
    ("below_c", "value"), [(200, 255), (20, 255), (19.9, 240), (9, 200), (6, 160), (4, 80), (2.9, 0), (-5, 0)]
)
def test_flying(below_c: float, value: int) -> None:
    assert two_period.table_value(True, below_c) == value


@pytest.mark.parametrize(("below_c", "value"), [(5, 225), (4.9, 210), (1.9, 220), (-9, 220)])
def test_falling_heats_even_above_the_target(below_c: float, value: int) -> None:
    assert two_period.table_value(False, below_c) == value


def test_the_cutoff_stops_what_the_table_would_heat() -> None:
    parameters = two_period.TwoPeriodParameters(1.0, cutoff_c=15.0)
    state = two_period.TwoPeriodState(False, 250.0)
    near, state = two_period.two_period_step(parameters, state, ControlInput(230.0, 244.0), 0.0)
    far, _ = two_period.two_period_step(parameters, state, ControlInput(225.0, 243.9), 0.3)
    assert near.value == pytest.approx(220 / 255)
    assert far.value == 0.0
