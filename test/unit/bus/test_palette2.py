"""[palette2]: what a Palette 2 is sent and how its messages are taken, on a port whose other end is a model of it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from bus_rig import BusSession, run, start_error
from extras import palette2

CONFIG = (
    "[palette2]\nserial: /dev/palette\nauto_cancel_variation: 0.1\n[respond]\n[virtual_sdcard]\npath: /tmp\n"
)
MACROS = "".join(
    f"[gcode_macro {name}]\n{extra}gcode: M118 {name} {{rawparams}}\n"
    for name, extra in (
        ("M220", ""), ("RESUME", "rename_existing: BASE_RESUME\n"), ("PAUSE", "rename_existing: BASE_PAUSE\n"),
        ("CANCEL_PRINT", "rename_existing: BASE_CANCEL\n"), ("M83", ""), ("G1", ""), ("M400", ""),
    )
)  # fmt: skip


class Device:
    """The Palette: answers heartbeats; `lines` is what it was sent otherwise."""

    instance: Device

    def __init__(self, *args: Any, **options: Any) -> None:
        self.read_end, self.write_end = os.pipe()
        self.lines: list[str] = []
        self.is_silent = False
        self.partial = b""
        Device.instance = self

    def fileno(self) -> int:
        return self.read_end

    def close(self) -> None:
        pass

    def say(self, line: str) -> None:
        os.write(self.write_end, f"{line}\n".encode())

    def write(self, data: bytes) -> None:
        *lines, self.partial = (self.partial + data).split(b"\n")
        for line in (raw.decode() for raw in lines):
            if line == "O99":
                if not self.is_silent:
                    self.say("O99")
            elif line:
                self.lines.append(line)


@pytest.fixture(autouse=True)
def device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(palette2.serial, "Serial", Device)


def connected(s: BusSession) -> Device:
    s.gcode.run_script("PALETTE_CONNECT")
    assert "Palette 2 is connected" in s.lines[-1]
    Device.instance.lines.clear()
    return Device.instance


def ran(s: BusSession) -> list[str]:
    return [line.removeprefix("echo: ").strip() for line in s.lines if line.startswith("echo: ")]


def test_the_palette_gets_header_splices_and_algorithms_as_it_asks(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        header = [f"O{number} D{number:04x}" for number in range(21, 30)]
        s.gcode.run_script("\n".join([*header, "O30 D0 D41200000", "O30 D1 D42200000", "O32 D00 D1 D2 D3"]))
        assert palette.lines == [], "kept until it asks"
        s.gcode.run_script("O1 Dcube D00000000")
        assert palette.lines == ["O1 Dcube D00000000"]
        for wanted in ("D0", "D0", "D4", "D1", "D1", "D8"):
            palette.say(f"O20 {wanted}")
        s.sleep(0.2)
        assert palette.lines[1:] == [
            header[0], header[1], "O32 D00 D1 D2 D3", "O30 D0 D41200000", "O30 D1 D42200000", "O30 D1 D42200000",
        ]  # fmt: skip
        palette.say("O40")
        s.sleep(0.2)
        assert "RESUME" in ran(s)

    run(tmp_path, CONFIG + MACROS, body)


def test_the_feed_is_slower_while_it_splices(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        palette.say("O97 U25 D0 D1")
        s.sleep(0.2)
        assert s.status("palette2")["is_splicing"] and ran(s)[-1] == "M220 S80"
        palette.say("O97 U25 D1")
        s.sleep(0.2)
        assert not s.status("palette2")["is_splicing"] and ran(s)[-1] == "M220 S100"

    run(tmp_path, CONFIG + MACROS, body)


def test_pings_are_announced_kept_and_may_cancel(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        s.gcode.run_script("O31 D3f000000")
        assert palette.lines == ["O31"]
        palette.say("O20 D2")
        palette.say("O34 D1 D98.5 D1")
        s.sleep(0.2)
        assert palette.lines[1:] == ["O31 D3f000000"]
        assert s.status("palette2")["ping"] == 98.5 and "CANCEL_PRINT" not in ran(s)
        palette.say("O34 D1 D85 D2")
        s.sleep(0.2)
        assert ran(s)[-1] == "CANCEL_PRINT"

    run(tmp_path, CONFIG + MACROS, body)


def test_smart_load_extrudes_what_is_left(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        palette.say("O97 U39 D-12")
        s.sleep(0.2)
        assert s.status("palette2")["remaining_load_length"] == 12
        s.gcode.run_script("PALETTE_SMART_LOAD")
        assert [line for line in ran(s) if line.startswith("G1")] == [
            "G1 E5 F120",
            "G1 E5 F120",
            "G1 E2 F120",
        ]
        assert palette.lines[-1] == "O102 D1"

    run(tmp_path, CONFIG + MACROS, body)


def test_cut_and_clear_are_the_makers_lines(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        s.gcode.run_script("PALETTE_CUT\nPALETTE_CLEAR")
        assert palette.lines[:2] == ["O10 D5", "O10 D5"] and len(palette.lines) == 7

    run(tmp_path, CONFIG + MACROS, body)


def test_a_palette_that_falls_silent_is_reported(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        s.sleep(30.0)
        assert not any("no heartbeat" in line for line in s.lines)
        palette.is_silent = True
        s.sleep(20.0)
        assert any("[palette2]: no heartbeat" in line for line in s.lines)
        with pytest.raises(s.printer.command_error, match="PALETTE_CONNECT first"):
            s.gcode.run_script("PALETTE_CUT")

    run(tmp_path, CONFIG + MACROS, body)


def test_errors_and_pauses_of_the_palette_pause_the_print(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        palette = connected(s)
        palette.say("O88 D1f")
        palette.say("garbage")
        palette.say("O100")
        s.sleep(0.2)
        assert any("error 1f of the Palette" in line for line in s.lines)
        assert ran(s).count("PAUSE") == 2

    run(tmp_path, CONFIG + MACROS, body)


def test_a_port_without_a_palette_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(Device):
        def write(self, data: bytes) -> None:
            pass

    monkeypatch.setattr(palette2.serial, "Serial", Silent)

    def body(s: BusSession) -> None:
        with pytest.raises(s.printer.command_error, match="No Palette 2 answers at /dev/palette"):
            s.gcode.run_script("PALETTE_CONNECT")

    run(tmp_path, CONFIG + MACROS, body)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[palette2]\n", ("serial", "palette2")),
        ("[palette2]\nserial: x\nauto_cancel_variation: 0.5\n", ("auto_cancel_variation", "line 3", "0.2")),
        ("[palette2]\nserial: x\nfeedrate_splice: 2\n", ("feedrate_splice", "line 3")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
