"""The host as a program: exit status, messages, terminal, restart."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simulation import world as world_module

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = [sys.executable, str(ROOT / "klippy" / "klippy.py")]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PROGRAM, *arguments], capture_output=True, text=True, timeout=30, check=False)


def test_help_names_the_options() -> None:
    answer = run("-h")
    assert answer.returncode == 0
    for option in ("-i", "-I", "-a", "-l", "-v", "-o", "-d"):
        assert option in answer.stdout


def test_batch_mode_with_a_broken_config_says_why_and_fails(tmp_path: Path) -> None:
    config, source, log = tmp_path / "printer.cfg", tmp_path / "in.gcode", tmp_path / "log"
    config.write_text("[display_status]\nx: 1\n[mcu\n")
    source.write_text("G28\n")
    answer = run(str(config), "-i", str(source), "-l", str(log))
    assert answer.returncode == 255
    assert "'[mcu' in the config (printer.cfg, line 3)" in answer.stderr
    assert "Traceback" not in answer.stderr
    assert "line 3" in log.read_text()


def test_a_print_from_the_storage_goes_to_its_end_in_batch_mode(tmp_path: Path) -> None:
    """The input ends right after the command that starts it."""
    world_module.build()
    lines = [
        "G28",
        *(f"G1 X{n % 90 + 1} Y{n % 37 + 1} F6000" for n in range(3000)),
        "G1 X77 Y11",
        "M118 the end",
    ]
    (tmp_path / "part.gcode").write_text("\n".join(lines))
    config = f"[include {ROOT}/config/example-cartesian.cfg]\n[respond]\n[virtual_sdcard]\npath: {tmp_path}\n"
    (tmp_path / "printer.cfg").write_text(config)
    (tmp_path / "in.gcode").write_text("SDCARD_PRINT_FILE FILENAME=part.gcode\n")
    done = run(
        str(tmp_path / "printer.cfg"), "-i", str(tmp_path / "in.gcode"), "-o", str(tmp_path / "out"),
        "-d", str(world_module.MCU_DICTIONARY), "-l", str(tmp_path / "log"),
    )  # fmt: skip
    log = (tmp_path / "log").read_text()
    assert done.returncode == 0, log[-2000:]
    end = f"Exiting SD card print (position {(tmp_path / 'part.gcode').stat().st_size})"
    assert log.index(end) < log.index("Exiting (print time")


def test_missing_files_are_named(tmp_path: Path) -> None:
    answer = run(str(tmp_path / "none.cfg"), "-i", str(tmp_path / "none.gcode"))
    assert answer.returncode == 255
    assert f"No such file or directory: {tmp_path}/none.gcode" in answer.stderr
    source = tmp_path / "in.gcode"
    source.write_text("")
    answer = run(str(tmp_path / "none.cfg"), "-i", str(source))
    assert answer.returncode == 255
    assert f"Unable to open config file {tmp_path}/none.cfg" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_a_python_without_the_packages_is_reported_how_to_get_them() -> None:
    """As `python3 klippy/klippy.py` with the system's Python; -S: no packages."""
    command = [sys.executable, "-S", str(ROOT / "klippy" / "klippy.py"), "printer.cfg"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1 and "run `make setup`" in answer.stderr


@pytest.mark.parametrize("program", ["simulate", "demo", "study", "console", "check_config"])
def test_a_program_without_its_packages_names_one_and_how_to_get_it(program: str) -> None:
    command = [sys.executable, "-S", str(ROOT / "scripts" / f"{program}.py"), "x", "y"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1 and "is missing; `make setup` installs it" in answer.stderr


def read_until(fd: int, wanted: bytes, limit_s: float = 20.0) -> bytes:
    """What comes from the terminal until `wanted` was seen."""
    got = b""
    end = time.monotonic() + limit_s
    while wanted not in got:
        assert time.monotonic() < end, f"no {wanted!r} in {got!r}"
        try:
            got += os.read(fd, 4096)
        except BlockingIOError:
            time.sleep(0.02)
    return got


def wait_for_text(path: Path, wanted: str, limit_s: float = 20.0) -> None:
    end = time.monotonic() + limit_s
    while not path.exists() or wanted not in path.read_text():
        assert time.monotonic() < end, f"'{wanted}' did not appear in {path.name}"
        time.sleep(0.02)


def test_terminal_restart_and_end(tmp_path: Path) -> None:
    config, log, terminal = tmp_path / "printer.cfg", tmp_path / "log", tmp_path / "tty"
    config.write_text("[nonsense]\n")
    program = subprocess.Popen(
        [*PROGRAM, str(config), "-I", str(terminal), "-l", str(log)], stderr=subprocess.PIPE
    )
    try:
        wait_for_text(log, "must be specified")  # [printer] is missing
        fd = os.open(terminal, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY)
        os.write(fd, b"G28\n")
        assert b"!! " in read_until(fd, b"ok\n")
        config.write_text("[other nonsense]\nx\n")
        os.write(fd, b"RESTART\n")
        wait_for_text(log, "Unable to understand the line 'x'")
        os.write(fd, b"M115\n")
        version = (ROOT / "VERSION").read_text().strip()
        assert f"FIRMWARE_VERSION:{version}".encode() in read_until(fd, b"HOST_NAME")
        os.close(fd)
        program.send_signal(signal.SIGTERM)
        assert program.wait(10) == 0
    finally:
        program.kill()
        program.communicate()


def test_a_host_that_waits_for_its_board_says_so_and_how_to_end_it(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"
    config.write_text(
        "[mcu]\nserial: /dev/no-board\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n"
    )
    program = subprocess.Popen(
        [*PROGRAM, str(config), "-I", str(tmp_path / "tty")], stderr=subprocess.PIPE, text=True
    )
    try:
        assert program.stderr is not None
        line = program.stderr.readline()
        assert "for the board at /dev/no-board (Ctrl-C ends the program)" in line
        assert "there is no such device" in line
        program.send_signal(signal.SIGINT)
        assert program.wait(10) == 0
        assert "Traceback" not in program.stderr.read()
    finally:
        program.kill()
        program.communicate()


def test_ctrl_c_in_batch_mode_says_that_the_file_was_not_run_to_its_end(tmp_path: Path) -> None:
    world_module.build()
    source, out = tmp_path / "in.gcode", tmp_path / "out"
    source.write_text("G28\n" + "G1 X10 F6000\nG1 X100\n" * 200_000)
    config = ROOT / "config" / "example-cartesian.cfg"
    command = [*PROGRAM, config, "-i", source, "-o", out, "-d", world_module.MCU_DICTIONARY]
    program = subprocess.Popen([str(word) for word in command], stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 20.0
        while not out.exists() or out.stat().st_size < 100_000:
            assert time.monotonic() < end
            time.sleep(0.02)
        program.send_signal(signal.SIGINT)
        assert program.communicate(timeout=10)[1] == f"klippy.py: interrupted before the end of {source}\n"
        assert program.returncode == 130
    finally:
        program.kill()


def test_ctrl_c_while_modules_are_loaded_leaves_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "greenlet.py").write_text("import time\nprint('loading', flush=True)\ntime.sleep(20)\n")
    program = subprocess.Popen(
        [*PROGRAM, "none.cfg"], env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout is not None and program.stdout.readline() == "loading\n"
    program.send_signal(signal.SIGINT)
    assert program.communicate(timeout=10)[1] == ""
    assert program.returncode == -signal.SIGINT
