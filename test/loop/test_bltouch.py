"""A BLTouch in closed loop: servo pulses of the real firmware's software PWM, a pin that springs back, its sensor."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from probe_rig import ROOT, STEP_MM, Option, Probed, bed, run
from simulation.runner import BAD_INPUT, PRINTED

QUIET = bed(noise=0.0, bump_height=0.0)
# as in test_probe.py: two steps, and the same where z was homed
OFF_MM = 4 * STEP_MM


def touch(folder: Path, gcode: str, *options: Option) -> Probed:
    example = (ROOT / "config" / "example-probe.cfg").read_text()
    section = (
        "[bltouch]\nsensor_pin: ^PC3\ncontrol_pin: PC10\nx_offset: 20\ny_offset: -5\nz_offset: 1.5\nspeed: 5\n\n"
        "[safe_z_home]"
    )
    example, count = re.subn(r"\[probe\].*?\[safe_z_home\]", section, example, flags=re.S)
    assert count == 1
    config = folder / "touch.cfg"
    config.write_text(
        (ROOT / "config" / "sim-probe.cfg").read_text().replace("[include example-probe.cfg]", example)
    )
    return run(folder, gcode, *QUIET, *options, config=config)


def check_heights(result: Probed, count: int) -> None:
    assert result.status == PRINTED, result.reason
    found = result.found()
    assert len(found) == count
    home = result.bed(100, 100)
    for x, y, z in found:
        assert z == pytest.approx(1.5 + result.bed(x + 20, y - 5) - home, abs=OFF_MM)


PROBES = "G28\nG1 X20 Y30 Z6 F6000\nPROBE\nG1 X150 Y160 Z6\nPROBE SAMPLES=3\n"


def test_it_homes_and_probes(tmp_path: Path) -> None:
    result = touch(tmp_path, PROBES)
    check_heights(result, 4)
    assert result.status_of("probe")["name"] == "bltouch"


def test_the_pin_may_stay_out_between_samples(tmp_path: Path) -> None:
    out = touch(tmp_path, PROBES, ("bltouch", "stow_on_each_sample", "False"))
    check_heights(out, 4)


def test_it_probes_in_touch_mode(tmp_path: Path) -> None:
    check_heights(touch(tmp_path, PROBES, ("bltouch", "probe_with_touch_mode", "True")), 4)
    stays = ("bltouch", "stow_on_each_sample", "False")
    check_heights(touch(tmp_path, PROBES, ("bltouch", "probe_with_touch_mode", "True"), stays), 4)


def test_a_pin_that_does_not_come_out_stops_homing(tmp_path: Path) -> None:
    """Before the head moves down."""
    result = touch(tmp_path, "G28\n", *bed(stuck=1))
    assert result.status == BAD_INPUT
    assert "BLTouch failed to verify sensor state" in result.reason
    assert result.axis_mm("z") > 12.0


def test_the_commands_do_what_the_vendor_says(tmp_path: Path) -> None:
    """Up in touch mode is reported as a touch, out is not."""
    result = touch(
        tmp_path,
        "G28\nBLTOUCH_DEBUG COMMAND=pin_up\nQUERY_PROBE\nBLTOUCH_DEBUG COMMAND=touch_mode\nQUERY_PROBE\n"
        "BLTOUCH_DEBUG COMMAND=pin_down\nBLTOUCH_DEBUG COMMAND=touch_mode\nQUERY_PROBE\nBLTOUCH_DEBUG COMMAND=reset\n"
        "BLTOUCH_DEBUG COMMAND=dance\nBLTOUCH_STORE MODE=OD\nBLTOUCH_STORE MODE=3V\n",
    )
    assert result.status == PRINTED, result.reason
    assert re.findall(r"probe: (\w+)", result.text) == ["open", "TRIGGERED", "open"]
    assert "BLTouch commands: output_mode_store, pin_down, pin_up" in result.text
    assert "Storing BLTouch output mode OD" in result.text and "BLTouch output modes: 5V, OD" in result.text
