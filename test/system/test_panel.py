"""A display on the simulated printer: the chip's pixels, and the menu by hand from the first screen to a print."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from pathlib import Path
from typing import Any

import pytest

from extras.display import font8x16
from simulation.panel.image import as_text
from simulation.panel.simulated import SimulatedPanel
from simulation.runner import PRINTED, RunOptions, Simulation
from system.conftest import CONFIG

KNOB = "encoder_pins: ^PF1, ^PF2\nclick_pin: ^!PF3\nback_pin: ^!PF4\n"
SOFT = "spi_software_sclk_pin: PH1\nspi_software_mosi_pin: PH2\nspi_software_miso_pin: PH3\n"
LCDS = {
    "st7920": "cs_pin: PF5\nsclk_pin: PF6\nsid_pin: PF7\n",
    "emulated_st7920": f"en_pin: PF5\n{SOFT}",
    "hd44780": "".join(f"{name}_pin: PH{i}\n" for i, name in enumerate(("rs", "e", "d4", "d5", "d6", "d7"))),
    "hd44780_spi": f"latch_pin: PF5\n{SOFT}",
    "aip31068_spi": f"latch_pin: PF5\n{SOFT}",
    "uc1701": "spi_bus: spi0\ncs_pin: PF5\na0_pin: PF6\nrst_pin: PF7\n",
    "ssd1306": "i2c_bus: i2c0\nreset_pin: PF7\n",
    "sh1106": f"cs_pin: PF5\ndc_pin: PF6\nx_offset: 2\n{SOFT}",
}
CHARACTER = ("hd44780", "hd44780_spi", "aip31068_spi")
PLAIN = """display_group: plain
[display_data plain a]
position: 0, 0
text: Ferrite
[display_data plain b]
position: 3, 2
text: { printer.idle_timeout.state }
[simulator panel display]
"""
PART = "G28\nM117 Drawing\nG1 X50 Y50 F6000\nG4 P20000\n"


class ByHand(Simulation):
    """In place of printing a file: `body` with the display in its hands."""

    def __init__(self, options: RunOptions, body: Callable[[ByHand], None]) -> None:
        super().__init__(options)
        self._body = body
        self.failure: BaseException | None = None

    @property
    def panel(self) -> SimulatedPanel:
        assert self.machine is not None
        return self.machine.panels["display"]

    def wait(self, seconds: float) -> None:
        self.reactor.pause(self.reactor.monotonic() + seconds)

    def do(self, waits: Any) -> None:
        """Let a hand's movement happen, and the picture follow it."""
        for wait_s in waits:
            self.wait(wait_s)
        self.wait(1.5)

    def status(self, name: str) -> dict[str, Any]:
        status: dict[str, Any] = self.printer.lookup_object(name).get_status(self.reactor.monotonic())
        return status

    def _print(self) -> None:
        try:
            self._body(self)
        except BaseException as e:  # out of the reactor's greenlet
            self.failure = e
        self._end(PRINTED, "done by hand")


def run(
    tmp_path: Path, lcd_type: str, body: Callable[[ByHand], None], more: str = "[simulator panel display]\n"
) -> None:
    config, part = tmp_path / "printer.cfg", tmp_path / "part.gcode"
    part.write_text(PART)
    config.write_text(CONFIG.read_text() + f"\n[display]\nlcd_type: {lcd_type}\n{LCDS[lcd_type]}{KNOB}{more}")
    simulation = ByHand(RunOptions(config, part), body)
    outcome = simulation.run()
    if simulation.failure is not None:
        raise simulation.failure
    assert outcome.status == PRINTED, outcome.reason


def letters(lines: list[str]) -> str:
    """Four lines of 16 letters as pixels."""
    rows = [[0] * 128 for _ in range(64)]
    for row, line in enumerate(lines):
        for column, letter in enumerate(line):
            for y, bits in enumerate(font8x16.bitmap(letter)):
                for x in range(8):
                    rows[16 * row + y][8 * column + x] = bits >> 7 - x & 1
    return as_text(rows)


@pytest.mark.parametrize("lcd_type", LCDS)
def test_each_kind_of_display_shows_its_screen(tmp_path: Path, lcd_type: str) -> None:
    def body(s: ByHand) -> None:
        s.wait(4.0)
        if lcd_type in CHARACTER:
            s.panel.read()
            assert s.panel.objection is None
            assert s.panel.chip.text() == ["Ferrite".ljust(20), " " * 20, " " * 20, "  Idle".ljust(20)]
        else:
            assert as_text(s.panel.picture()) == letters(["Ferrite", "", "", "  Idle"])

    run(tmp_path, lcd_type, body, PLAIN)


def test_the_knob_leads_from_the_first_screen_to_a_print(tmp_path: Path) -> None:
    def body(s: ByHand) -> None:
        s.wait(3.0)
        first = as_text(s.panel.picture())
        s.do(s.panel.press("click"))
        assert as_text(s.panel.picture()) == letters(
            [" ..", ">SD Card       >", " Control       >", " Temperature   >"]
        )
        s.do(s.panel.turn(4))
        assert s.status("menu")["selected"] == "__main __setup"
        assert as_text(s.panel.picture()) == letters(
            [" Control       >", " Temperature   >", " Filament      >", ">Setup         >"]
        )
        s.do(s.panel.turn(-4))
        s.do(s.panel.press("click"))
        assert s.status("menu")["list"] == "__main __sdcard"
        assert as_text(s.panel.picture()) == letters([" ..", ">part.gcode    >", "", ""])
        s.do(s.panel.press("click"))
        assert as_text(s.panel.picture()) == letters([" ..", ">Start printing", "", ""])
        assert s.status("print_stats")["state"] == "standby"
        s.do(s.panel.press("click"))
        assert s.status("print_stats")["state"] == "printing"
        assert not s.status("menu")["running"]
        s.wait(20.0)
        screen = as_text(s.panel.picture())
        assert screen != first
        assert screen.splitlines()[48:] == letters(["", "", "", "Drawing"]).splitlines()[48:]

    run(tmp_path, "st7920", body)


def test_a_value_is_edited_by_the_knob_and_set_at_the_next_click(tmp_path: Path) -> None:
    def set_value(picture: str) -> list[str]:
        """The first eight letters of the second line; the estimate follows them."""
        return [row[:64] for row in picture.splitlines()[16:32]]

    def body(s: ByHand) -> None:
        s.wait(3.0)
        s.do(s.panel.press("click"))
        s.do(s.panel.turn(2))
        s.do(s.panel.press("click"))
        assert s.status("menu")["list"] == "__main __temp"
        s.do(s.panel.press("click"))
        assert set_value(as_text(s.panel.picture())) == set_value(letters(["", "*Ex0:  0"]))
        for _ in range(3):  # slowly: a detent is a degree
            s.do(s.panel.turn(1))
        assert set_value(as_text(s.panel.picture())) == set_value(letters(["", "*Ex0:  3"]))
        assert s.status("extruder")["target"] == 0
        s.do(s.panel.press("click"))
        assert s.status("extruder")["target"] == 3
        assert not s.status("menu")["editing"]
        s.do(s.panel.press("back"))
        s.do(s.panel.press("back"))
        assert not s.status("menu")["running"]

    run(tmp_path, "uc1701", body)


def test_the_knob_and_the_picture_can_be_had_by_command(tmp_path: Path) -> None:
    def body(s: ByHand) -> None:
        gcode = s.printer.lookup_object("gcode")
        s.wait(3.0)
        gcode.run_script("SIMULATOR_PANEL PRESS=click")
        gcode.run_script("SIMULATOR_PANEL TURN=1")
        s.wait(1.5)
        assert s.status("menu")["selected"] == "__main __control"
        path = tmp_path / "screen.png"
        gcode.run_script(f"SIMULATOR_PANEL PICTURE={path}")
        assert path.read_bytes().startswith(b"\x89PNG")
        with pytest.raises(s.printer.command_error, match="the display has no up_pin; it has click, back"):
            gcode.run_script("SIMULATOR_PANEL PRESS=up")

    run(tmp_path, "st7920", body)


def test_a_picture_that_always_changes_does_not_delay_a_print(tmp_path: Path) -> None:
    """Each refresh draws all 64 letters anew, a kilobyte of pixels; the line carries 400 moves a second besides."""
    busy = "display_group: busy\n[simulator panel display]\n"
    for row in range(4):
        number = f"printer.toolhead.estimated_print_time * 7.3**{row + 1}"
        busy += f"[display_data busy d{row}]\nposition: {row}, 0\ntext: {{ '%016.8f' % ({number}) }}\n"
    turns = (i * 0.25 / 40.0 for i in range(6000))
    circle = "".join(f"G1 X{100 + 40 * cos(a):.3f} Y{100 + 40 * sin(a):.3f} F6000\n" for a in turns)
    durations, written = [], []
    for more in (busy, PLAIN):

        def body(s: ByHand) -> None:
            gcode = s.printer.lookup_object("gcode")
            gcode.run_script("G28\nG1 X140 Y100 F6000\nM400\n")
            before = s.status("toolhead")["print_time"]
            gcode.run_script(f"{circle}M400\n")
            status = s.status("toolhead")
            assert status["stalls"] == 0
            durations.append(status["print_time"] - before)
            written.append(s.printer.lookup_object("mcu").get_status(0)["last_stats"]["bytes_write"])

        run(tmp_path, "uc1701", body, more)
    assert durations[0] == pytest.approx(durations[1], abs=1e-6) == pytest.approx(15.0, abs=1.0)
    assert written[0] - written[1] > 15 * 2 * 512, "it was drawn"


def test_a_section_without_its_display_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"
    config.write_text(CONFIG.read_text() + "\n[simulator panel display]\n")
    (tmp_path / "part.gcode").write_text(PART)
    outcome = Simulation(RunOptions(config, tmp_path / "part.gcode")).run()
    assert outcome.status == 2
    assert "Section 'simulator panel display' needs a section 'display' that it belongs to." in outcome.reason
