"""Outputs of boards: a tool's PWM pin, a clock for another chip, the pins of a SERCOM."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from bus_rig import FREQ, BusSession, run, start_error
from doc_rig import load
from extras.pwm_tool import WAITING

TOOL = "[pwm_tool laser]\npin: PB1\nhardware_pwm: True\ncycle_time: 0.001\n"


def test_a_tool_takes_values_as_dense_as_the_moves(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        pin = s.chip.pins["PB1"]
        assert pin.setup["waiting"] == WAITING and pin.setup["hardware"]
        for i in range(200):
            s.toolhead.print_time = 200.0 + 0.001 * i
            s.gcode.run_script(f"SET_PIN PIN=laser VALUE={i % 100}")
        assert len(pin.log) == 199, "the first 0 changes nothing"
        assert pin.log[:2] == [(200.001, 0.01), (200.002, 0.02)]
        assert s.status("pwm_tool laser") == {"value": 0.99}

    run(tmp_path, TOOL + "scale: 100\n", body)


def test_a_value_that_stays_is_repeated_in_time(tmp_path: Path) -> None:
    """Also if the next one is known already, and later than the board would wait."""

    def body(s: BusSession) -> None:
        pin = s.chip.pins["PB1"]
        s.gcode.run_script("SET_PIN PIN=laser VALUE=0.5")
        s.toolhead.print_time += 3.0
        s.gcode.run_script("SET_PIN PIN=laser VALUE=0.25")
        s.sleep(210.0)
        times = [time_s for time_s, _ in pin.log]
        assert max(b - a for a, b in itertools.pairwise(times)) <= 1.0
        assert pin.log[0] == (200.0, 0.5) and (203.0, 0.25) in pin.log
        assert times[-1] > 209.0
        s.toolhead.print_time = times[-1] + 1.0
        s.gcode.run_script("SET_PIN PIN=laser VALUE=0")
        count = len(pin.log)
        s.sleep(20.0)
        assert len(pin.log) == count, "the value of a shutdown needs no repetition"

    run(tmp_path, TOOL + "maximum_mcu_duration: 2\n", body)


def test_a_tool_s_values_wait_on_the_board(tmp_path: Path) -> None:
    config = "[mcu]\nserial: x\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n" + TOOL
    assert load(tmp_path, config).message == "Printer is ready"


def test_a_clock_runs_at_its_frequency_with_half_of_each_cycle_on(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        (command,) = [command for command in s.chip.config if command.startswith("set_pwm_out")]
        values = dict(part.split("=") for part in command.split()[1:])
        assert int(values["cycle_ticks"]) == FREQ // 24_000_000
        assert int(values["value"]) * 2 == int(s.chip.constants["PWM_MAX"]) // 2 * 2
        assert values["pin"] == "PB4"

    run(tmp_path, "[static_pwm_clock c]\npin: PB4\nfrequency: 24000000\n", body)


def test_a_sercom_has_its_pins_before_its_bus_is_used(tmp_path: Path) -> None:
    config = "[mcp4728 d]\ni2c_bus: i2c0\n[samd_sercom s]\nsercom: sercom3\ntx_pin: PA1\nclk_pin: PA2\nrx_pin: PA3\n"

    def body(s: BusSession) -> None:
        commands = s.chip.config
        found = [command for command in commands if command.startswith("set_sercom_pin")]
        assert found == [
            f"set_sercom_pin bus=sercom3 sercom_pin_type={kind} pin={pin}"
            for kind, pin in (("tx", "PA1"), ("rx", "PA3"), ("clk", "PA2"))
        ]
        use = next(i for i, command in enumerate(commands) if command.startswith("i2c_set_bus"))
        assert commands.index(found[-1]) < use

    run(tmp_path, config, body)


SERCOM = "[samd_sercom s]\ntx_pin: PA1\nclk_pin: PA2\n"


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[pwm_tool t]\npin: multi_pin:m\n", ("pwm_tool t", "pin", "line 2")),
        (TOOL + "value: 2\n", ("value", "line 5", "1")),
        ("[static_pwm_clock c]\npin: PB4\nfrequency: 3\n", ("frequency", "line 3", "3.3")),
        ("[static_pwm_clock c]\npin: PB4\nfrequency: 50000000\n", ("frequency", "line 3", "36000000 Hz")),
        (SERCOM, ("sercom", "samd_sercom s")),
        (SERCOM + "sercom: sercom9\n", ("sercom9", "line 4", "sercom0", "sercom7")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, "[multi_pin m]\npins: PC1\n" * ("multi" in config) + config)
    expected = [word.replace("line 2", "line 4") if "multi" in config else word for word in words]
    assert all(word in reason for word in expected), reason
