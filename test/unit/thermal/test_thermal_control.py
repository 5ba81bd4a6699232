"""Controllers on a plant of the test's own: a lump of metal with one loss and dead time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import pytest

from thermal.control import pid as control
from thermal.models import heat_loss

STEP_S = 0.017


class Lump:
    """C dT/dt = P - g (T - Ta), P arriving `delay` steps late."""

    def __init__(
        self, capacity_j_k: float = 0.45, loss_w_k: float = 0.02, delay: int = 2, ambient: float = 20.0
    ) -> None:
        self.capacity, self.loss, self.ambient = capacity_j_k, loss_w_k, ambient
        self.temp_c = ambient
        self.pipe = deque([0.0] * delay)
        self.disturbance_w = 0.0

    def step(self, power_w: float) -> float:
        self.pipe.append(power_w)
        net = self.pipe.popleft() - self.loss * (self.temp_c - self.ambient) + self.disturbance_w
        self.temp_c += net / self.capacity * STEP_S
        return self.temp_c


GAINS = control.PidParameters(5.0, 20.0, 0.15, 0.0, 81.3, 0.01)


class Pid:
    """The law with its memory."""

    def __init__(self, parameters: control.PidParameters = GAINS) -> None:
        self.parameters = parameters
        self.state = control.PID.start

    def step(self, inputs: control.ControlInput, time_s: float) -> control.ControlOutput:
        output, self.state = control.PID.step(self.parameters, self.state, inputs, time_s)
        return output


def run(lump: Lump, target: float, steps: int, pid: Pid | None = None, start: int = 0) -> list[float]:
    pid = pid or Pid()
    temps = []
    for n in range(start, start + steps):
        out = pid.step(control.ControlInput(target, lump.temp_c), n * STEP_S)
        assert 0.0 <= out.value <= 81.3
        temps.append(lump.step(out.value))
    return temps


@pytest.mark.parametrize("capacity", [0.36, 0.45, 0.54])
def test_pid_settles_without_steady_error_and_with_little_overshoot(capacity: float) -> None:
    temps = run(Lump(capacity), 250.0, 400)
    # Dead time of 34 ms at up to 225 K/s is 7.7 K of travel; the derivative must take at least half of it back.
    assert max(temps) < 253.85
    assert temps[-1] == pytest.approx(250.0, abs=0.05)


def test_integral_does_not_wind_up_during_a_long_climb() -> None:
    lump = Lump(capacity_j_k=5.0)  # ten times slower: 14 s at full power
    pid = Pid()
    run(lump, 250.0, 200, pid)
    assert lump.temp_c < 100.0  # still climbing, the output saturated all the time
    assert pid.state.integral == 0.0


def test_a_disturbance_is_taken_up_by_the_integral() -> None:
    lump, pid = Lump(), Pid()
    run(lump, 250.0, 300, pid)
    lump.disturbance_w = -4.0
    temps = run(lump, 250.0, 200, pid, 300)
    assert min(temps) > 248.0  # 4 W / 5 W/K = 0.8 K, and as much again for the dead time
    assert temps[-1] == pytest.approx(250.0, abs=0.05)


def test_a_target_step_gives_no_derivative_kick() -> None:
    pid = Pid()
    pid.step(control.ControlInput(200.0, 200.0), 0.0)
    out = pid.step(control.ControlInput(250.0, 200.0), STEP_S)
    assert out.derivative == 0.0


def test_terms_add_up_to_the_unlimited_output() -> None:
    pid = Pid()
    pid.step(control.ControlInput(250.0, 240.0, 4.0), 0.0)
    out = pid.step(control.ControlInput(250.0, 241.0, 4.0), STEP_S)
    assert out.unlimited == pytest.approx(out.proportional + out.integral + out.derivative + out.feedforward)
    assert out.derivative < 0.0 < out.integral


def test_a_limit_of_the_step_holds_and_stops_the_integral() -> None:
    pid = Pid()
    pid.step(control.ControlInput(250.0, 240.0), 0.0)
    out = pid.step(control.ControlInput(250.0, 240.0, 0.0, 10.0), STEP_S)
    assert (out.value, out.integral) == (10.0, 0.0)


def test_a_jump_that_is_no_slope_leaves_the_derivative_alone() -> None:
    pid = Pid()
    for n in range(5):
        pid.step(control.ControlInput(250.0, 200.0 + n), n * STEP_S)
    slope = pid.state.slope_c_s
    inputs = control.ControlInput(250.0, 224.0, rebased=True)
    pid.step(inputs, 5 * STEP_S)
    assert pid.state.slope_c_s == slope
    pid.step(control.ControlInput(250.0, 225.0), 6 * STEP_S)
    assert 0.0 < pid.state.slope_c_s < 100.0  # goes on from the new level


def test_after_a_pause_slope_and_integral_start_afresh() -> None:
    pid = Pid()
    pid.step(control.ControlInput(250.0, 100.0), 0.0)
    out = pid.step(control.ControlInput(250.0, 240.0), 60.0)
    assert (out.derivative, out.integral) == (0.0, 0.0)


def test_tracking_continues_from_the_output_of_somebody_else() -> None:
    pid = Pid()
    inputs = control.ControlInput(250.0, 249.0, 4.0)
    pid.step(inputs, 0.0)
    pid.state = control.PID.follow(GAINS, pid.state, inputs, 17.0)
    out = pid.step(inputs, 1e-6)
    assert out.value == pytest.approx(17.0, abs=1e-3)


def test_klipper_gains_are_per_255() -> None:
    pid = Pid(control.klipper_pid(22.2, 1.08, 114.0, 1.0, 1.0))
    pid.step(control.ControlInput(200.0, 196.0), 0.0)
    out = pid.step(control.ControlInput(200.0, 196.0), 0.3)
    assert out.proportional == pytest.approx(22.2 * 4.0 / 255.0)
    assert out.integral == pytest.approx(1.08 * 4.0 * 0.3 / 255.0)


def test_watermark_switches_at_both_edges_and_keeps_between() -> None:
    parameters, state = control.WatermarkParameters(2.0, 0.8), control.WatermarkState()

    def duty(temp: float) -> float:
        nonlocal state
        out, state = control.watermark_step(parameters, state, control.ControlInput(100.0, temp), 0.0)
        return out.value

    assert [duty(t) for t in (97.9, 99.0, 101.9, 102.0, 101.0, 98.1, 98.0)] == [0.8, 0.8, 0.8, 0, 0, 0, 0.8]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: control.PidParameters(0.0, 1.0, 1.0, 0.0, 1.0, 0.1),
        lambda: control.PidParameters(-1.0, 1.0, 1.0, 0.0, 1.0, 0.1),
        lambda: control.PidParameters(math.nan, 1.0, 1.0, 0.0, 1.0, 0.1),
        lambda: control.PidParameters(1.0, -1.0, 1.0, 0.0, 1.0, 0.1),
        lambda: control.PidParameters(1.0, 1.0, 1.0, 1.0, 1.0, 0.1),
        lambda: control.klipper_pid(22.0, 1.0, -114.0, 1.0, 1.0),
        lambda: control.WatermarkParameters(0.0, 1.0),
        lambda: control.WatermarkParameters(2.0, -1.0),
    ],
)
def test_gains_with_which_nothing_can_work_are_refused(wrong: Callable[[], object]) -> None:
    with pytest.raises(control.ParameterError, match=r"must|room"):
        wrong()


@pytest.mark.parametrize(("temp", "watts"), [(212.0, 3.9), (250.0, 4.7), (500.0, 11.0)])
def test_loss_law_gives_the_static_losses_of_the_reference_nozzle(temp: float, watts: float) -> None:
    law = heat_loss.LossLaw(ambient_c=20.0)
    # Static losses of the fitted plant, published with two digits; the law lumps its two paths into one.
    assert heat_loss.loss_w(law, temp) == pytest.approx(watts, rel=0.03)


def test_loss_is_never_negative() -> None:
    assert heat_loss.loss_w(heat_loss.LossLaw(), -20.0) == 0.0
    assert not math.isnan(heat_loss.loss_w(heat_loss.LossLaw(), 0.0))
