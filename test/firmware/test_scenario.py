"""One story on every build: the same host, the same plant, the same results (scenario.py says what happens).

Another build joins by a line in CASES: the machine's config with that chip's pins, its name, what heats.
"""

from __future__ import annotations

import pytest

from scenario import Case, Story, play
from simulation.builds import make_build

# A chip takes time to compute, the simulator port does not: orders of the host reach the pins alike (they are
# stamped), but the moment a switch is seen, and when the host learns of it, differ by some tens of microseconds.
CASES = {
    "stm32f334": tuple(Case(build, "sim-f334.cfg", 250.0) for build in ("simulator", "stm32f334")),
    "atmega2560": tuple(
        Case(build, "sim-mega.cfg", 200.0, heater="load") for build in ("simulator", "atmega2560")
    ),
}
HEAT_WITHIN_S = {"nozzle": 5.0, "load": 120.0}  # induction, a 40 W cartridge
HOLD_WITHIN_C = {"nozzle": 0.5, "load": 3.0}
SHUTDOWN_WITHIN_S = 5.0
HOMING_STEPS = 2  # a switch seen 25 us later: one step at 40 mm/s, both ways
# The file's end. Induction: M109 looks at the heater a few times a second. The cartridge settles over half a minute,
# M109 ends when its slope is under 0.1 K/s, and on a curve that flattens by 0.05 K/s a second the noise of the ADC
# moves that by 2 s.
TIME_S = {"nozzle": 0.3, "load": 3.0}


@pytest.fixture(scope="module", params=CASES)
def stories(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Story, Story]:
    """The story on the simulator port, and on the chip's image."""
    reference, chip = (play(case, tmp_path_factory.mktemp(case.build)) for case in CASES[request.param])
    return reference, chip


def test_the_print_ends_and_the_fault_stops_the_printer(stories: tuple[Story, Story]) -> None:
    for story in stories:
        assert story.outcome.status == 3, story.outcome.reason
        assert story.end_of_print_s > 0.0
        assert story.shutdown_s < story.fault_s + SHUTDOWN_WITHIN_S


def test_both_give_the_same_reason(stories: tuple[Story, Story]) -> None:
    reference, chip = stories
    assert reference.outcome.reason == chip.outcome.reason


def test_both_make_the_same_steps(stories: tuple[Story, Story]) -> None:
    reference, chip = stories
    assert chip.crashed == reference.crashed == 0
    for axis, (forward, backward) in reference.steps.items():
        assert chip.steps[axis][0] == pytest.approx(forward, abs=HOMING_STEPS)
        assert chip.steps[axis][1] == pytest.approx(backward, abs=HOMING_STEPS)
        # at the end they stand at the same place: to the step
        assert chip.positions_mm[axis] == pytest.approx(reference.positions_mm[axis], abs=0.0126)


def test_both_extrude_the_same(stories: tuple[Story, Story]) -> None:
    reference, chip = stories
    assert chip.extruded_mm3 == pytest.approx(reference.extruded_mm3, rel=1e-3) and chip.extruded_mm3 > 10.0


def test_both_take_the_same_time(stories: tuple[Story, Story]) -> None:
    reference, chip = stories
    assert chip.end_of_print_s == pytest.approx(reference.end_of_print_s, abs=TIME_S[chip.case.heater])


def test_both_reach_and_hold_the_temperature(stories: tuple[Story, Story]) -> None:
    """25 to 250 °C in closed loop (200 on the Mega), and near it from settling on, in the print and after it."""
    for story in stories:
        heater, target_c = story.heater, story.case.target_c
        assert heater["targets"][0]["target_c"] == target_c
        assert heater["targets"][0]["reach_s"] < HEAT_WITHIN_S[story.case.heater]
        within_c = HOLD_WITHIN_C[story.case.heater]
        assert heater["settled_max_error_c"] < within_c
        assert len(story.held_c) > 5 and all(abs(c - target_c) < within_c for c in story.held_c)
    times = [story.heater["time_to_heat_s"] for story in stories]
    assert times[0] == pytest.approx(times[1], rel=0.01, abs=0.1)


def test_no_heat_after_the_shutdown(stories: tuple[Story, Story]) -> None:
    """Counted from the last look before it, a quarter of a second earlier."""
    for story in stories:
        assert story.energy_after_j < 0.3 * 81.3


def test_the_chip_lost_nothing_on_the_way(stories: tuple[Story, Story]) -> None:
    counters = stories[1].counters
    assert counters["console_overruns"] == counters["samples_lost"] == counters["resets"] == 0
    assert counters["console_baud"] == pytest.approx(250000, rel=0.02)


def test_no_interrupt_takes_a_tenth_of_a_millisecond(stories: tuple[Story, Story]) -> None:
    """The whole story, with the guard's trip and shutdown inside an interrupt; the Mega is 4.5 times slower."""
    build = make_build(stories[1].case.build)
    limit_s = 100e-6 if build.clock_hz > 20e6 else 1e-3
    assert max(stories[1].counters["longest_ticks"].values()) / build.clock_hz < limit_s


def test_the_stack_keeps_a_quarter_free(stories: tuple[Story, Story]) -> None:
    counters = stories[1].counters
    used = counters["stack_top"] - counters["stack_low"]
    assert 0 < used < 0.75 * (counters["stack_top"] - counters["stack_limit"])
