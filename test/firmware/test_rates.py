"""What a step and a command cost on each chip, and the steps a second that follow (`make bench-firmware`)."""

from __future__ import annotations

import pytest

from rates import BENCHES, command_cost, completes, step_cost

MARGIN = 1.1  # on the figures of docs/reference/Emulation.md and src/atmega2560/README.md. More is news.
STEPS = 20_000  # 50 ticks of 72 MHz a step too slow would be 14 ms late in the end


@pytest.mark.parametrize("chip", BENCHES)
def test_a_step_and_a_command_cost_no_more_than_they_did(chip: str) -> None:
    known = BENCHES[chip].documented
    for steppers, instructions in known.step_instructions.items():
        cost = step_cost(BENCHES[chip], steppers)
        assert 20 < cost.instructions < int(MARGIN * instructions) < 2.5 * cost.instructions
        assert cost.cycles >= cost.instructions
    assert 50 < command_cost(BENCHES[chip]).instructions < int(MARGIN * known.command_instructions)


@pytest.mark.parametrize("chip", BENCHES)
@pytest.mark.parametrize("steppers", [1, 3])
def test_steps_come_as_fast_as_klipper_publishes_for_a_like_chip(chip: str, steppers: int) -> None:
    published = BENCHES[chip].published
    assert completes(BENCHES[chip], steppers, published.ticks[steppers], pulse_ticks=published.pulse_ticks)


@pytest.mark.parametrize("chip", BENCHES)
@pytest.mark.parametrize("steppers", [1, 3])
def test_steps_a_second_are_reached_and_more_are_refused(chip: str, steppers: int) -> None:
    interval = int(MARGIN * BENCHES[chip].documented.ticks[steppers])
    assert completes(BENCHES[chip], steppers, interval, STEPS)
    assert not completes(BENCHES[chip], steppers, interval // 4, STEPS)  # the measure sees the difference
