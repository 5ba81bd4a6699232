"""Probing in closed loop: the real firmware's endstop and trsync, a simulated bed, and what the host makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from probe_rig import FLAT, STEP_MM, bed, run
from simulation.runner import BAD_INPUT, PRINTED

# A trigger is seen up to one look (a step's time, 0.5 ms at 5 mm/s) after it happened, and reported in whole steps.
SEEN_MM = 2 * STEP_MM


def test_homing_with_the_probe_puts_zero_on_the_bed(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nG1 X50 Y50 Z4 F3000\nM400\n", *FLAT)
    assert result.status == PRINTED, result.reason
    assert result.axis_mm("z") == pytest.approx(4.0, abs=SEEN_MM)
    assert result.axis_mm("z2") == pytest.approx(4.0, abs=SEEN_MM)


def test_the_bed_is_found_where_it_is(tmp_path: Path) -> None:
    """Below the probe, not below the nozzle, and z_offset above it; relative to where z was homed."""
    gcode = "G28\n" + "".join(
        f"G1 X{x} Y{y} Z5 F6000\nPROBE\n" for x, y in ((20, 30), (150, 40), (60, 150), (110, 105))
    )
    result = run(tmp_path, gcode, *bed(noise=0.0), ("probe", "samples", "1"))
    assert result.status == PRINTED, result.reason
    found = result.found()
    assert len(found) == 4
    home = result.bed(80 + 20, 105 - 5)
    for x, y, z in found:
        assert z == pytest.approx(1.5 + result.bed(x + 20, y - 5) - home, abs=2 * SEEN_MM)


def test_noise_is_what_probe_accuracy_says(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nPROBE_ACCURACY SAMPLES=40\n", *bed(noise=0.01))
    assert result.status == PRINTED, result.reason
    heights = [z for _, _, z in result.found()]
    assert len(heights) == 40
    said = float(result.text.rpartition("standard deviation ")[2].split()[0])
    # of 40 samples the standard deviation itself is known to 11 %; three times that
    assert said == pytest.approx(0.01, rel=0.35)
    assert len(set(heights)) > 5


def test_the_median_of_several_samples_is_nearer(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nPROBE SAMPLES=9 SAMPLES_TOLERANCE=1\n", *bed(noise=0.01))
    heights = [z for _, _, z in result.found()]
    reported = float(result.text.rpartition("Result is z=")[2].split()[0])
    assert reported == pytest.approx(sorted(heights)[4], abs=1e-6)
    assert result.status_of("probe")["last_z_result"] == pytest.approx(reported, abs=1e-6)


def test_samples_too_far_apart_are_taken_again_and_then_refused(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nPROBE SAMPLES=8 SAMPLES_TOLERANCE=0.003\n", *bed(noise=0.02))
    assert result.status == BAD_INPUT
    assert "Probe samples exceed samples_tolerance" in result.reason
    assert result.text.count("Probe samples exceed tolerance. Retrying...") == 3


def test_a_probe_that_never_triggers_is_reported(tmp_path: Path) -> None:
    """The bed lies lower than z may go."""
    result = run(
        tmp_path, "G28\nPROBE\n", *FLAT, ("stepper_z", "endstop_pin", "PC12"), ("stepper_z", "position_endstop", "0"),
        ("stepper_z", "position_min", "-1"), *bed(bed_height=-9),
    )  # fmt: skip
    assert result.status == BAD_INPUT
    assert "No trigger on probe after full movement" in result.reason


def test_a_probe_that_is_triggered_already_is_reported(tmp_path: Path) -> None:
    result = run(
        tmp_path, "G28\nQUERY_PROBE\nPROBE\n", *FLAT, ("stepper_z", "endstop_pin", "PC12"),
        ("stepper_z", "position_endstop", "0"), *bed(bed_height=20),
    )  # fmt: skip
    assert result.status == BAD_INPUT
    assert "probe: TRIGGERED" in result.text and result.status_of("probe")["last_query"] is True
    assert "Probe triggered prior to movement" in result.reason


def test_the_probe_may_be_on_another_board(tmp_path: Path) -> None:
    """The motors stop by way of the host, some milliseconds late; the trigger's place comes from its own clock."""
    config = tmp_path / "two.cfg"
    config.write_text(
        f"[include {Path(__file__).resolve().parents[2] / 'config' / 'sim-probe.cfg'}]\n[mcu head]\nserial: /tmp/head\n"
        "[simulator mcu head]\nclock_ppm: -40\n"
    )
    pin = ("probe", "pin", "head:PB7")
    gcode = "G28\nG1 X60 Y150 Z5 F6000\nPROBE\nG1 X20 Y30 Z5\nPROBE\n"
    result = run(tmp_path, gcode, pin, *bed(noise=0.0), ("probe", "samples", "1"), config=config)
    assert result.status == PRINTED, result.reason
    home = result.bed(100, 100)
    for x, y, z in result.found():
        # the boards' clocks agree to some 0.1 ms, at 5 mm/s another 0.5 um: lost in the steps
        assert z == pytest.approx(1.5 + result.bed(x + 20, y - 5) - home, abs=2 * SEEN_MM)


GCODE = (
    ("probe", "activate_gcode", "M118 out"),
    ("probe", "deactivate_gcode", "M118 back"),
    ("respond", "default_type", "echo"),
)


def test_gcode_brings_the_probe_out_and_back_for_each_sample(tmp_path: Path) -> None:
    """Homing approaches twice; then three samples."""
    result = run(tmp_path, "G28\nPROBE SAMPLES=3\n", *FLAT, *GCODE)
    assert [line for line in result.console if line in ("echo: out", "echo: back")] == [
        "echo: out",
        "echo: back",
    ] * 5


def test_or_once_for_a_series(tmp_path: Path) -> None:
    """G28, and then a probing of nine points."""
    result = run(
        tmp_path,
        "G28\nBED_MESH_CALIBRATE PROBE_COUNT=3\n",
        *FLAT,
        *GCODE,
        ("probe", "deactivate_on_each_sample", "False"),
    )
    assert result.status == PRINTED, result.reason
    assert [line for line in result.console if line in ("echo: out", "echo: back")] == [
        "echo: out",
        "echo: back",
    ] * 2


def test_a_probing_that_fails_brings_the_probe_back(tmp_path: Path) -> None:
    stays = ("probe", "deactivate_on_each_sample", "False")
    gcode = "G28\nPROBE SAMPLES=8 SAMPLES_TOLERANCE=0.003 SAMPLES_TOLERANCE_RETRIES=0\n"
    result = run(tmp_path, gcode, *bed(noise=0.02), *GCODE, stays)
    assert result.status == BAD_INPUT and "exceed samples_tolerance" in result.reason
    assert [line for line in result.console if line in ("echo: out", "echo: back")] == [
        "echo: out",
        "echo: back",
    ] * 2


def test_a_simulated_bed_needs_the_places_of_its_motors(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\n", ("simulator probe", "z_positions", "\n0, 0\n200, 0"))
    assert result.status == BAD_INPUT and "z_positions has 2 places for 3 Z axes (z, z1, z2)" in result.reason
