"""[smart_effector]: how it is programmed, and how gently it probes."""

from __future__ import annotations

from pathlib import Path

import pytest

from bus_devices import SmartEffectorLine
from bus_rig import BusSession, run, start_error

EFFECTOR = "[smart_effector]\npin: PA1\nz_offset: -0.1\nrecovery_time: 0.5\n"


def line_of(s: BusSession) -> SmartEffectorLine:
    return SmartEffectorLine(s.chip.pins["PA2"].log)


@pytest.mark.parametrize("sensitivity", [0, 50, 255])
def test_a_sensitivity_is_programmed_with_its_inverse(tmp_path: Path, sensitivity: int) -> None:
    def body(s: BusSession) -> None:
        s.gcode.run_script(f"SET_SMART_EFFECTOR SENSITIVITY={sensitivity}")
        assert line_of(s).received(3) == [105, sensitivity, 255 - sensitivity]
        assert s.toolhead.print_time > 200.0 + 3 * 14 * 0.001  # the head rests meanwhile

    run(tmp_path, EFFECTOR + "control_pin: PA2\n", body)


def test_the_sensitivity_of_the_factory_comes_back(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.gcode.run_script("RESET_SMART_EFFECTOR")
        assert line_of(s).received(2) == [131, 131]

    run(tmp_path, EFFECTOR + "control_pin: PA2\n", body)


def test_a_probing_move_is_gentle_after_a_rest_and_others_are_as_before(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        switch = s.printer.lookup_object("smart_effector")
        for accel, rest_s in ((100.0, 0.5), (250.0, 0.2)):
            s.toolhead.dwells.clear()
            switch.probe_prepare(None)
            assert s.toolhead.limits == (300.0, accel) and s.toolhead.dwells == [rest_s]
            switch.probe_finish(None)
            assert s.toolhead.limits == (300.0, 3000.0)
            s.gcode.run_script("SET_SMART_EFFECTOR ACCEL=250 RECOVERY_TIME=0.2")

    run(tmp_path, EFFECTOR + "probe_accel: 100\n", body)


def test_programming_needs_the_control_pin(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        with pytest.raises(s.printer.command_error, match="control_pin"):
            s.gcode.run_script("SET_SMART_EFFECTOR SENSITIVITY=20")
        assert "RESET_SMART_EFFECTOR" not in s.gcode.get_status(0.0)["commands"]

    run(tmp_path, EFFECTOR, body)


def test_bad_values_are_named_with_their_place(tmp_path: Path) -> None:
    reason = start_error(tmp_path, EFFECTOR + "probe_accel: -1\n")
    assert all(word in reason for word in ("probe_accel", "smart_effector", "line 5")), reason
