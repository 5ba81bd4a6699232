"""A part printed on the ATmega2560's image through the product's own host: cartridge heater, thermistor."""

from __future__ import annotations

from pathlib import Path

from scenario import ROOT, Case, play
from simulation.runner import PRINTED, RunOptions, Simulation

STACK_SHARE_MAX = 0.75


def test_part_is_printed_held_and_a_broken_sensor_ends_it(tmp_path: Path) -> None:
    story = play(Case("atmega2560", "sim-mega.cfg", 210.0, "load", ("fault", 1.0)), tmp_path)
    # the last corner of part(): 60 + 0.8 * 4 mm; every step counted by the machine, none lost against a stop
    assert abs(story.positions_mm["x"] - 63.2) < 0.0126 and abs(story.positions_mm["y"] - 63.2) < 0.0126
    assert story.crashed == 0 and abs(story.extruded_mm3 - 27.94) < 0.1
    assert max(abs(t - 210.0) for t in story.held_c) < 2.0
    # an open thermistor: out of range within its checks (4 groups of 0.3 s; the chip says at once what the
    # host reports in the end), and no energy from there on
    assert "ADC out of range" in " ".join([*story.outcome.summary["faults"], story.outcome.reason])
    assert story.shutdown_s - story.fault_s < 3.5
    # (what the four groups and the last look before the end have cost; holding on would be 13 W for 30 s)
    assert story.energy_after_j < 20.0
    counters = story.counters
    assert counters["console_overruns"] == 0 and counters["resets"] == 0
    space = counters["stack_top"] - counters["stack_limit"]
    assert space > 500 and counters["stack_top"] - counters["stack_low"] < STACK_SHARE_MAX * space


def test_a_damaged_line_costs_time_and_nothing_else(tmp_path: Path) -> None:
    part = tmp_path / "part.gcode"
    part.write_text("G28\nG90\nG1 X60 Y60 F9000\nG1 X70 Y60 F6000\nG1 X70 Y70\nG1 X60 Y60\n")
    damage = tuple(("simulator mcu", what, "0.002") for what in ("corrupt", "drop"))
    run = Simulation(RunOptions(ROOT / "config" / "sim-mega.cfg", part, overrides=damage))
    outcome = run.run()
    assert outcome.status == PRINTED, outcome.reason
    for axis in ("x", "y"):
        assert abs(outcome.summary["axes"][axis]["position_mm"] - 60.0) < 0.0126  # one step
        assert outcome.summary["axes"][axis]["steps_lost"] == 0
    stats = run.printer.lookup_object("mcu").get_status(0.0)["last_stats"]
    assert stats["bytes_retransmit"] > 300 and stats["bytes_invalid"] > 300
