"""A reading that does not follow the heat is found (klippy/thermal/sensing/heat_witness.c); one that does is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from chain_rig import FFI, LIB, c_params, new_chain

BLOCK_S, PHASE_MAX, WEAK, FULL = 192 / 120e3, 45000.0, 2012, 45000
GOOD, MISSING, SURPLUS, ABOVE = range(4)
C_J_K = 0.414
LOSS_W_K = 0.03


class Witness:
    """Fed with blocks; `heat` as the host takes it to be, J/K as set up."""

    def __init__(self, target_c: float = 0.0, temp_c: float = 20.0) -> None:
        self.state: Any = FFI.new("struct witness_state *")
        LIB.witness_reset(self.state)
        inputs = self.state.inputs
        inputs.loss_low_w_k, inputs.loss_high_w_k, inputs.taken_w = 0.7 * LOSS_W_K, 1.3 * LOSS_W_K, 0.0
        inputs.slack_c, inputs.room_c, inputs.target_c, inputs.is_on = 15.0, 15.0, target_c, 1
        self.filter = c_params(new_chain()).filter
        self.time_s, self.true_c, self.count = 0.0, temp_c, 0

    def block(
        self, power_w: float, reading_c: float | None = None, ratio: float = 1.0, sigma_c: float = 0.1
    ) -> None:
        """The nozzle takes `ratio` of that power and reads as it is, or `reading_c`."""
        loss_w = LOSS_W_K * (self.true_c - 25.0)
        self.true_c += (ratio * power_w - loss_w) * BLOCK_S / C_J_K
        self.time_s += BLOCK_S
        block = FFI.new("struct coil_block *")
        block.end_s, block.duration_s, block.count, block.heat_w = self.time_s, BLOCK_S, 192, power_w
        block.phase_ticks = WEAK if power_w < 15.0 else FULL
        block.temp_c = self.true_c if reading_c is None else reading_c
        block.sigma_c = sigma_c if power_w < 15.0 else 30.0  # of a strong drive
        LIB.witness_block(self.state, FFI.addressof(self.filter), PHASE_MAX, block)

    def run(
        self, seconds: float, power_w: float, reading: Callable[[float], float] | None = None, **more: Any
    ) -> None:
        """At strong drive every tenth block is a look at the sensing phase."""
        for _ in range(round(seconds / BLOCK_S)):
            self.count += 1
            if self.state.is_tripped:
                return
            look = power_w >= 15.0 and self.count % 10 == 0
            seen = None if reading is None else reading(self.true_c)
            self.block(1.5 if look else power_w, seen, **more)


@pytest.mark.parametrize("ratio", [0.7 / 1.3, 1.0, 1.3 / 0.7, 3.5])
def test_a_nozzle_that_differs_heats_cools_and_heats_again_without_doubt(ratio: float) -> None:
    witness = Witness(target_c=250.0)
    while witness.true_c < 250.0:
        witness.run(0.05 / ratio, 81.0, ratio=ratio)
    assert witness.state.ratio == pytest.approx(ratio, rel=0.15)
    witness.run(3.0, LOSS_W_K * 225.0 / ratio, ratio=ratio)
    witness.run(2.0, 0.0)
    witness.run(0.2 / ratio, 81.0, ratio=ratio)
    assert witness.state.is_tripped == GOOD
    assert np.isnan(witness.state.beyond_s)


def test_a_reading_that_stands_still_while_heating_is_found_before_fifty_degrees() -> None:
    witness = Witness(target_c=250.0)
    witness.run(1.0, 81.0)
    at_c = witness.true_c
    witness.run(5.0, 81.0, lambda true_c: at_c)
    assert witness.state.is_tripped == MISSING
    # slack 15 C and 6 C for the wall, at 75 % of the measured ratio: 28 C; then 0.1 s of persistence, 20 C more
    assert witness.true_c - at_c < 52.0


@pytest.mark.parametrize(("jump_c", "trip"), [(-80.0, MISSING), (80.0, SURPLUS)])
def test_a_gross_jump_is_found_within_two_blocks(jump_c: float, trip: int) -> None:
    witness = Witness(target_c=250.0, temp_c=250.0)
    witness.run(1.0, LOSS_W_K * 225.0)
    begin_s = witness.time_s
    witness.run(0.5, LOSS_W_K * 225.0, lambda true_c: true_c + jump_c)
    assert witness.state.is_tripped == trip
    assert witness.time_s - begin_s < 3.5 * BLOCK_S


def test_a_small_jump_is_doubted_at_once_and_a_fault_after_a_tenth_of_a_second() -> None:
    witness = Witness(target_c=250.0, temp_c=250.0)
    witness.run(1.0, LOSS_W_K * 225.0)
    begin_s = witness.time_s
    witness.run(0.02, LOSS_W_K * 225.0, lambda true_c: true_c - 25.0)
    assert witness.state.is_tripped == GOOD
    assert not np.isnan(witness.state.beyond_s)
    witness.run(1.0, LOSS_W_K * 225.0, lambda true_c: true_c - 25.0)
    assert witness.state.is_tripped == MISSING
    assert witness.time_s - begin_s == pytest.approx(0.1, abs=0.01)


def test_heat_of_blocks_that_were_lost_is_no_reason_for_doubt() -> None:
    witness = Witness(target_c=250.0)
    witness.run(0.5, 81.0)
    witness.time_s += 0.3
    witness.true_c += 0.3 * 81.0 / C_J_K
    witness.run(0.5, 81.0)
    assert witness.state.is_tripped == GOOD
    assert np.isnan(witness.state.beyond_s)


def test_a_nozzle_that_is_off_may_be_wiped() -> None:
    witness = Witness(temp_c=250.0)
    witness.run(0.5, 1.5)
    witness.true_c -= 60.0
    witness.run(0.5, 1.5)
    assert witness.state.is_tripped == GOOD


def test_interference_of_five_lsb_is_no_fault() -> None:
    witness = Witness(target_c=250.0, temp_c=250.0)
    witness.run(5.0, LOSS_W_K * 225.0, lambda true_c: true_c + 6.0 * np.sin(2 * np.pi * 5.0 * witness.time_s))
    assert witness.state.is_tripped == GOOD


def test_heat_beyond_the_target_is_found_by_the_heat_alone() -> None:
    """At full drive without a look no reading is exact."""
    witness = Witness(target_c=250.0, temp_c=250.0)
    witness.state.ratio = 1.0
    witness.run(1.0, LOSS_W_K * 225.0)
    for _ in range(200):
        witness.block(282.0)
        if witness.state.is_tripped:
            break
    assert witness.state.is_tripped == ABOVE
    assert witness.true_c - 250.0 < 30.0


def test_a_nozzle_that_cools_to_a_lower_target_is_not_above_it() -> None:
    witness = Witness(target_c=250.0, temp_c=250.0)
    witness.run(0.5, LOSS_W_K * 225.0)
    witness.state.inputs.target_c = 100.0
    witness.run(3.0, 0.0)
    assert witness.true_c > 130.0
    assert witness.state.is_tripped == GOOD


def test_a_nozzle_that_is_off_and_warms_without_heat_is_found() -> None:
    witness = Witness()
    witness.run(1.0, 1.5)
    begin_c = witness.true_c
    witness.run(1.0, 1.5, ratio=50.0)
    assert witness.state.is_tripped in (SURPLUS, ABOVE)
    assert witness.true_c - begin_c < 45.0
