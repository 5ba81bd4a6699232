"""Wrong commands on a running printer: each is refused with a reason, and the machine goes on as if it had not come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from simulation.runner import BAD_INPUT, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"
BEFORE_HOMING = {"G1 X10 F6000": "Must home axis first", "G1 Z1 F600": "Must home axis first"}
WRONG = {
    "G1 Xnan F6000": "X needs a number",
    "G1 Xinf": "X needs a number",
    "G1 X Y10": "X needs a number",
    "G1 X10 F0": "F must be above zero",
    "G1 X10 F-600": "F must be above zero",
    "G1 X10 Fnan": "F needs a number",
    "G1 X900": "Move out of range",
    "G1 Y-50": "Move out of range",
    "G1 E5": "below minimum temp",
    "G1 X30 E900": "below minimum temp",
    "G4 P-1": "P must have minimum",
    "G92 Xnan": "X needs a number",
    "M204 S0": "S must have minimum of 0.001",
    "M220 S-10": "S must have minimum of 0.1",
    "SET_VELOCITY_LIMIT VELOCITY=0": "VELOCITY must have minimum of 0.001",
    "SET_VELOCITY_LIMIT ACCEL=nan": "is not a number",
    "SET_PRESSURE_ADVANCE ADVANCE=-1": "ADVANCE must have minimum",
    "SET_PRESSURE_ADVANCE ADVANCE=1e9": "ADVANCE must have maximum of 10",
    "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder DISTANCE=1e-6": "Rotation distance 1e-06 out of range",
    "STEPPER_BUZZ STEPPER=stepper_q": "stepper_q",
}


class Careless(Simulation):
    """A user who types nonsense before and after homing, and then prints."""

    def _print(self) -> None:
        self.said: dict[str, str] = {}
        gcode = self.printer.lookup_object("gcode")
        for line in BEFORE_HOMING:
            self._refused(gcode, line)
        gcode.run_script("G28\nG1 X20 Y20 F6000")
        for line in WRONG:
            self._refused(gcode, line)
        toolhead = self.printer.lookup_object("toolhead")
        self.calls: list[int] = []
        toolhead.register_move_listener(self._broken)
        for wrong in (math.nan, math.inf):  # as a plugin may compute
            for call in (lambda place: toolhead.move(place, 50.0), toolhead.set_position):
                with pytest.raises(self.printer.command_error, match="that is no number"):
                    call([wrong, 20.0, 0.0, 0.0])
        self.facts.faults.clear()  # what was refused is in the log, not wrong with the print
        super()._print()

    def _broken(self, moves: Sequence[object]) -> None:
        self.calls.append(len(moves))
        raise RuntimeError("a bug in a plugin")

    def _refused(self, gcode: object, line: str) -> None:
        with pytest.raises(self.printer.command_error) as refused:
            gcode.run_script(line)  # type: ignore[attr-defined]
        self.said[line] = str(refused.value)
        assert self.printer.get_state_message()[1] == "ready"


def test_each_is_refused_with_its_reason_and_the_next_print_is_right(tmp_path: Path) -> None:
    path = tmp_path / "part.gcode"
    path.write_text("G1 X40 Y40 F6000\nM400\nG1 X60 Y70 F6000\nM400\n")
    sim = Careless(RunOptions(CONFIG, path))
    outcome = sim.run()
    assert (
        outcome.status == BAD_INPUT and "Internal error of" in outcome.reason
    )  # reported, and the print went on
    assert "a bug in a plugin" in outcome.reason and len(sim.calls) == 1
    for line, reason in {**BEFORE_HOMING, **WRONG}.items():
        assert reason in sim.said[line], line
    axes = outcome.summary["axes"]
    # sampling of the switch, and a step of 0.0125 mm
    assert axes["x"]["position_mm"] == pytest.approx(60.0, abs=0.03)
    assert axes["y"]["position_mm"] == pytest.approx(70.0, abs=0.03)
