"""scripts/run_printer.py without Moonraker: the data folder, restarts, SAVE_CONFIG, the two-process form."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from moonraker_rig import ROOT, START_TIMEOUT_S, SimulatedPrinter
from unit.host.test_webhooks import Client

Start = Callable[..., SimulatedPrinter]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """start(*options): a printer that is ended with the test."""
    with ExitStack() as machines:
        yield lambda *options: machines.enter_context(
            SimulatedPrinter(tmp_path / "data", *options, moonraker=False)
        )


def connect(machine: SimulatedPrinter, state: str = "ready", not_pid: int = 0) -> Client:
    """A client of a host in that state (of another process than `not_pid`)."""
    deadline = time.monotonic() + START_TIMEOUT_S / 2
    while time.monotonic() < deadline:
        assert machine.process.poll() is None, machine.output
        try:
            client = Client(str(machine.socket_path))
            info = client.result("info")
            if info["state"] == state and info["process_id"] != not_pid:
                return client
        except OSError:
            pass
        time.sleep(0.05)
    raise AssertionError(f"no host in state {state}:\n{machine.output}\n{machine.log('klippy.log')[-2000:]}")


def query(client: Client, name: str) -> dict[str, Any]:
    status: dict[str, Any] = client.result("objects/query", objects={name: None})["status"][name]
    return status


def wait(what: str, condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def test_an_edited_config_is_kept_byte_for_byte(start: Start) -> None:
    machine = start("--speed", "5")
    client = connect(machine)
    path = machine.data / "config" / "printer.cfg"
    before = path.read_text()
    assert str(machine.data / "gcodes") in (machine.data / "config" / "printer.cfg").read_text()
    path.write_text(before.replace("pid_Kp: 60", "pid_Kp: 61"))
    client.result("gcode/script", script="RESTART")
    client = connect(machine)
    assert query(client, "configfile")["settings"]["heater_bed"]["pid_kp"] == 61.0
    assert path.read_text() == before.replace("pid_Kp: 60", "pid_Kp: 61")
    assert machine.stop(signal.SIGINT) == 0
    assert not machine.socket_path.exists()
    assert "Traceback" not in machine.log("klippy.log")
    # the next start keeps the file
    again = start("--speed", "5")
    assert query(connect(again), "configfile")["settings"]["heater_bed"]["pid_kp"] == 61.0
    assert "kept as it is" in again.output


def test_restarts_keep_the_machine_as_it_is(start: Start) -> None:
    machine = start("--speed", "10")
    client = connect(machine)
    client.result("gcode/script", script="M104 S150")
    wait("heat", lambda: query(client, "extruder")["temperature"] > 140.0)
    for command in ("RESTART", "FIRMWARE_RESTART"):
        client.result("gcode/script", script=command)
        wait(f"{command} to close the socket", functools.partial(is_closed, client))
        client = connect(machine)
        assert query(client, "extruder")["target"] == 0.0
        assert query(client, "toolhead")["homed_axes"] == ""
    assert machine.process.poll() is None


def is_closed(client: Client) -> bool:
    try:
        client.result("info")
    except OSError:
        return True
    return False


def test_a_host_killed_beside_its_machine_comes_back(start: Start) -> None:
    """--separate: the machine stays on, hot and configured; its own watchdog has switched the coil off."""
    machine = start("--separate")
    client = connect(machine)
    pid = client.result("info")["process_id"]
    client.result("gcode/script", script="M104 S200")
    wait("heat", lambda: query(client, "extruder")["temperature"] > 150.0)
    os.kill(pid, signal.SIGKILL)
    # the MCU turned the coil off when no command came for 100 ms; the new host resets it by itself
    client = connect(machine, not_pid=pid)
    assert (
        "Attempting automated MCU 'mcu' restart: it was configured by another run of the host"
        in machine.log("klippy.log")
    )
    assert query(client, "extruder")["target"] == 0.0
    assert "host ended with status -9" in machine.output
    assert "Traceback" not in machine.log("klippy.log")
    assert machine.stop() == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--speed", "0"], "--speed must be"),
        (["--separate", "--speed", "2"], "real time only"),
        (["--config", "/nonexistent.cfg"], "Unable to open config file"),
        (["--data", str(ROOT / "out" / "here")], "outside of the program's folder"),
        (["--data", "/tmp/" + "x" * 100], "too long for a socket"),
    ],
)
def test_wrong_use_is_reported_in_a_line(tmp_path: Path, options: list[str], words: str) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "run_printer.py"), "--no-moonraker"]
    if "--data" not in options:
        command += ["--data", str(tmp_path / "data")]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
