"""Commands of the bridge: the C and its plain version agree to the last bit, on random requests."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Any

import pytest

from bridge_reference import Bridge as Reference
from bridge_reference import Request
from induction_rig import default_parameters, true_law
from thermal.control import loop_records
from thermal.control.bridge_driver import BridgeDriver, OneOutputDriver, PredictiveDriver
from thermal.records import Planned, PowerRequest, TempEstimate
from thermal.sensing.pipeline import Chain

STEPS = 3000


def driver_of(kind: type[BridgeDriver], **looks: Any) -> BridgeDriver:
    parameters = default_parameters(law=true_law())
    actuator = replace(parameters.actuator, **looks)
    return kind(replace(parameters, actuator=actuator), loop_records.LoopState(), Chain())


def random_request(rng: random.Random, now_s: float, power_max_w: float) -> Request:
    low_w = rng.choice((0.0, 1.0, 3.0, power_max_w))
    horizon: tuple[Planned, ...] = ()
    if rng.random() < 0.4:
        start_s = now_s + 0.02
        horizon = tuple(
            Planned(start_s + 0.009 * i, rng.choice((0.0, 1.4, 30.0 * rng.random()))) for i in range(9)
        )
    return Request(
        now_s,
        0.0 if rng.random() < 0.03 else math.inf,
        0.0 if rng.random() < 0.2 else 250.0,
        low_w * rng.random(),
        now_s - rng.choice((0.01, 0.1, 0.4, 0.8, math.nan)),
        250.0 * rng.random(),
        horizon,
    )


def command(driver: BridgeDriver, request: Request) -> list[Any]:
    state = driver.state
    state.target_c, state.horizon = request.target_c, request.horizon
    state.estimate = TempEstimate(request.estimate_s, request.estimate_c, 1.0, 1.0, 1.0, 0, True, "")
    state.request = PowerRequest(request.now_s, request.power_w, 0.0, 0.0, 0.0, 0.0, 0.0)
    return driver.command(request.now_s, request.apart_s)


@pytest.mark.parametrize("kind", [OneOutputDriver, PredictiveDriver])
@pytest.mark.parametrize("seed", range(4))
def test_commands_are_those_of_the_plain_version(kind: type[BridgeDriver], seed: int) -> None:
    looks = {"hold_look_s": 0.5, "hold_look_ticks": (45000, 20125)} if seed % 2 else {}
    rng, driver = random.Random(seed), driver_of(kind, **looks)
    p = driver.parameters
    assert p.has_looks
    plain = Reference(p.timing, p.actuator, p.control.power_max_w, kind is PredictiveDriver, p.filter.heat)
    now_s, sent = 1.0, 0
    for _ in range(STEPS):
        now_s += rng.choice((0.0, 0.0048, 0.0192, 0.2)) * rng.random()
        if rng.random() < 0.8:
            plain.line.edge_s = now_s - 0.003 * rng.random()
            driver.state.bridge.edge(plain.line.edge_s)
        plain.doubt_c = rng.choice((0.5, 30.0))
        driver.chain.state.drive.variance = plain.doubt_c**2
        request = random_request(rng, now_s, p.control.power_max_w)
        expected = plain.command(request)
        assert command(driver, request) == expected
        assert driver.state.bridge.commands == plain.line.commands
        assert driver.state.commanded == plain.line.head
        assert driver.state.bridge.raw.actuator.owed_j == plain.owed.owed_j
        sent += len(expected)
    assert sent > STEPS / 10
