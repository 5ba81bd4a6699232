"""The consoles and the log reader, as people use them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from console import ConsoleError, evaluate
from log_extract import extract, read_stats, story
from moonraker_rig import ROOT, SimulatedPrinter
from simulation.printer_data import PrinterData


def run(script: str, *arguments: str | Path, text: str = "") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / script), *map(str, arguments)]
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=60, check=False)


# --- console.py ---
def test_expressions_are_arithmetic_and_nothing_else() -> None:
    assert evaluate("2 * (x + 1) // 3", {"x": 5}) == 4
    assert evaluate("max(1, int(7 / 2)) | 4", {}) == 7
    for text in ("__import__('os')", "x.__class__", "open", "[1]", "'a'", "1 +", "1 / 0", "9 ** 9"):
        with pytest.raises(ConsoleError):
            evaluate(text, {"x": 1})


def test_the_mcu_console_talks_to_a_board(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    simulator = subprocess.Popen(
        [sys.executable, ROOT / "scripts" / "run_simulator.py", ROOT / "config" / "sim-induction.cfg",
         "--pty", path, "--until", "30"],
        stdout=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert simulator.stdout is not None
        simulator.stdout.readline()
        lines = [
            "LIST uptime", "get_uptime", "SET x 5*3", "EVAL x + CLOCK_FREQ", "get_config", "no_such_command",
            "get_clock extra=1", "EVAL nobody", "WAIT 0.3", "QUIET uptime", "get_uptime", "STATS", "HELP",
            "QUIT", "get_uptime",
        ]  # fmt: skip
        done = run("console.py", path, text="\n".join(lines) + "\n")
    finally:
        simulator.terminate()
        simulator.wait(10)
    assert done.returncode == 0, done.stderr
    assert "Connected to simulator" in done.stdout
    assert "response  uptime high=%u clock=%u" in done.stdout
    assert done.stdout.count(": uptime high=") == 1
    assert "72000015" in done.stdout
    assert "config is_config=0" in done.stdout
    assert "Error: Unknown command: no_such_command" in done.stdout
    assert "'nobody' is no constant" in done.stdout
    assert "bytes_write=" in done.stdout
    assert "Traceback" not in done.stderr


def test_no_board_is_reported_in_a_line(tmp_path: Path) -> None:
    done = run("gcode_console.py", tmp_path / "none.sock")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no host at" in done.stderr


def test_a_terminal_without_a_name_is_a_terminal(tmp_path: Path) -> None:
    """TERM is not set; the console is typed into and shows a progress bar all the same."""
    environment = {name: value for name, value in os.environ.items() if name != "TERM"}
    (tmp_path / "part.gcode").write_text("G4 P2000\n")
    config = str(ROOT / "config" / "sim-induction.cfg")
    for script, shown in (
        (["simulate.py", config, str(tmp_path / "part.gcode")], b"simulated in"),
        (["console.py", str(tmp_path / "tty")], b"Ctrl-C ends the program"),
    ):
        keyboard, terminal = os.openpty()
        command = [sys.executable, str(ROOT / "scripts" / script[0]), *script[1:]]
        program = subprocess.Popen(command, env=environment, stdin=terminal, stdout=terminal, stderr=terminal)
        os.close(terminal)
        said = read_terminal(keyboard, shown)
        if script[0] == "console.py":  # waits for a board
            program.send_signal(signal.SIGINT)
        said += read_terminal(keyboard, b"never")
        assert b"Traceback" not in said and shown in said, said
        os.close(keyboard)
        assert program.wait(20) in (0, 130)


def read_terminal(keyboard: int, wanted: bytes) -> bytes:
    """What a program shows until it shows this, or ends."""
    said = b""
    while wanted not in said:
        try:
            said += os.read(keyboard, 4096)
        except OSError:  # nobody has the terminal open any more
            break
    return said


# --- gcode_console.py and log_extract.py ---
def test_the_gcode_console_and_the_story_of_its_log(tmp_path: Path) -> None:
    with SimulatedPrinter(tmp_path / "data", "--speed", "10", moonraker=False) as printer:
        printer.wait("ready", lambda: "ready:" in printer.output, 60.0)
        done = run("gcode_console.py", printer.socket_path, text="M117 hi\nM104 S150\nG4 P3000\nG1 X5\n")
        assert done.returncode == 1, "the last line fails: not homed"
        assert "!! Must home axis first" in done.stdout
        assert done.stdout.splitlines()[-1].startswith("ready | ")
        assert "extruder 1" in done.stdout
        done = run("gcode_console.py", printer.socket_path, text="M112\n")
        assert "// Klipper state: Shutdown" in done.stdout
        assert printer.stop() == 0
    log = printer.data / "logs" / "klippy.log"
    done = run("log_extract.py", log, "--config", tmp_path / "found", "--plot", tmp_path / "p.png")
    assert done.returncode == 0, done.stderr
    assert "ERROR     error: Transition to shutdown state: Shutdown due to M112" in done.stdout
    assert "warning: Must home axis first" in done.stdout
    assert "extruder.temp" in done.stdout
    assert "[stepper_x]" in (tmp_path / "found" / "config-1.cfg").read_text()
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_statistics_are_read_by_group() -> None:
    text = "gcodein=0 mcu: srtt=0.001 x=a extruder: target=200 temp=199.5 sd_pos=7 sysload=0.5"
    assert dict(read_stats(text)) == {
        "gcodein": 0.0, "mcu.srtt": 0.001, "extruder.target": 200.0, "extruder.temp": 199.5,
        "sd_pos": 7.0, "sysload": 0.5,
    }  # fmt: skip


def test_the_story_counts_what_repeats() -> None:
    found = extract(["Stats 5.0: a: temp=1\n", "warning: x\n", "warning: x\n", "noise\n", "error: y\n"])
    text = story(found)
    assert "warning: x (2 times)" in text
    assert "error: y" in text
    assert "noise" not in text


# --- printer_data.py ---
def test_a_config_with_includes_is_copied_with_its_own_paths(tmp_path: Path) -> None:
    folder = PrinterData(tmp_path / "data", ROOT)
    folder.prepare(ROOT / "config" / "sim-two-mcu.cfg")
    main = folder.config.read_text()
    included = (folder.config.parent / "sim-induction.cfg").read_text()
    assert f"serial: {folder.root}/comms/mcu_heater" in main
    assert f"serial: {folder.root}/comms/mcu\n" in included
    assert f"path: {folder.gcodes}" in included
    # all else is as it was written, comments too
    original = (ROOT / "config" / "sim-induction.cfg").read_text().splitlines()
    changed = [line for line, old in zip(included.splitlines(), original, strict=True) if line != old]
    assert len(changed) == 2


@pytest.mark.parametrize(
    ("own", "added"),
    [
        ("", {"PAUSE", "RESUME", "CANCEL_PRINT", "PARK_NOZZLE"}),
        ("[gcode_macro pause]\nrename_existing: BASE_PAUSE\ngcode:\n  BASE_PAUSE\n", {"CANCEL_PRINT", "PARK_NOZZLE"}),
        (f"[include {ROOT}/config/macros-induction.cfg]\n[pause_resume]\n", set()),
    ],
    ids=["none", "its own pause", "all of them"],
)  # fmt: skip
def test_a_config_gets_the_macros_that_it_lacks(tmp_path: Path, own: str, added: set[str]) -> None:
    """A PAUSE of its own is not joined by a RESUME that would not fit."""
    source = tmp_path / "my.cfg"
    source.write_text(own + "[printer]\nkinematics: none\n[gcode_macro START_PRINT]\ngcode:\n  G28\n")
    folder = PrinterData(tmp_path / "data", ROOT)
    folder.prepare(source)
    text = (folder.config.parent / "frontend.cfg").read_text()
    macros = set(re.findall(r"(?m)^\[gcode_macro (\S+)\]", text))
    assert macros & {"PAUSE", "RESUME", "CANCEL_PRINT", "PARK_NOZZLE"} == added
    assert "START_PRINT" not in macros
