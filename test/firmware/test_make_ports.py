"""make for a chip, as people use it: which port, what is missing, what `make flash` runs, what `make size` says."""

from __future__ import annotations

import hashlib
import json
import os
import pty
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import flash_firmware
from boot_loader import BootLoader

ROOT = Path(__file__).resolve().parents[2]
PORTS = sorted(path.parent.name for path in ROOT.glob("src/*/port.mk"))
# The command line of each port's tool, as the tool's manual has it.
TOOLS = {
    "stm32f334": ["openocd", "-f", "board/st_nucleo_f3.cfg", "-c", "program {out}/ferrite.elf verify reset exit"],
    "atmega2560": ["avrdude", "-p", "atmega2560", "-c", "wiring", "-P", "{device}", "-b", "115200", "-D",
                   "-U", "flash:w:{out}/ferrite.hex:i"],
}  # fmt: skip
RECORDER = '#!/bin/sh\nfor word in "$@"; do echo "$word" >>"$RECORD"; done\nexit ${RECORD_STATUS:-0}\n'


def run_make(*args: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = ["make", "--no-print-directory", "FERRITE_VERSION=test", "KCONFIG_CONFIG=/dev/null", *args]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    return subprocess.run(
        command, cwd=ROOT, env=clean | environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder that every port has been built into."""
    folder = str(tmp_path_factory.mktemp("out"))
    for port in PORTS:
        built = run_make(f"PORT={port}", f"OUT={folder}", "-s", "-j2")
        assert built.returncode == 0, built.stderr
    return folder


# ---------------------------------------------------------------- which port


@pytest.mark.parametrize("target", ["firmware", "flash", "size"])
def test_a_port_that_is_not_there_is_answered_by_those_that_are(target: str) -> None:
    for asked in (["PORT=stm32"], []):
        run = run_make(*asked, target)
        assert run.returncode == 2 and ("There is no port 'stm32'" in run.stderr) == bool(asked)
        assert all(port in run.stderr for port in [*PORTS, "simulator", "menuconfig"])
        assert f"PORT=NAME{'' if target == 'firmware' else ' ' + target} " in run.stderr


@pytest.mark.parametrize("target", ["flash", "size"])
def test_the_simulator_is_no_chip_to_flash_or_weigh(target: str) -> None:
    run = run_make("PORT=simulator", target)
    assert run.returncode == 2 and f"nothing to {target}" in run.stderr


@pytest.mark.parametrize("port", PORTS)
def test_a_compiler_that_is_missing_is_named_with_its_package(port: str, tmp_path: Path) -> None:
    for tool in ("make", "sh", "python3", "mkdir", "cksum", "git"):
        found = shutil.which(tool)
        assert found is not None
        (tmp_path / tool).symlink_to(found)
    run = run_make(f"PORT={port}", f"OUT={tmp_path / 'out'}", PATH=str(tmp_path))
    assert run.returncode == 2
    assert re.search(r"needs \S+-gcc \(Debian: apt-get install \S*gcc", run.stderr), run.stderr


@pytest.mark.parametrize(("term", "words"), [(None, "TERM is ''"), ("no-such", "TERM is 'no-such'")])
def test_a_menu_without_a_terminal_is_answered_in_a_sentence(term: str | None, words: str) -> None:
    ours, theirs = pty.openpty()
    environment = {name: value for name, value in os.environ.items() if name != "TERM"}
    environment |= {"srctree": "src"} | ({} if term is None else {"TERM": term})
    command = [sys.executable, "scripts/build/run_menuconfig.py", "Kconfig"]
    for terminal, wanted in ((theirs, words), (subprocess.DEVNULL, "must be a terminal")):
        run = subprocess.run(
            command, cwd=ROOT, env=environment, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE, text=True,
            check=False,
        )  # fmt: skip
        assert run.returncode == 2 and run.stderr.count("\n") == 1 and wanted in run.stderr
    os.close(ours)
    os.close(theirs)


def test_every_port_can_be_chosen_in_the_menu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import kconfiglib

    monkeypatch.setenv("srctree", str(ROOT / "src"))
    for port in PORTS:
        config, file = kconfiglib.Kconfig("Kconfig"), tmp_path / port
        config.syms[f"PORT_IS_{port.upper()}"].set_value("y")
        config.write_config(str(file))
        run = run_make("-n", f"KCONFIG_CONFIG={file}", f"OUT={tmp_path}")
        assert f"-Isrc/{port} " in run.stdout and f"{tmp_path}/{port}/ferrite.elf" in run.stdout
    assert {symbol.name for symbol in config.choices[0].syms} == {
        f"PORT_IS_{port.upper()}" for port in [*PORTS, "simulator"]
    }


@pytest.mark.parametrize("port", PORTS)
def test_two_builds_in_two_places_are_one_image(port: str, out: str, tmp_path: Path) -> None:
    """Nothing of time or place gets into it, debug data included."""
    again = tmp_path / "another" / "place"
    built = run_make(f"PORT={port}", f"OUT={again}", "-s", "-j2")
    assert built.returncode == 0, built.stderr
    images = sorted(path.name for path in (again / port).glob("ferrite.*") if path.suffix != ".map")
    assert len(images) == 3  # linked file, what is flashed, dictionary
    for name in images:
        one, other = ((folder / port / name).read_bytes() for folder in (Path(out), again))
        assert hashlib.sha256(one).digest() == hashlib.sha256(other).digest(), name


# ---------------------------------------------------------------- make flash


@pytest.mark.parametrize("port", PORTS)
def test_flash_runs_the_boards_tool_on_the_image(port: str, out: str, tmp_path: Path) -> None:
    record, device = tmp_path / "record", tmp_path / "ttyACM7"
    device.touch()
    tool = tmp_path / TOOLS[port][0]
    tool.write_text(RECORDER)
    tool.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    asked = (f"PORT={port}", f"OUT={out}", f"FLASH_DEVICE={device}", "flash")
    run = run_make(*asked, PATH=path, RECORD=str(record))
    assert run.returncode == 0, run.stderr
    wanted = [word.format(out=f"{out}/{port}", device=device) for word in TOOLS[port][1:]]
    assert record.read_text().splitlines() == wanted
    failed = run_make(*asked, PATH=path, RECORD=str(record), RECORD_STATUS="3")
    assert failed.returncode == 2 and f"{tool.name} has not written the board" in failed.stderr


@pytest.mark.parametrize("tool", ["openocd", "avrdude"])
def test_a_tool_that_is_missing_is_named_with_its_package(
    tool: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert flash_firmware.main([tool, "-v"]) == 1
    assert f"apt-get install {tool}" in capsys.readouterr().err


def test_a_port_without_a_board_is_answered_by_those_that_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert flash_firmware.main(["--device", str(tmp_path / "ttyACM0"), "sh", "-c", "true"]) == 1
    assert "FLASH_DEVICE=" in capsys.readouterr().err
    by_id = tmp_path / "dev/serial/by-id"
    assert flash_firmware.serial_ports(tmp_path) == []
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/ttyUSB0").touch()
    assert flash_firmware.serial_ports(tmp_path) == [str(tmp_path / "dev/ttyUSB0")]
    by_id.mkdir(parents=True)
    (by_id / "usb-Arduino_Mega").touch()
    assert flash_firmware.serial_ports(tmp_path) == [str(by_id / "usb-Arduino_Mega")]


@pytest.fixture
def loader(request: pytest.FixtureRequest) -> Iterator[BootLoader]:
    board = BootLoader(breaks=getattr(request, "param", False))
    yield board
    board.close()


@pytest.mark.flash
def test_avrdude_itself_writes_and_compares_every_byte(loader: BootLoader, out: str, tmp_path: Path) -> None:
    run = run_make("PORT=atmega2560", f"OUT={out}", f"FLASH_DEVICE={loader.path}", "flash")
    assert run.returncode == 0, run.stderr
    plain = tmp_path / "image"
    command = ["avr-objcopy", "-O", "binary", "-R", ".eeprom", f"{out}/atmega2560/ferrite.elf", str(plain)]
    subprocess.run(command, check=True)
    image = plain.read_bytes()
    assert len(image) > 20_000 and loader.flash[: len(image)] == image
    assert set(loader.flash[len(image) + 256 :]) == {0xFF}
    assert 0x14 in loader.commands and 0x12 not in loader.commands  # compared; no erasing of the whole chip


@pytest.mark.flash
@pytest.mark.parametrize("loader", [True], indirect=True)
def test_a_board_that_keeps_something_else_is_found_out(loader: BootLoader, out: str) -> None:
    run = run_make("PORT=atmega2560", f"OUT={out}", f"FLASH_DEVICE={loader.path}", "flash")
    assert run.returncode == 2 and "avrdude has not written the board" in run.stderr


@pytest.mark.flash
def test_openocd_itself_takes_the_command_and_looks_for_the_debugger(out: str) -> None:
    """Board file and commands are read; here is no ST-LINK, which it says."""
    run = run_make("PORT=stm32f334", f"OUT={out}", "flash")
    assert (
        run.returncode == 2 and "Error: open failed" in run.stderr and "in procedure 'program'" in run.stderr
    )
    assert "openocd has not written the board" in run.stderr


# ---------------------------------------------------------------- make size


@pytest.mark.parametrize("port", PORTS)
def test_size_reports_budget_change_and_stack(port: str, out: str) -> None:
    run = run_make(f"PORT={port}", f"OUT={out}", "size")
    assert run.returncode == 0, run.stdout + run.stderr
    record = json.loads((ROOT / "src" / port / "size.json").read_text())
    for name in ("flash", "ram"):
        row = next(line for line in run.stdout.splitlines() if line.split()[:1] == [name])
        value, budget, last, change = (int(word) for word in row.split()[1:])
        assert 0 < value <= budget == record["budget"][name]
        assert last == record["release"][name] and change == value - last
    used, space = (
        int(n) for n in re.findall(r"stack used in emulation at most (\d+) of (\d+)", run.stdout)[0]
    )
    assert 0.2 * space < used <= 0.75 * space
