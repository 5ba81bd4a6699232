"""What supervision makes of the heat witness: its state, the power it holds back, the fault it names."""

from __future__ import annotations

import math
from typing import Any

import pytest

from chain_rig import FFI
from thermal.models import heat_loss
from thermal.sensing import heat_balance_monitor, supervision

PARAMETERS = supervision.SuperviseParameters(0.0, 300.0)
LOSS = heat_loss.LossLaw()
NAN = math.nan


def witness(beyond_s: float = NAN, trip: int = 0, **values: float) -> Any:
    state = FFI.new("struct witness_state *")
    state.beyond_s, state.is_tripped = beyond_s, trip
    for name, value in values.items():
        setattr(state, name, value)
    return state


def watched(seen_beyond: int = 0) -> tuple[supervision.SuperviseState, Any]:
    seen = FFI.new("struct chain_watch *")
    seen.beyond = seen_beyond
    return supervision.SuperviseState(), seen


@pytest.mark.parametrize(
    ("temp_c", "target_c", "state"),
    [
        (25.0, 0.0, supervision.OFF),
        (60.0, 0.0, supervision.OFF),
        (60.1, 0.0, supervision.COOLING),
        (245.0, 250.0, supervision.HOLD),
        (255.0, 250.0, supervision.HOLD),
        (244.9, 250.0, supervision.WARMING),
        (255.1, 250.0, supervision.COOLING),
    ],
)
def test_a_nozzle_without_doubt_is_named_by_its_target_and_reading(
    temp_c: float, target_c: float, state: str
) -> None:
    memory, seen = watched()
    one = witness()
    assert supervision.watch_reading(PARAMETERS, memory, seen, one, temp_c, target_c, LOSS) == ""
    assert supervision.name_state(memory, one, temp_c, target_c) == state
    assert memory.limit_w == math.inf
    assert one.inputs.target_c == target_c


def test_a_doubt_holds_the_power_at_what_holds_the_reading_and_ends_with_it() -> None:
    memory, seen = watched()
    assert supervision.watch_reading(PARAMETERS, memory, seen, witness(1.0), 200.0, 250.0, LOSS) == ""
    assert supervision.name_state(memory, witness(1.0), 200.0, 250.0) == supervision.DOUBT
    assert memory.limit_w == heat_loss.loss_w(LOSS, 200.0)
    assert supervision.watch_reading(PARAMETERS, memory, seen, witness(1.0), NAN, 250.0, LOSS) == ""
    assert memory.limit_w == 0.0
    assert supervision.watch_reading(PARAMETERS, memory, seen, witness(), 200.0, 250.0, LOSS) == ""
    assert supervision.name_state(memory, witness(), 200.0, 250.0) == supervision.WARMING
    assert memory.limit_w == math.inf


@pytest.mark.parametrize(
    ("trip", "words"),
    [
        (1, "41 C are missing at 210 C"),
        (2, "rises by 33 C more"),
        (3, "more than 25 C above its target of 180 C"),
    ],
)
def test_what_stays_in_doubt_is_a_fault_and_stays_one(trip: int, words: str) -> None:
    memory, seen = watched()
    tripped = witness(1.0, trip, missing_c=41.0, surplus_c=33.0, base_c=180.0)
    text = supervision.watch_reading(PARAMETERS, memory, seen, tripped, 210.0, 180.0, LOSS)
    assert words in text
    assert supervision.name_state(memory, witness(), 180.0, 180.0) == supervision.FAULT
    for later in (witness(), witness(1.0)):
        assert supervision.watch_reading(PARAMETERS, memory, seen, later, 180.0, 180.0, LOSS) == text
    assert supervision.name_state(memory, witness(), 180.0, 180.0) == supervision.FAULT


def test_a_reading_beyond_a_limit_is_left_to_the_limit_s_own_words() -> None:
    memory, seen = watched(seen_beyond=1)
    for beyond_s in (NAN, 1.0):
        tripped = witness(beyond_s, 1, missing_c=41.0)
        assert supervision.watch_reading(PARAMETERS, memory, seen, tripped, 310.0, 250.0, LOSS) == ""
    assert memory.limit_w == heat_loss.loss_w(LOSS, 310.0)


@pytest.mark.parametrize("exact", [True, False])
def test_the_witness_gets_the_losses_with_their_band(exact: bool) -> None:
    loss = heat_balance_monitor.scaled(1.0, 25.0, 1.0)
    balance = heat_balance_monitor.HeatBalanceParameters(
        heat_loss.HeatCapacity(0.414), loss, loss_uncertainty=0.1
    )
    seen = heat_balance_monitor.HeatBalanceState()
    seen.temp_c, seen.second_c, seen.second_doubt_c = 225.0, 100.0, 0.0
    state = witness()
    supervision.inform(PARAMETERS, balance, seen, state.inputs, 1.5, exact)
    inputs = state.inputs
    middle = loss.skin_out_w(225.0, 100.0) / 200.0
    assert inputs.loss_low_w_k == pytest.approx(0.7 * middle)
    assert inputs.loss_high_w_k == pytest.approx(1.3 * middle)
    assert (inputs.taken_w, inputs.is_on) == (1.5, 1)
    assert inputs.slack_c == (15.0 if exact else 45.0)
    seen.second_doubt_c = 50.0  # of a holder whose warmth is not known
    supervision.inform(PARAMETERS, balance, seen, inputs, 1.5, exact)
    assert inputs.loss_low_w_k < 0.7 * middle and inputs.loss_high_w_k > 1.3 * middle
    seen.temp_c = 25.0  # near the room the band is that of 20 K
    supervision.inform(PARAMETERS, balance, seen, inputs, 0.0, exact)
    assert 0.0 <= inputs.loss_low_w_k <= inputs.loss_high_w_k < 1.0
