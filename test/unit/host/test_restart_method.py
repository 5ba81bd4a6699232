"""How a board is reset from outside: by the lines of its serial port, by the power of its USB port."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import serial

from doc_rig import load
from link import serialport, usb_power
from reactor import Reactor


class Device:
    """A serial port that notes what happens to its lines."""

    def __init__(self) -> None:
        object.__setattr__(self, "log", [])

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("dtr", "rts"):
            self.log.append((name, value))

    def open(self) -> None:
        self.log.append("open")

    def fileno(self) -> int:
        return os.open(os.devnull, os.O_RDWR)

    def close(self) -> None:
        pass


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device()
    monkeypatch.setattr(serial, "serial_for_url", lambda path, do_not_open: made)
    monkeypatch.setattr(serialport.time, "sleep", made.log.append)
    return made


def test_a_cheetah_is_opened_without_rts_and_reset_twice(device: Device) -> None:
    port = serialport.open_cheetah_port(Reactor(), "socket://x", 250000)
    assert device.log == [("rts", False), "open"]
    del device.log[:]
    port.reset()
    pulse = [("dtr", False), 0.1, ("dtr", True), 0.1]
    assert device.log == [("rts", False), *pulse, *pulse]
    port.close()


def test_an_arduino_gets_one_pulse_of_dtr(device: Device) -> None:
    port = serialport.open_port(Reactor(), "socket://x", 250000)
    port.reset()
    assert device.log == ["open", ("dtr", False), 0.1, ("dtr", True)]
    port.close()


@pytest.fixture
def uhubctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of that name, which notes its arguments."""
    program = tmp_path / "uhubctl"
    program.write_text(
        f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n[ ! -e {tmp_path}/fail ] || {{ echo no hub >&2; exit 1; }}\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


@pytest.mark.parametrize(
    ("model", "calls"),
    [
        ("Raspberry Pi 3 Model B Plus Rev 1.3", ["-a cycle -d 2 -l 1-1 -p 2"]),
        ("Raspberry Pi 4 Model B Rev 1.1", ["-a cycle -d 2 -l 1-1"]),
        ("Raspberry Pi 5 Model B Rev 1.0", ["-a cycle -d 2 -l 1", "-a cycle -d 2 -l 3"]),
    ],
)
def test_usb_power_is_cycled_at_the_hubs_of_the_model(
    uhubctl: Path, monkeypatch: pytest.MonkeyPatch, model: str, calls: list[str]
) -> None:
    (uhubctl / "model").write_text(model + "\0")
    monkeypatch.setattr(usb_power, "MODEL", uhubctl / "model")
    usb_power.cycle()
    assert (uhubctl / "calls").read_text().splitlines() == calls


@pytest.mark.parametrize(
    ("model", "fails", "word"), [("Banana", False, "Banana"), ("Raspberry Pi 4", True, "no hub")]
)
def test_usb_power_that_can_not_be_switched_is_logged(
    uhubctl: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    model: str,
    fails: bool,
    word: str,
) -> None:
    (uhubctl / "model").write_text(model)
    if fails:
        (uhubctl / "fail").touch()
    monkeypatch.setattr(usb_power, "MODEL", uhubctl / "model")
    usb_power.cycle()
    assert word in caplog.text


BASE = "[mcu]\nserial: x\nrestart_method: {}\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n"


@pytest.mark.parametrize("method", ["arduino", "cheetah", "command", "rpi_usb"])
def test_restart_methods_of_klipper_are_known(tmp_path: Path, method: str) -> None:
    assert load(tmp_path, BASE.format(method)).message == "Printer is ready"


def test_another_restart_method_is_refused(tmp_path: Path) -> None:
    message = load(tmp_path, BASE.format("hammer")).message
    assert all(word in message for word in ("restart_method", "mcu", "line 3", "hammer", "cheetah, command"))
