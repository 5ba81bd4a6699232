"""A board with is_non_critical vanishes and returns beside a print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from simulation.runner import BAD_INPUT, PRINTED, Outcome, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = """
[include {base}/config/sim-induction.cfg]
[respond]
[mcu hood]
serial: /tmp/ferrite_hood_mcu
is_non_critical: True
[output_pin light]
pin: hood:PB5
[output_pin lamp]
pin: hood:PB6
pwm: True
[temperature_sensor hood]
sensor_type: Generic 3950
sensor_pin: hood:PA1
[simulator mcu hood]
clock_ppm: -30
{more}
"""
PRINT = (
    "SET_PIN PIN=light VALUE=1\nSET_PIN PIN=lamp VALUE=0.25\nG28\n"
    + "G1 X100 F3000\nG1 X40\n" * 12
    + "M400\n"
)


class Vanishing(Simulation):
    """The board `hood` does what `plan` says: (s after the start, what)."""

    plan: tuple[tuple[float, Any], ...] = ()
    said: list[str]
    absent: list[tuple[float, bool]]

    def _new_printer(self) -> Any:
        printer = super()._new_printer()
        self.said, self.absent = [], []
        start = self.reactor.monotonic()
        for at_s, act in self.plan:
            self.reactor.register_callback(lambda eventtime, act=act: act(self), start + at_s)
        printer.lookup_object("gcode").register_output_handler(self.said.append)
        return printer

    def _sample(self, now: float) -> None:
        super()._sample(now)
        board = self.printer.lookup_object("mcu hood", None)
        if board is not None:
            self.absent.append((now - self.world.start_s, board.get_status(now)["non_critical_disconnected"]))


def cut(seconds: float) -> Any:
    def act(run: Vanishing) -> None:
        world = run.world
        world.lib.world_cut_link(world.pointer, 1, 1, 1, world.now + seconds)

    return act


def unplug(seconds: float) -> Any:
    """It loses its supply, too."""

    def act(run: Vanishing) -> None:
        cut(seconds)(run)
        run.world.lib.world_reset_mcu(run.world.pointer, 1)

    return act


def run(tmp_path: Path, gcode: str, *plan: tuple[float, Any], more: str = "") -> tuple[Vanishing, Outcome]:
    (tmp_path / "printer.cfg").write_text(CONFIG.format(base=ROOT, more=more))
    (tmp_path / "part.gcode").write_text(gcode)
    simulation = Vanishing(RunOptions(tmp_path / "printer.cfg", tmp_path / "part.gcode", 1, ()))
    simulation.plan = plan
    return simulation, simulation.run()


@pytest.mark.parametrize("loss", [cut, unplug])
def test_a_board_that_vanishes_and_returns_does_not_touch_the_print(tmp_path: Path, loss: Any) -> None:
    simulation, outcome = run(tmp_path, PRINT, (8.0, loss(9.0)))
    assert outcome.status == PRINTED, outcome.reason
    gone = [t for t, absent in simulation.absent if absent]
    assert 8.0 < gone[0] < 14.0 and 17.0 < gone[-1] < 22.0
    said = "\n".join(simulation.said)
    assert said.count("MCU 'hood' is not connected") == 1
    assert said.count("MCU 'hood' is connected again") == 1
    init = simulation.printer.lookup_object("mcu hood")._script.init_cmds
    light, lamp = (cmd for cmd in init if "_digital_out" in cmd)
    assert light.endswith("value=1"), "as it was before the board vanished"
    assert lamp.endswith(f"on_ticks={round(0.25 * 0.1 * 72e6)}")


def test_a_command_for_a_board_that_is_absent_is_refused(tmp_path: Path) -> None:
    gcode = "G28\nG1 X100 F3000\nG4 P20000\nSET_PIN PIN=light VALUE=1\n"
    _, outcome = run(tmp_path, gcode, (5.0, cut(100.0)))
    assert outcome.status != PRINTED
    assert "MCU 'hood' is not connected: check its cable and its supply" in outcome.reason


def test_a_board_that_is_absent_at_the_start_may_come_later(tmp_path: Path) -> None:
    simulation, outcome = run(tmp_path, "G28\nG4 P10000\nSET_PIN PIN=light VALUE=1\nM400\n", (0.0, cut(9.0)))
    assert outcome.status == PRINTED, outcome.reason
    assert any(absent for _, absent in simulation.absent) and not simulation.absent[-1][1]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("[stepper_x]\nstep_pin: hood:PC1\ndir_pin: hood:PC2\n", "'step_pin' in section 'stepper_x'"),
        ("[heater_bed]\nheater_pin: hood:PC1\n", "'heater_pin' in section 'heater_bed'"),
        ("[heater_bed]\nsensor_pin: hood:PC1\n", "'sensor_pin' in section 'heater_bed'"),
        (
            "[induction_heater nozzle]\nsense_pin: hood:PA0\n",
            "'sense_pin' in section 'induction_heater nozzle'",
        ),
        ("[mcu]\nis_non_critical: True\n", "'is_non_critical' in section 'mcu'"),
    ],
)
def test_what_must_not_vanish_is_refused_on_such_a_board(tmp_path: Path, more: str, says: str) -> None:
    _, outcome = run(tmp_path, "G4 P1\n", more=more)
    assert outcome.status == BAD_INPUT
    assert says in outcome.reason and "printer.cfg, line" in outcome.reason
