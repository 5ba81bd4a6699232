"""Homing and printing moves in closed loop: real firmware, simulated switches and axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from link import mcu_homing
from simulation.runner import BAD_INPUT, PRINTED, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"

# how the switch is really connected, whatever the host assumes
WIRED_X = ("simulator axis x", "endstop_pin", "PA4")


@pytest.fixture
def sim(tmp_path: Path):
    def go(gcode: str, *overrides: tuple[str, str, str], seed: int = 1) -> tuple[int, str, dict[str, Any]]:
        path = tmp_path / "part.gcode"
        path.write_text(gcode)
        outcome = Simulation(RunOptions(CONFIG, path, seed, overrides)).run()
        return outcome.status, outcome.reason, outcome.summary

    return go


def places(summary: dict[str, Any]) -> dict[str, float]:
    return {name: axis["position_mm"] for name, axis in summary["axes"].items()}


def test_the_head_is_where_gcode_says_after_homing(sim) -> None:
    status, reason, summary = sim("G28\nG1 X50 Y60 Z5 F6000\nM400\n")
    assert status == PRINTED, reason
    # a homed position is good to the switch's sampling and a step: 0.0125 mm for x and y, 0.0025 mm for z
    assert places(summary)["x"] == pytest.approx(50.0, abs=0.03)
    assert places(summary)["y"] == pytest.approx(60.0, abs=0.03)
    assert places(summary)["z"] == pytest.approx(5.0, abs=0.01)
    assert all(axis["steps_lost"] == 0 for axis in summary["axes"].values())


def test_homing_again_finds_the_same_place(sim) -> None:
    status, reason, summary = sim("G28\nG1 X30 Y30 F6000\nG28 X Y\nG28 X\nG1 X50 Y60 Z5 F6000\nM400\n")
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(50.0, abs=0.03)
    assert places(summary)["y"] == pytest.approx(60.0, abs=0.03)


def test_many_short_moves_arrive_complete(sim) -> None:
    lines = ["G28", "G1 X50 Y50 Z1 F6000", "G91"]
    for number in range(600):
        lines.append(f"G1 X{0.3 if number % 2 else -0.29:.2f} Y{0.05 if number < 300 else -0.05:.2f} F9000")
    lines += ["G90", "M400"]
    status, reason, summary = sim("\n".join(lines) + "\n")
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(53.0, abs=0.03)
    assert places(summary)["y"] == pytest.approx(50.0, abs=0.03)


def test_a_pause_between_moves_needs_no_new_homing(sim) -> None:
    """Longer than the 32-bit clock lasts at 72 MHz (59 s)."""
    status, reason, summary = sim("G28\nG1 X50 Y60 Z5 F6000\nG4 P70000\nG1 X20 F6000\nM400\n")
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(20.0, abs=0.03)


def test_an_endstop_that_never_triggers_is_named(sim) -> None:
    status, reason, _ = sim("G28 X\n", ("stepper_x", "endstop_pin", "PA9"), WIRED_X)
    assert status == BAD_INPUT
    assert "No trigger on x after full movement" in reason


def test_an_endstop_that_stays_triggered_is_noticed(sim) -> None:
    """An inverted switch reads as pressed all the way."""
    status, reason, _ = sim("G28 X\n", ("stepper_x", "endstop_pin", "!PA4"), WIRED_X)
    assert status == BAD_INPUT
    assert "still triggered after retract" in reason


def test_a_shaped_machine_homes_to_the_same_place(sim) -> None:
    """The trigger halts copies of the motion that are still to come; the place is known from the steps made."""
    shaper = [("input_shaper", f"shaper_freq_{axis}", "40") for axis in "xy"]
    status, reason, summary = sim("G28\nG1 X50 Y60 Z5 F6000\nG28 X\nG1 X80\nM400\n", *shaper)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(80.0, abs=0.03)
    assert places(summary)["y"] == pytest.approx(60.0, abs=0.03)
    assert all(axis["steps_lost"] == 0 for axis in summary["axes"].values())


def test_homing_survives_four_lost_reports_in_a_row(sim, monkeypatch) -> None:
    """Every fifth report arrives, 0.2 s after the one before; the board stops by itself after 0.25 s."""
    on_state, taken = mcu_homing.Trsync._on_state, [0, 0]  # by the board, by the host

    def mostly_deaf(trsync: mcu_homing.Trsync, params: dict[str, Any]) -> None:
        taken[0] += 1
        if not params["can_trigger"] or taken[0] % 5 == 0:
            taken[1] += 1
            on_state(trsync, params)

    monkeypatch.setattr(mcu_homing.Trsync, "_on_state", mostly_deaf)
    status, reason, _ = sim("G28\n")
    assert status == PRINTED, reason
    assert taken[0] - taken[1] > 60  # lost


def test_homing_survives_a_line_that_drops_one_byte_in_three_hundred(sim) -> None:
    """Of the messages one in six is lost in either direction; of 1000 runs at one byte in two hundred two failed."""
    status, reason, _ = sim("G28\n" * 6, ("simulator mcu", "drop", "0.003"))
    assert status == PRINTED, reason
