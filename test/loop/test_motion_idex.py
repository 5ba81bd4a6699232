"""Two carriages, motors beside the head, and stall detection in closed loop: real firmware, simulated axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from extras.tmc import uart as tmc_uart
from simulation.runner import BAD_INPUT, PRINTED, SHUT_DOWN, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"
# a homed place is good to the switch's sampling and a step of 0.0125 mm
HOMED_MM = 0.03


def section(name: str, **options: Any) -> list[tuple[str, str, str]]:
    return [(name, option, str(value)) for option, value in options.items()]


MOTOR = {"microsteps": 16, "rotation_distance": 40}
DUAL = [
    *section("dual_carriage", axis="x", step_pin="PG1", dir_pin="PG2", endstop_pin="PG4", **MOTOR),
    *section("dual_carriage", position_min=40, position_max=220, position_endstop=220, homing_speed=40),
    *section("simulator axis u", section="dual_carriage", start_position=150),
]
FEEDER = [
    *section("manual_stepper feeder", step_pin="PG1", dir_pin="PG2", endstop_pin="PG4", accel=500, **MOTOR),
    *section("simulator axis feeder", section="manual_stepper feeder", position_min=-20, position_max=120),
    *section("simulator axis feeder", endstop_position=0, start_position=40),
]
# how the switch is really connected, whatever the host assumes
WIRED_X = ("simulator axis x", "endstop_pin", "PA4")
TMC = [
    *section("tmc2209 stepper_x", uart_pin="PG5", diag_pin="PA4", run_current=0.8, driver_sgthrs=90),
    ("stepper_x", "endstop_pin", "tmc2209_stepper_x:virtual_endstop"),
    WIRED_X,
    *section("simulator axis x", step_edges="both"),
]


@pytest.fixture
def sim(tmp_path: Path):
    def go(gcode: str, overrides: list[tuple[str, str, str]]) -> tuple[int, str, dict[str, Any]]:
        path = tmp_path / "part.gcode"
        path.write_text(gcode)
        outcome = Simulation(RunOptions(CONFIG, path, 1, tuple(overrides))).run()
        return outcome.status, outcome.reason, outcome.summary

    return go


def places(summary: dict[str, Any]) -> dict[str, float]:
    assert all(axis["steps_lost"] == 0 for axis in summary["axes"].values())
    return {name: axis["position_mm"] for name, axis in summary["axes"].items()}


def test_both_carriages_home_and_mirror(sim) -> None:
    gcode = "G28\nG1 X30 Y30 F6000\nSET_DUAL_CARRIAGE CARRIAGE=1 MODE=MIRROR\nG1 X50\nM400\n"
    status, reason, summary = sim(gcode, DUAL)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(50.0, abs=HOMED_MM)
    assert places(summary)["u"] == pytest.approx(200.0, abs=HOMED_MM)


def test_the_second_carriage_prints_while_the_first_rests(sim) -> None:
    gcode = "G28\nG1 X30 F6000\nSET_DUAL_CARRIAGE CARRIAGE=1\nG1 X100 Y40 F6000\nM400\n"
    status, reason, summary = sim(gcode, DUAL)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(30.0, abs=HOMED_MM)
    assert places(summary)["u"] == pytest.approx(100.0, abs=HOMED_MM)


def test_a_manual_stepper_homes_and_moves_beside_the_head(sim) -> None:
    gcode = (
        "G28\nMANUAL_STEPPER STEPPER=feeder SET_POSITION=0 SPEED=20 MOVE=-100 STOP_ON_ENDSTOP=1\n"
        "MANUAL_STEPPER STEPPER=feeder SET_POSITION=0\nMANUAL_STEPPER STEPPER=feeder MOVE=60 SPEED=10 SYNC=0\n"
        "G1 X50 Y60 F6000\nG4 P8000\nM400\n"
    )
    status, reason, summary = sim(gcode, FEEDER)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(50.0, abs=HOMED_MM)
    # the switch at 0 is overrun while the motor comes to its halt: the host counts that
    assert places(summary)["feeder"] == pytest.approx(60.0, abs=HOMED_MM + 0.1)


def test_a_move_beside_a_resting_head_is_finished(sim) -> None:
    """Nobody moves the head meanwhile: the toolhead's timer works out the steps."""
    gcode = (
        "MANUAL_STEPPER STEPPER=feeder SET_POSITION=40\nMANUAL_STEPPER STEPPER=feeder MOVE=60 SPEED=10 SYNC=0\n"
        "M190 S40\n"  # the bed takes longer than the two seconds of the move
    )
    status, reason, summary = sim(gcode, FEEDER)
    assert status == PRINTED, reason
    assert places(summary)["feeder"] == pytest.approx(60.0, abs=0.02)


def test_an_extra_axis_moves_with_the_head(sim) -> None:
    gcode = (
        "G28\nMANUAL_STEPPER STEPPER=feeder SET_POSITION=40\nMANUAL_STEPPER STEPPER=feeder GCODE_AXIS=U\n"
        "G1 X50 Y60 U90 F6000\nG1 U55\nM400\n"
    )
    status, reason, summary = sim(gcode, FEEDER)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(50.0, abs=HOMED_MM)
    assert places(summary)["feeder"] == pytest.approx(55.0, abs=0.02)


class Driver:
    """A TMC2209 at the other end of the wire."""

    def __init__(self) -> None:
        self.registers = {0x02: 0, 0x01: 1}  # GSTAT: it has just been switched on
        self.log: list[tuple[int, int]] = []

    def transfer(self, datagram: bytes) -> bytes:
        assert datagram[-1] == tmc_uart.crc8(datagram[:-1]) and datagram[0] == 0x05
        register = datagram[2] & 0x7F
        if datagram[2] & 0x80:
            value = int.from_bytes(datagram[3:7], "big")
            # GSTAT is cleared by ones
            self.registers[register] = value if register != 0x01 else self.registers.get(1, 0) & ~value
            self.registers[0x02] = (self.registers[0x02] + 1) & 0xFF
            self.log.append((register, value))
            return b""
        answer = bytes([0x05, 0xFF, register]) + self.registers.get(register, 0).to_bytes(4, "big")
        return tmc_uart.to_bits(answer + bytes([tmc_uart.crc8(answer)]))


def test_a_stall_is_an_endstop(sim, monkeypatch: pytest.MonkeyPatch) -> None:
    """DIAG is wired to the axis' switch here; the driver's registers are those for a stall while homing only."""
    driver = Driver()
    monkeypatch.setattr(tmc_uart.Wire, "transfer", lambda wire, datagram, count: driver.transfer(datagram))
    status, reason, summary = sim("G28\nG1 X50 Y60 Z5 F6000\nM400\n", TMC)
    assert status == PRINTED, reason
    assert places(summary)["x"] == pytest.approx(50.0, abs=HOMED_MM)
    thresholds = [value for register, value in driver.log if register == 0x14]
    # at the start, and twice (two approaches) to the largest and back
    assert thresholds == [0, 0xFFFFF, 0, 0xFFFFF, 0]
    assert driver.registers[0x40] == 90
    assert driver.registers[0x00] & 4, "back to SpreadCycle"


@pytest.mark.parametrize(
    ("register", "value", "text"),
    [(0x6F, 1 << 1, "too hot"), (0x6F, 1 << 2, "short of coil A to ground"), (0x01, 1, "lost its settings")],
)
def test_a_fault_of_the_driver_stops_the_printer(
    sim, monkeypatch: pytest.MonkeyPatch, register: int, value: int, text: str
) -> None:
    driver = Driver()

    def transfer(wire: tmc_uart.Wire, datagram: bytes, count: int) -> bytes:
        if (0x14, 0xFFFFF) in driver.log:  # while homing, with the motor on
            driver.registers[register] = value
        return driver.transfer(datagram)

    monkeypatch.setattr(tmc_uart.Wire, "transfer", transfer)
    status, reason, _ = sim("G28\nG1 X50 Y60 Z5 F600\nM400\n", TMC)
    assert status == SHUT_DOWN
    assert "The driver of 'stepper_x' " in reason and text in reason


def test_a_silent_driver_is_named(sim) -> None:
    status, reason, _ = sim("G28\n", TMC)
    assert status == BAD_INPUT
    assert "The driver of 'stepper_x' does not answer on its UART" in reason
