"""The sequential test of lost flow (klippy/thermal/sensing/flow_monitor.py) on made-up heat."""

from __future__ import annotations

import random

import pytest

from thermal.models.heat_loss import HeatCapacity
from thermal.models.melt_exchange import MeltExchange
from thermal.sensing import flow_monitor
from thermal.sensing.flow_monitor import FlowMonitorParameters, FlowMonitorState, HeatReading
from thermal.sensing.heat_balance_monitor import TwoNodeLoss

TEMP_C, SECOND_C, FLOW_MM3_S = 250.0, 180.0, 5.0
DT_S = 0.5  # two readings are a step
MELT = MeltExchange()
MELT_W = MELT.heat_w_k(FLOW_MM3_S) * (TEMP_C - MELT.inlet_c)


class Nozzle:
    """A nozzle at one temperature, whose melt takes `share` of what it should; white noise."""

    def __init__(self, seed: int = 1, **changes: float) -> None:
        self.parameters = FlowMonitorParameters(HeatCapacity(), TwoNodeLoss(), MELT, **changes)  # type: ignore[arg-type]
        self.state: FlowMonitorState = flow_monitor.start(self.parameters)
        self.random = random.Random(seed)
        self.time_s = 0.0
        self.alarms = 0
        self.loss_w = self.parameters.loss.skin_out_w(TEMP_C, SECOND_C)

    def run(self, seconds: float, share: float = 1.0, fan: float = 0.0, fan_w: float = 1.6) -> float:
        """Returns when the condition changed, or the end."""
        until_s, was_lost = self.time_s + seconds, self.state.lost
        changed_s = until_s
        while self.time_s < until_s:
            self.time_s += DT_S
            heat_j = DT_S * (self.loss_w + share * MELT_W + fan * fan_w)
            heat_j += self.random.gauss(0.0, self.parameters.noise_w_s * DT_S**0.5)
            reading = HeatReading(self.time_s, TEMP_C, SECOND_C, 0.0, heat_j, FLOW_MM3_S * DT_S, fan)
            flow_monitor.observe(self.parameters, self.state, reading)
            if self.state.lost != was_lost:
                was_lost, changed_s = self.state.lost, min(changed_s, self.time_s)
                self.alarms += was_lost
        return changed_s

    @property
    def condition(self) -> str:
        return flow_monitor.condition(self.parameters, self.state)


@pytest.mark.parametrize(("share", "condition"), [(0.7, "restricted"), (0.0, "no_filament")])
def test_a_loss_is_found_within_ten_seconds_and_its_end_too(share: float, condition: str) -> None:
    nozzle = Nozzle()
    assert nozzle.condition == "unknown"
    assert nozzle.run(60.0) == nozzle.time_s
    assert nozzle.condition == "clear"
    assert nozzle.run(10.0, share) < nozzle.time_s
    assert nozzle.condition == condition
    assert nozzle.state.lost_share == pytest.approx(1.0 - share, abs=0.1)
    assert nozzle.run(20.0) < nozzle.time_s
    assert nozzle.condition == "clear"


@pytest.mark.parametrize("share", [0.85, 1.15])
def test_a_melt_that_takes_other_heat_is_learned_and_no_loss(share: float) -> None:
    nozzle = Nozzle()
    nozzle.run(600.0, share)
    assert nozzle.alarms == 0
    gain, _, bias_w = nozzle.state.unknowns
    assert gain * MELT_W + bias_w == pytest.approx(share * MELT_W, abs=0.1)


def test_a_fan_that_takes_more_than_the_melt_is_no_loss() -> None:
    nozzle = Nozzle()
    for fan in (0.0, 1.0, 0.5, 0.0, 1.0):
        nozzle.run(30.0, fan=fan, fan_w=2.7)
    assert nozzle.alarms == 0
    assert nozzle.run(15.0, 0.7, fan=1.0, fan_w=2.7) < nozzle.time_s


def test_false_alarms_are_no_more_frequent_than_asked_for() -> None:
    """One in 50 s is asked for, with noise so great that the test is not sure of anything."""
    nozzle = Nozzle(false_alarm_s=50.0, noise_w_s=0.8)
    nozzle.run(20e3)
    assert 1 <= nozzle.alarms <= 20e3 / 50.0


def test_without_flow_nothing_is_said() -> None:
    nozzle = Nozzle(flow_min_w=2.0 * MELT_W)
    nozzle.run(60.0, 0.0)
    assert nozzle.condition == "unknown"
