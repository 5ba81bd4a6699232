"""Drivers on SPI in closed loop: a register file at the other end of the wire, alone and in a daisy chain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from extras import bus
from extras.tmc import spi as tmc_spi
from extras.tmc.chips import TMC2240, TMC5160, Chip
from simulation.runner import BAD_INPUT, PRINTED, SHUT_DOWN, Outcome, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"
GCODE = "G28 X Y\nG1 X50 Y60 F6000\nM400\n"
LINES = {"spi_software_sclk_pin": "PG6", "spi_software_mosi_pin": "PG7", "spi_software_miso_pin": "PG8"}


def section(name: str, **options: Any) -> list[tuple[str, str, str]]:
    return [(name, option, str(value)) for option, value in options.items()]


class Driver:
    """A chip's registers behind its shift register of 40 bits."""

    def __init__(self) -> None:
        self.registers = {0x01: 1}  # GSTAT: it has just been switched on
        self.log: list[tuple[int, int]] = []
        self.answer = bytes(5)

    def take(self, datagram: bytes) -> None:
        """Chip select rises: what was shifted in counts; the answer goes out next time."""
        register, value = datagram[0] & 0x7F, int.from_bytes(datagram[1:], "big")
        if datagram[0] & 0x80:
            self.registers[register] = value if register != 0x01 else self.registers.get(1, 0) & ~value
            self.log.append((register, value))
        else:
            value = self.registers.get(register, 0)
        self.answer = bytes([0]) + value.to_bytes(4, "big")


class Shift:
    """Shift registers in a row, the first at MOSI: what falls out of the last one is MISO."""

    def __init__(self, *drivers: Driver) -> None:
        self.drivers = drivers

    def send(self, data: bytes) -> bytes:
        row = b"".join(driver.answer for driver in reversed(self.drivers))
        assert len(data) == len(row)
        # the row as it lies from MISO to MOSI; each byte in at one end pushes one out at the other
        coming, after = row, data
        for number, driver in enumerate(reversed(self.drivers)):
            driver.take(after[5 * number : 5 * number + 5])
        return coming

    def transfer(self, preface: bytes, data: bytes) -> dict[str, bytes]:
        self.send(bytes(preface))
        return {"response": self.send(bytes(data))}


@pytest.fixture
def run(tmp_path: Path):
    def go(overrides: list[tuple[str, str, str]], gcode: str = GCODE) -> tuple[Outcome, list[str]]:
        path = tmp_path / "part.gcode"
        path.write_text(gcode)
        answers: list[str] = []

        class Listening(Simulation):
            def _on_output(self, text: str) -> None:
                super()._on_output(text)
                answers.append(text)

        return Listening(RunOptions(CONFIG, path, 1, tuple(overrides))).run(), answers

    return go


@pytest.mark.parametrize("chip", [TMC5160, TMC2240], ids=lambda chip: chip.name)
def test_a_stall_is_an_endstop(run, monkeypatch: pytest.MonkeyPatch, chip: Chip) -> None:
    driver = Driver()
    monkeypatch.setattr(bus.MCU_SPI, "spi_transfer_with_preface", Shift(driver).transfer)
    overrides = [
        *section(
            f"{chip.name} stepper_x", cs_pin="PG5", diag1_pin="PA4", run_current=1.1, driver_sgt=-5, **LINES
        ),
        *section(f"{chip.name} stepper_x", stealthchop_threshold=50),
        ("stepper_x", "endstop_pin", f"{chip.name}_stepper_x:virtual_endstop"),
        ("simulator axis x", "endstop_pin", "PA4"),
        ("simulator axis x", "step_edges", "both"),
    ]
    dump = "DUMP_TMC STEPPER=stepper_x\nSET_TMC_CURRENT STEPPER=stepper_x CURRENT=0.5\n"
    dump += (
        "SET_TMC_FIELD STEPPER=stepper_x FIELD=SGT VALUE=-3\nDUMP_TMC STEPPER=stepper_x REGISTER=COOLCONF\n"
    )
    outcome, answers = run(overrides, GCODE + dump)
    assert outcome.status == PRINTED, outcome.reason
    axis = outcome.summary["axes"]["x"]
    assert axis["position_mm"] == pytest.approx(
        50.0, abs=0.03
    )  # sampling of the switch, and a step of 0.0125 mm
    gconf = [value for register, value in driver.log if register == 0x00]
    assert gconf[0] & 1 << 2, "StealthChop below its threshold"
    assert any(not value & 1 << 2 and value & 1 << 8 for value in gconf), (
        "SpreadCycle, stall on DIAG1, while homing"
    )
    assert gconf[-1] == gconf[0]
    assert driver.registers[0x01] == 0, "what was before is cleared"
    assert driver.registers[0x6D] >> 16 & 0x7F == 0x80 - 3
    assert driver.registers[0x68] == 0xFFFF8056, "the sine table's sections"
    text = "\n".join(answers)
    assert "CHOPCONF:" in text and "sgt=125" in text
    assert "Run Current: 0.50A" in text


def test_drivers_of_a_chain_each_get_their_own(run, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = Driver(), Driver()
    monkeypatch.setattr(bus.MCU_SPI, "spi_transfer_with_preface", Shift(first, second).transfer)
    common = {"cs_pin": "PG5", "chain_length": 2, **LINES}
    overrides = [
        *section("tmc5160 stepper_x", chain_position=1, run_current=3.0, driver_toff=4, **common),
        *section("tmc5160 stepper_y", chain_position=2, run_current=0.5, driver_toff=5, **common),
        ("simulator axis x", "step_edges", "both"),
        ("simulator axis y", "step_edges", "both"),
    ]
    outcome, _ = run(overrides)
    assert outcome.status == PRINTED, outcome.reason
    assert [driver.registers[0x6C] & 15 for driver in (first, second)] == [4, 5]
    assert first.registers[0x0B] > second.registers[0x0B] >= 32


def test_a_fault_stops_the_printer(run, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver()
    shift = Shift(driver)

    def transfer(_spi: Any, preface: bytes, data: bytes) -> dict[str, bytes]:
        if len(driver.log) > 5:
            driver.registers[0x6F] = 1 << 12
        return shift.transfer(preface, data)

    monkeypatch.setattr(bus.MCU_SPI, "spi_transfer_with_preface", transfer)
    options = {"cs_pin": "PG5", "run_current": 1.0, **LINES}
    outcome, _ = run([*section("tmc5160 stepper_x", **options), ("simulator axis x", "step_edges", "both")])
    assert outcome.status == SHUT_DOWN
    assert "short of coil A to the supply" in outcome.reason


def test_a_silent_driver_is_named(run) -> None:
    outcome, _ = run(section("tmc2130 stepper_x", cs_pin="PG5", run_current=0.8, **LINES))
    assert outcome.status == BAD_INPUT
    assert "The driver of 'stepper_x' does not answer on its SPI bus" in outcome.reason
    assert tmc_spi.TRIES > 1
