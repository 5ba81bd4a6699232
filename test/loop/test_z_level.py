"""Levelling with several Z motors, and the screws of the bed, in closed loop on the simulated machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from probe_rig import FLAT, STEP_MM, Probed, bed, run
from simulation.runner import BAD_INPUT, PRINTED

ROOT = Path(__file__).resolve().parents[2]
ONE_SAMPLE = ("probe", "samples", "1")
Z_OFFSET_MM = 1.5  # config/example-probe.cfg
FAST = [("probe", "speed", "8"), ONE_SAMPLE]
MOTORS = {"z": (-20.0, 100.0), "z1": (220.0, 0.0), "z2": (220.0, 200.0)}
CROOKED = [("simulator axis z1", "start_position", "12.9"), ("simulator axis z2", "start_position", "12.2")]
# a probed height is off by up to two steps; at the motors, beyond the points, by less than twice as much
OFF_MM = 4 * STEP_MM


def askew(result: Probed, motors: dict[str, tuple[float, float]]) -> float:
    """How much the heights over the bed's plane at the motors differ."""
    gaps = [result.axis_mm(name) - result.bed(*place) for name, place in motors.items()]
    return max(gaps) - min(gaps)


def test_three_motors_follow_a_tilted_bed(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nZ_TILT_ADJUST\n", *bed(noise=0.0, bump_height=0.0), *CROOKED, *FAST)
    assert result.status == PRINTED, result.reason
    assert result.status_of("z_tilt") == {"applied": True}
    assert askew(result, MOTORS) < OFF_MM
    # the bed is tilted by 0.002 and -0.001, the head hung by up to 0.7 mm: more than that was taken out
    assert "stepper_z2 = " in result.text


def test_the_bed_is_zero_after_z_tilt(tmp_path: Path) -> None:
    """What the probe finds then is its z_offset, however far off the endstop was."""
    result = run(tmp_path, "G28\nZ_TILT_ADJUST\n", *bed(noise=0.0, bump_height=0.0), *CROOKED, *FAST)
    heights = [z for _, _, z in result.found()]
    first, last = heights[:3], heights[-3:]
    assert last == pytest.approx([Z_OFFSET_MM] * 3, abs=0.02)
    assert max(first) - min(first) > 0.2 and max(last) - min(last) <= 0.02


def test_levelling_ends_within_a_noisy_probes_reach(tmp_path: Path) -> None:
    noise = bed(noise=0.003, bump_height=0.0)
    result = run(
        tmp_path, "G28\nZ_TILT_ADJUST RETRY_TOLERANCE=0.03\n", *noise, *CROOKED, ("probe", "speed", "8")
    )
    assert result.status == PRINTED, result.reason
    assert askew(result, MOTORS) < OFF_MM + 4 * 0.003


def test_without_retries_it_is_probed_once(tmp_path: Path) -> None:
    result = run(
        tmp_path, "G28\nZ_TILT_ADJUST RETRIES=0\n", *bed(noise=0.0, bump_height=0.0), *CROOKED, *FAST
    )
    assert result.status == PRINTED, result.reason
    assert len(result.found()) == 3 and result.status_of("z_tilt")["applied"]
    assert askew(result, MOTORS) < OFF_MM


def test_motors_in_the_wrong_order_are_noticed(tmp_path: Path) -> None:
    wrong = ("z_tilt", "z_positions", "\n220, 0\n-20, 100\n220, 200")
    places = ("simulator probe", "z_positions", "\n-20, 100\n220, 0\n220, 200")
    result = run(
        tmp_path, "G28\nZ_TILT_ADJUST\n", *bed(noise=0.0, bump_height=0.0), *CROOKED, *FAST, wrong, places
    )
    assert result.status == BAD_INPUT
    assert "range is increasing" in result.reason
    assert not result.status_of("z_tilt")["applied"]


def test_motors_off_forget_the_level(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nZ_TILT_ADJUST\nM84\n", *bed(noise=0.0, bump_height=0.0), *FAST)
    assert result.status == PRINTED, result.reason
    assert not result.status_of("z_tilt")["applied"]


def quad(folder: Path) -> Path:
    """A gantry on four motors."""
    example = (ROOT / "config" / "example-probe.cfg").read_text()
    world = (ROOT / "config" / "sim-probe.cfg").read_text()
    head, _, rest = example.partition("[z_tilt]")
    config = folder / "quad.cfg"
    config.write_text(
        head.rpartition("#")[0]
        + "[stepper_z3]\nstep_pin: PD4\ndir_pin: PD5\nenable_pin: !PD6\nmicrosteps: 16\nrotation_distance: 8\n"
        "[quad_gantry_level]\ngantry_corners:\n    -30, -20\n    230, 240\npoints:\n    10, 20\n    10, 180\n"
        "    170, 180\n    170, 20\nretries: 5\nretry_tolerance: 0.02\n"
        + world.replace("[include example-probe.cfg]", "").partition("z_positions:")[0]
        + "[simulator axis z3]\nstart_position: 12.7\n"
    )
    assert "z_tilt" in rest or "stepper_z3" in config.read_text()
    return config


CORNERS = {"z": (-30.0, -20.0), "z1": (-30.0, 240.0), "z2": (230.0, 240.0), "z3": (230.0, -20.0)}


def test_four_motors_level_a_gantry(tmp_path: Path) -> None:
    hangs = [("simulator axis z1", "start_position", "13.2"), ("simulator axis z3", "start_position", "12.4")]
    level_bed = bed(noise=0.0, bump_height=0.0)
    result = run(tmp_path, "G28\nQUAD_GANTRY_LEVEL\n", *level_bed, *hangs, *FAST, config=quad(tmp_path))
    assert result.status == PRINTED, result.reason
    assert result.status_of("quad_gantry_level") == {"applied": True}
    found = [z for _, _, z in result.found()[-4:]]
    assert max(found) - min(found) <= 0.02


def test_a_gantry_too_far_off_is_left_alone(tmp_path: Path) -> None:
    hangs = [("simulator axis z1", "start_position", "20")]
    result = run(tmp_path, "G28\nQUAD_GANTRY_LEVEL\n", *FLAT, *hangs, *FAST, ("quad_gantry_level", "max_adjust", "1.5"),
                 config=quad(tmp_path))  # fmt: skip
    assert result.status == BAD_INPUT
    assert "greater than max_adjust 1.5" in result.reason


def test_the_screws_are_reported_in_turns(tmp_path: Path) -> None:
    """M4: 0.7 mm a turn; the bed rises 0.32 mm over 160 mm of x and falls 0.15 mm over 150 mm of y."""
    result = run(tmp_path, "G28\nSCREWS_TILT_CALCULATE\n", *bed(noise=0.0, bump_height=0.0), *FAST)
    assert result.status == PRINTED, result.reason
    results = result.status_of("screws_tilt_adjust")["results"]
    assert results["screw1"]["is_base"] and results["screw1"]["adjust"] == "00:00"
    for name, rise in (("screw2", 0.32), ("screw3", 0.17), ("screw4", -0.15)):
        hours, minutes = results[name]["adjust"].split(":")
        # a clockwise turn raises the bed
        assert results[name]["sign"] == ("CCW" if rise > 0 else "CW")
        assert int(hours) + int(minutes) / 60 == pytest.approx(abs(rise) / 0.7, abs=OFF_MM / 0.7 + 1 / 60)
    assert "front right : x=165.0, y=35.0" in result.text and "adjust CCW 00:2" in result.text


def test_all_screws_in_one_direction(tmp_path: Path) -> None:
    result = run(
        tmp_path, "G28\nSCREWS_TILT_CALCULATE DIRECTION=CW\n", *bed(noise=0.0, bump_height=0.0), *FAST
    )
    results = result.status_of("screws_tilt_adjust")["results"]
    assert results["screw2"]["is_base"]  # the highest
    assert {r["sign"] for r in results.values()} == {"CW"}


def test_a_bed_off_by_more_than_allowed_is_an_error(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nSCREWS_TILT_CALCULATE MAX_DEVIATION=0.2\n", *bed(bump_height=0.0), *FAST)
    assert result.status == BAD_INPUT and "bed level exceeds configured limits" in result.reason
    status = result.status_of("screws_tilt_adjust")
    assert status["error"] and status["max_deviation"] == 0.2
