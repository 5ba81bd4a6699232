"""Drivers in closed loop: a register file at the other end of the wire, alone, in a daisy chain, on a UART."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from extras import bus
from extras.tmc import spi as tmc_spi
from extras.tmc import uart as tmc_uart
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
    def go(
        overrides: list[tuple[str, str, str]],
        gcode: str = GCODE,
        on_text: Callable[[Any, str], None] = lambda printer, text: None,
    ) -> tuple[Outcome, list[str]]:
        path = tmp_path / "part.gcode"
        path.write_text(gcode)
        answers: list[str] = []

        class Listening(Simulation):
            def _on_output(self, text: str) -> None:
                super()._on_output(text)
                answers.append(text)
                on_text(self.printer, text)

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


class Tmc2660:
    """A TMC2660 by its datasheet: a shift register of 20 bits, five registers, answers chosen by RDSEL."""

    TAGS = (
        (0b111, 17, "DRVCONF"),
        (0b110, 17, "SGCSCONF"),
        (0b101, 17, "SMARTEN"),
        (0b100, 17, "CHOPCONF"),
        (0, 18, "DRVCTRL"),
    )

    def __init__(self) -> None:
        self.registers: dict[str, int] = {"DRVCONF": 0}
        self.log: list[tuple[str, int]] = []
        self.counter, self.status = 0, 0

    def frame(self, data: bytes) -> bytes:
        word = int.from_bytes(data, "big") & 0xFFFFF
        high = (self.counter, 300, 300 >> 5 << 5 | 17)[self.registers["DRVCONF"] >> 4 & 3]
        answer = (high << 10 | self.status) << 8 * len(data) - 20
        shift, name = next((shift, name) for tag, shift, name in self.TAGS if word >> shift == tag)
        self.registers[name] = word & (1 << shift) - 1
        self.log.append((name, self.registers[name]))
        return answer.to_bytes(len(data), "big")

    def current_a(self, sense_ohm: float) -> float:
        full_v = 0.165 if self.registers["DRVCONF"] >> 6 & 1 else 0.310
        return ((self.registers["SGCSCONF"] & 31) + 1) / 32 * full_v / sense_ohm / 2**0.5


@pytest.fixture
def tmc2660(monkeypatch: pytest.MonkeyPatch) -> Tmc2660:
    driver = Tmc2660()
    monkeypatch.setattr(bus.MCU_SPI, "spi_send", lambda spi, data: driver.frame(bytes(data)))

    def transfer(spi: Any, preface: bytes, data: bytes) -> dict[str, bytes]:
        driver.frame(preface)
        return {"response": driver.frame(data)}

    monkeypatch.setattr(bus.MCU_SPI, "spi_transfer_with_preface", transfer)
    return driver


OPTIONS_2660 = {"cs_pin": "PG5", "run_current": 1.0, "sense_resistor": 0.051, **LINES}
EDGES_X = ("simulator axis x", "step_edges", "both")


def test_a_tmc2660_gets_its_settings_and_is_read_by_rdsel(run, tmc2660: Tmc2660) -> None:
    tmc2660.counter = 511
    overrides = section("tmc2660 stepper_x", **OPTIONS_2660, driver_sgt=-3, driver_hend=5, driver_semin=2)
    commands = "DUMP_TMC STEPPER=stepper_x\nSET_TMC_FIELD STEPPER=stepper_x FIELD=toff VALUE=6\n"
    commands += "SET_TMC_CURRENT STEPPER=stepper_x CURRENT=2.5\n"
    outcome, answers = run([*overrides, EDGES_X], GCODE + commands)
    assert outcome.status == PRINTED, outcome.reason
    first: dict[str, int] = {}
    for name, value in tmc2660.log:
        first.setdefault(name, value)
    assert [name for name, _ in tmc2660.log[:5]][-1] == "CHOPCONF", "the current flows last"
    assert first["DRVCTRL"] == 1 << 9 | 1 << 8 | 4, "interpolated, both edges, 16 microsteps"
    assert first["CHOPCONF"] == 2 << 15 | 5 << 7 | 3 << 4 | 4
    assert first["SMARTEN"] == 2
    assert first["SGCSCONF"] >> 8 == 0x80 - 3
    assert first["DRVCONF"] >> 8 == 3
    assert tmc2660.registers["CHOPCONF"] & 15 == 6
    # half a step of 32
    assert tmc2660.current_a(0.051) == pytest.approx(2.5, abs=0.310 / 0.051 / 2**0.5 / 64)
    text = "\n".join(answers)
    assert "mscnt=511" in text and "sg_result=300" in text and "se=17" in text


def test_a_tmc2660_is_lowered_while_idle(run, tmc2660: Tmc2660) -> None:
    overrides = section("tmc2660 stepper_x", **OPTIONS_2660, idle_current_percent=40)
    gcode = GCODE + "M118 idle\nG4 P200\nM118 printing\nG4 P200\n"
    seen: list[float] = []

    def on_text(printer: Any, text: str) -> None:
        for state in ("idle", "printing"):
            if f"echo: {state}" in text:
                printer.send_event(f"idle_timeout:{state}", 0.0)
                seen.append(tmc2660.current_a(0.051))

    outcome, _ = run([*overrides, EDGES_X, ("respond", "default_type", "echo")], gcode, on_text)
    assert outcome.status == PRINTED, outcome.reason
    # half a step of 32 of the smaller range
    assert seen == pytest.approx([0.4, 1.0], abs=0.165 / 0.051 / 2**0.5 / 64)


def test_a_tmc2660_that_is_too_hot_stops_the_printer(run, tmc2660: Tmc2660) -> None:
    tmc2660.status = 0x02
    outcome, _ = run([*section("tmc2660 stepper_x", **OPTIONS_2660), EDGES_X])
    assert outcome.status == SHUT_DOWN
    assert "too hot" in outcome.reason


class UartDriver:
    """A driver on a single-wire UART, by the datasheets' datagrams."""

    def __init__(self, address: int) -> None:
        self.address = address
        self.registers = {0x01: 1, 0x02: 0}
        self.written: list[tuple[int, int]] = []

    def take(self, data: bytes) -> bytes:
        """A datagram; the answer's bytes."""
        assert data[0] == 0x05 and data[-1] == tmc_uart.crc8(data[:-1])
        if data[1] != self.address:
            return b""
        register = data[2] & 0x7F
        if data[2] & 0x80:
            value = int.from_bytes(data[3:7], "big")
            self.registers[register] = value if register != 0x01 else self.registers[1] & ~value
            self.registers[0x02] = self.registers[0x02] + 1 & 0xFF
            self.written.append((register, self.registers[register]))
            return b""
        body = bytes([0x05, 0xFF, register]) + self.registers.get(register, 0).to_bytes(4, "big")
        return body + bytes([tmc_uart.crc8(body)])


class Multiplexer:
    """Leads the wire to the drivers of one level of the select pin."""

    def __init__(self, *drivers: tuple[int, UartDriver]) -> None:
        self.drivers = drivers
        self.level = 0

    def set_level(self, level: int) -> None:
        self.level = level

    def transfer(self, datagram: bytes, answer_bytes: int) -> bytes:
        answer = b"".join(driver.take(datagram) for level, driver in self.drivers if level == self.level)
        return tmc_uart.to_bits(answer)


@pytest.fixture
def attach(monkeypatch: pytest.MonkeyPatch):
    def go(*drivers: tuple[int, UartDriver]) -> Multiplexer:
        multiplexer = Multiplexer(*drivers)
        monkeypatch.setattr(tmc_uart.Wire, "transfer", multiplexer.transfer)
        monkeypatch.setattr(bus.MCU_bus_digital_out, "update_digital_out", multiplexer.set_level)
        return multiplexer

    return go


def test_select_pins_lead_the_wire_to_each_driver(run, attach) -> None:
    first, second = UartDriver(0), UartDriver(0)
    attach((1, first), (0, second))
    overrides = [
        *section("tmc2209 stepper_x", uart_pin="PG5", select_pins="PG6", run_current=0.8, driver_toff=4),
        *section("tmc2208 stepper_y", uart_pin="PG5", select_pins="!PG6", run_current=0.8, driver_toff=5),
        EDGES_X,
        ("simulator axis y", "step_edges", "both"),
    ]
    outcome, _ = run(overrides)
    assert outcome.status == PRINTED, outcome.reason
    assert [driver.registers[0x6C] & 15 for driver in (first, second)] == [4, 5]


@pytest.mark.parametrize(
    ("pins", "address", "words"),
    [
        ("PG7", 0, ("select_pins", "tmc2209 stepper_y", "mcu:PG6")),
        ("PG6", 0, ("tmc2209 stepper_y", "'stepper_x'", "uart_address 0")),
    ],
)
def test_select_pins_that_do_not_fit_are_refused(
    run, pins: str, address: int, words: tuple[str, ...]
) -> None:
    common = {"uart_pin": "PG5", "run_current": 0.8}
    overrides = [
        *section("tmc2209 stepper_x", select_pins="PG6", **common),
        *section("tmc2209 stepper_y", select_pins=pins, uart_address=address, **common),
    ]
    outcome, _ = run(overrides)
    assert outcome.status == BAD_INPUT
    assert all(word in outcome.reason for word in words), outcome.reason


def test_a_tmc2240_works_on_a_uart_with_stallguard4(run, attach) -> None:
    driver = UartDriver(6)
    attach((0, driver))
    options = {"uart_pin": "PG5", "uart_address": 6, "diag0_pin": "PA4", "run_current": 1.1}
    overrides = [
        *section("tmc2240 stepper_x", **options, driver_sg4_thrs=90, driver_slope_control=2),
        ("stepper_x", "endstop_pin", "tmc2240_stepper_x:virtual_endstop"),
        ("simulator axis x", "endstop_pin", "PA4"),
        EDGES_X,
    ]
    outcome, _ = run(overrides)
    assert outcome.status == PRINTED, outcome.reason
    assert outcome.summary["axes"]["x"]["position_mm"] == pytest.approx(50.0, abs=0.03)
    assert driver.registers[0x03] == 2 << 8, "no two drivers answer at once"
    assert driver.registers[0x74] & 0xFF == 90
    assert driver.registers[0x0A] >> 4 & 3 == 2
    gconf = [value for register, value in driver.written if register == 0x00]
    # StallGuard4 needs StealthChop; it was off before
    assert not gconf[0] & 1 << 2 and any(value & 1 << 2 and value & 1 << 7 for value in gconf)
    assert gconf[-1] == gconf[0]
