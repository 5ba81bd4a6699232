"""Fans and output pins: values on the MCU pin over time."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from base_rig import Session
from bus_rig import RigPin
from gcode import CommandError


class FakeMcu:
    """A chip whose clock is the reactor's."""

    def __init__(self) -> None:
        self.pins: dict[str, RigPin] = {}

    def setup_pin(self, kind: str, params: dict[str, Any]) -> RigPin:
        pin = self.pins[params["pin"]] = RigPin(self, kind, 0)
        return pin

    def estimated_print_time(self, eventtime: float) -> float:
        return eventtime


class FakeToolhead:
    """Look-ahead whose next move begins at `print_time`."""

    def __init__(self) -> None:
        self.print_time = 200.0

    def register_lookahead_callback(self, callback: Any) -> None:
        callback(self.print_time)

    def get_last_move_time(self) -> float:
        return self.print_time

    def get_status(self, eventtime: float) -> dict[str, float]:
        return {"print_time": self.print_time, "estimated_print_time": eventtime}


def fan_session(tmp_path: Path, config: str) -> tuple[Session, FakeMcu, FakeToolhead]:
    """A printer whose section [respond] (loaded first) is preceded by a fake MCU and toolhead."""
    session = Session(tmp_path, config)
    mcu, toolhead = FakeMcu(), FakeToolhead()
    load = session.printer.load_object

    def with_chip(config: Any, section: str, *default: Any) -> Any:
        pins = session.printer.lookup_object("pins")
        if "mcu" not in pins.chips:
            pins.register_chip("mcu", mcu)
            session.printer.add_object("toolhead", toolhead)
        return load(config, section, *default)

    session.printer.load_object = with_chip  # type: ignore[method-assign]
    return session, mcu, toolhead


def fan_log(tmp_path: Path, options: str, *commands: tuple[float, str]) -> list[tuple[float, float]]:
    """Pin values after commands given at print times."""
    session, mcu, toolhead = fan_session(tmp_path, f"[fan]\npin: PA1\n{options}")

    def body(s: Session) -> None:
        for print_time, command in commands:
            toolhead.print_time = print_time
            s.gcode.run_script(command)
        s.sleep(200.0)

    session.run(body)
    return mcu.pins["PA1"].log


def test_fan_follows_the_moves(tmp_path: Path) -> None:
    log = fan_log(tmp_path, "kick_start_time: 0\n", (200.0, "M106 S127.5"), (201.0, "M106"), (202.5, "M107"))
    assert log == [(200.0, 0.5), (201.0, 1.0), (202.5, 0.0)]


def test_fan_is_kicked_on_start(tmp_path: Path) -> None:
    log = fan_log(tmp_path, "kick_start_time: 0.5\n", (200.0, "M106 S51"), (210.0, "M106 S102"))
    assert log == [(200.0, 1.0), (200.5, 0.2), (210.0, 0.4)]


def test_fan_limits(tmp_path: Path) -> None:
    options = "kick_start_time: 0\nmax_power: 0.8\noff_below: 0.3\n"
    log = fan_log(tmp_path, options, (200.0, "M106 S255"), (201.0, "M106 S51"), (202.0, "M106 S127.5"))
    assert log == [(200.0, 0.8), (201.0, 0.0), (202.0, 0.4)]


def test_fast_changes_are_thinned_and_the_last_one_holds(tmp_path: Path) -> None:
    commands = [(200.0 + i * 0.01, f"M106 S{i}") for i in range(1, 51)]
    log = fan_log(tmp_path, "kick_start_time: 0\n", *commands)
    assert log[-1][1] == pytest.approx(50 / 255)
    gaps = [b[0] - a[0] for a, b in pairwise(log)]
    assert min(gaps) >= 0.0999  # an MCU keeps one value waiting
    assert log[-1][0] <= 200.5 + 0.2


def test_wrong_fan_speed(tmp_path: Path) -> None:
    session, _, _ = fan_session(tmp_path, "[fan]\npin: PA1\n")

    def body(s: Session) -> None:
        with pytest.raises(CommandError, match="S must have minimum of 0"):
            s.gcode.run_script("M106 S-1")
        with pytest.raises(CommandError, match="not a number"):
            s.gcode.run_script("M106 S1.2.3")

    session.run(body)


def test_fan_pin_setup_and_status(tmp_path: Path) -> None:
    session, mcu, _ = fan_session(tmp_path, "[fan]\npin: PA1\nshutdown_speed: 0.5\nmax_power: 0.5\n")

    def body(s: Session) -> None:
        s.gcode.run_script("M106 S255")
        assert s.status("fan") == {"speed": 0.5, "rpm": None}

    session.run(body)
    assert mcu.pins["PA1"].setup == {
        "max_duration": 0.0, "cycle_time": 0.01, "hardware": False, "start": 0.0, "shutdown": 0.25,
    }  # fmt: skip


def test_output_pin_digital_and_pwm(tmp_path: Path) -> None:
    config = (
        "[output_pin led]\npin: PA1\nvalue: 1\n[output_pin lamp]\npin: PA2\npwm: yes\nscale: 10\nvalue: 5\n"
    )
    session, mcu, _ = fan_session(tmp_path, config)

    def body(s: Session) -> None:
        s.gcode.run_script("SET_PIN PIN=led VALUE=0\nSET_PIN PIN=lamp VALUE=2")
        assert s.status("output_pin lamp")["value"] == 0.2
        for wrong, message in (
            ("PIN=led VALUE=0.5", "Invalid pin value"),
            ("PIN=lamp VALUE=11", "VALUE must have maximum of 10"),
            ("PIN=lamp VALUE=nan", "not a number"),
            ("PIN=other VALUE=1", r"'other' is not valid for PIN \(choices: lamp, led\)"),
        ):
            with pytest.raises(CommandError, match=message):
                s.gcode.run_script(f"SET_PIN {wrong}")

    session.run(body)
    assert mcu.pins["PA1"].log == [(200.0, 0)]
    assert mcu.pins["PA2"].log == [(200.0, 0.2)]
    assert mcu.pins["PA2"].setup["start"] == 0.5


def test_output_pin_is_refreshed_before_the_mcu_gives_up(tmp_path: Path) -> None:
    config = "[output_pin laser]\npin: PA1\npwm: yes\nmaximum_mcu_duration: 2\n"
    session, mcu, toolhead = fan_session(tmp_path, config)

    def body(s: Session) -> None:
        toolhead.print_time = s.reactor.monotonic() + 0.3
        s.gcode.run_script("SET_PIN PIN=laser VALUE=0.7")
        s.sleep(10.0)
        toolhead.print_time = s.reactor.monotonic() + 0.3
        s.gcode.run_script("SET_PIN PIN=laser VALUE=0")
        s.sleep(10.0)

    session.run(body)
    log = mcu.pins["PA1"].log
    gaps = [b[0] - a[0] for a, b in pairwise(log)]
    assert max(gaps) < 2.0  # never longer than the MCU waits
    assert [value for _, value in log[-2:]] == [0.7, 0.0]  # and no refresh of the resting value
    assert 5 <= len(log) <= 14
