"""INDUCTION_DUMP, and other readers of an induction heater's blocks: none of them stands in control's way."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import pytest

from extras.outputs import output_file
from heater_fakes import CommandError, FakeCommand, FakePrinter
from nozzle_rig import deliver, machine
from thermal.records import PhaseCommand
from thermal.sensing.blocks import Blocks


class Printer:
    """A hot nozzle whose log lies in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.fake: FakePrinter = machine(log_file=str(folder / "klippy.log"))
        self.heater: Any = self.fake.load("extruder")
        self.fake.mcu.configure()
        self.fake.send("klippy:connect")
        self.fake.send("klippy:ready")
        self._sequence = 0
        self.run(1)
        self.heater.set_temp(250.0)
        self.lines: list[str] = self.fake.gcode.lines

    def run(self, messages: int) -> int:
        """So many messages of two blocks; how many of them brought new commands."""
        steps = 0
        for _ in range(messages):
            self.fake.reactor.now_s += 0.010
            decided_s = self.heater.loop.state.decided_s
            deliver(self.fake, self._sequence, 200.0, 2012)
            self._sequence += 2
            steps += self.heater.loop.state.decided_s > decided_s
        return steps

    def dump(self, **params: str) -> None:
        command: Any = FakeCommand(self.fake.gcode, **params)
        self.fake.gcode.mux["INDUCTION_DUMP", "nozzle"](command)


@pytest.fixture
def printer(tmp_path: Path) -> Printer:
    return Printer(tmp_path)


def test_a_dump_holds_every_block_and_ends_by_itself(printer: Printer, tmp_path: Path) -> None:
    printer.dump(DURATION="0.1")
    assert printer.lines == [f"// Writing 0.1 s of raw blocks to {tmp_path}/induction-nozzle-dump.csv"]
    printer.run(20)
    with (tmp_path / "induction-nozzle-dump.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    # to the first block after 0.1 s, which come 0.02 s late
    assert 20 <= len(rows) <= 26 and float(rows[-1]["time"]) - float(rows[0]["time"]) < 0.13
    assert printer.heater.loop.listeners == []


def test_one_dump_after_the_other_keeps_both(printer: Printer, tmp_path: Path) -> None:
    for _ in range(2):
        printer.dump(DURATION="0.01")
        printer.run(5)
    assert {p.name for p in tmp_path.iterdir()} == {
        "induction-nozzle-dump.csv",
        "induction-nozzle-dump-2.csv",
    }


@pytest.mark.parametrize("name", ["../printer.cfg", "/dev/full", "~/x.csv"])
def test_a_dump_is_refused_where_files_of_commands_do_not_belong(
    printer: Printer, tmp_path: Path, name: str
) -> None:
    with pytest.raises(CommandError, match=f"INDUCTION_DUMP: '{name}' is not in {tmp_path}"):
        printer.dump(FILE=name)
    assert printer.heater.loop.listeners == []
    printer.dump()  # nothing is half begun


@pytest.mark.parametrize("duration_s", [0.05, 30.0])
def test_a_full_disk_ends_the_dump_and_not_the_heating(
    printer: Printer, monkeypatch: pytest.MonkeyPatch, duration_s: float
) -> None:
    """The short one finds out when its file is closed, the long one while it writes."""

    def full(folder: Path, name: str) -> TextIO:
        return open("/dev/full", "w", encoding="utf-8")

    monkeypatch.setattr(output_file, "open_new", full)
    printer.dump(DURATION=str(duration_s))
    assert printer.run(300) == 300
    assert printer.lines[1:] == [
        "// INDUCTION_DUMP ended: /dev/full cannot be written: No space left on device"
    ]
    assert printer.heater.loop.listeners == []
    monkeypatch.undo()
    printer.dump()  # another one may begin


def failing(seen: list[float]) -> Callable[..., None]:
    def listener(block: Any, found: Any, now_s: float) -> None:
        seen.append(now_s)
        raise RuntimeError("no more paper")

    return listener


def test_a_reader_of_blocks_that_fails_is_dropped_and_named_once(printer: Printer) -> None:
    failed: list[float] = []
    read: list[float] = []
    printer.heater.loop.listeners.append(failing(failed))
    printer.heater.loop.listeners.append(lambda block, found, now_s: read.append(found.temp_c))
    assert printer.run(50) == 50
    assert len(failed) == 1 and len(read) == 100
    assert printer.lines == [
        "// Induction heater 'nozzle': what read its blocks failed and gets no more: no more paper"
    ]
    assert printer.heater.loop.state.request.power_w > 80.0


class Driver:
    """Something that has taken the loop's place, as a calibration does."""

    over = False

    def __init__(self) -> None:
        self.blocks = 0

    def on_blocks(self, blocks: Blocks, now_s: float) -> list[PhaseCommand]:
        self.blocks += blocks.count
        return []

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        return []

    def abort(self, reason: str) -> None:
        pass


def test_a_reader_that_fails_does_not_disturb_a_calibration(printer: Printer) -> None:
    driver = Driver()
    printer.heater.set_temp(0.0)
    printer.heater.acquire(driver)
    printer.heater.loop.listeners.append(failing([]))
    printer.run(5)
    assert driver.blocks == 10
    assert len(printer.lines) == 1 and "no more paper" in printer.lines[0]
