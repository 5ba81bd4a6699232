"""What a step and a command cost on each chip, and the steps a second that follow (`make bench-firmware`)."""

from __future__ import annotations

import pytest

from rates import BENCHES, command_cost, completes, step_cost

# chip: instructions a step with one and with three steppers, a command, and intervals in ticks at which steps are made:
# the figures of docs/reference/Emulation.md and src/atmega2560/README.md and a tenth. More is news.
LIMITS = {
    "stm32f334": ({1: 129, 3: 89}, 121, {1: 80, 3: 364}),
    "atmega2560": ({1: 441, 3: 270}, 300, {1: 197, 3: 799}),
}
STEPS = 20_000  # 50 ticks of 72 MHz a step too slow would be 14 ms late in the end


@pytest.mark.parametrize("chip", BENCHES)
def test_a_step_and_a_command_cost_no_more_than_they_did(chip: str) -> None:
    steps, command, _ = LIMITS[chip]
    for steppers, instructions in steps.items():
        cost = step_cost(BENCHES[chip], steppers)
        assert 20 < cost.instructions < instructions < 2.5 * cost.instructions
        assert cost.cycles >= cost.instructions
    assert 50 < command_cost(BENCHES[chip]).instructions < command


@pytest.mark.parametrize("chip", BENCHES)
@pytest.mark.parametrize("steppers", [1, 3])
def test_steps_a_second_are_reached_and_more_are_refused(chip: str, steppers: int) -> None:
    interval = LIMITS[chip][2][steppers]
    assert completes(BENCHES[chip], steppers, interval, STEPS)
    assert not completes(BENCHES[chip], steppers, interval // 4, STEPS)  # the measure sees the difference
