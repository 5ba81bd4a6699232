"""Boards that bring outputs of their own: [sx1509] and [replicape]."""

from __future__ import annotations

from pathlib import Path

import pytest

from bus_devices import Sx1509, frames, take
from bus_rig import BusSession, run, start_error

CHIP = "[sx1509 duex]\ni2c_address: 62\n"
OUTPUTS = """\
[output_pin relay]
pin: sx1509_duex:PIN_3
value: 1
shutdown_value: 1
[output_pin lamp]
pin: !sx1509_duex:PIN_9
[output_pin fan]
pin: sx1509_duex:PIN_12
pwm: yes
hardware_pwm: yes
value: 0.25
"""
REPLICAPE = """\
[replicape]
revision: B3
host_mcu: mcu
enable_pin: !PA5
"""


def test_sx1509_outputs_have_their_start_values(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        levels = take(s.chip, Sx1509()).levels()
        assert levels == pytest.approx({3: 1.0, 9: 1.0, 12: 0.25}, abs=1 / 255)
        assert any("address=62" in command for command in s.chip.config)

    run(tmp_path, CHIP + OUTPUTS, body)


def test_sx1509_outputs_change_at_their_time(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.answers["i2c_transfer"] = lambda values: {"i2c_bus_status": "SUCCESS", "response": b""}
        s.toolhead.print_time = 300.0
        s.gcode.run_script("SET_PIN PIN=relay VALUE=0\nSET_PIN PIN=lamp VALUE=1\nSET_PIN PIN=fan VALUE=0.8")
        s.sleep(1.0)
        assert take(s.chip, Sx1509()).levels() == pytest.approx({3: 0.0, 9: 0.0, 12: 0.8}, abs=1 / 255)
        clocks = [minclock for name, _, minclock, _ in s.chip.sent if name == "i2c_transfer"]
        assert clocks and all(clock == s.chip.print_time_to_clock(300.0) for clock in clocks)

    run(tmp_path, CHIP + OUTPUTS, body)


def test_replicape_motors_have_their_modes_and_currents(tmp_path: Path) -> None:
    config = (
        REPLICAPE
        + "stepper_x_microstep_mode: spread16\nstepper_x_current: 0.96\nstepper_e_microstep_mode: 16\n"
    )
    config += "stepper_e_current: 0.48\nstepper_e_chopper_off_time_high: yes\nstandstill_power_down: yes\n"

    def body(s: BusSession) -> None:
        (sent,) = frames(s.chip, 5)  # after five channels of current
        h, e, z, y, x = sent  # the last register of the chain first
        assert (x, e) == (0b10000010, 0b11111010)  # CFG1 low, CFG2 open; both high with CFG0
        assert (y, z, h) == (0b10, 0b10, 0b11)  # the first bit of H is the standstill's
        texts = [command for command in s.chip.config if command.startswith("config_pca9685")]
        values = {
            int(t.split("channel=")[1].split()[0]): int(t.split(" value=")[1].split()[0]) for t in texts
        }
        # 2.5 V of a PWM of 5 V are 1.92 A
        assert values == {11: 1024, 12: 0, 13: 0, 14: 512, 15: 0}

    run(tmp_path, config, body)


def test_replicape_outputs_are_channels_of_its_pwm_chip(tmp_path: Path) -> None:
    config = REPLICAPE + "[output_pin fan]\npin: replicape:power_fan2\npwm: yes\n"

    def body(s: BusSession) -> None:
        assert any("channel=9 cycle_ticks=72000 value=0 default_value=0" in c for c in s.chip.config)
        s.gcode.run_script("SET_PIN PIN=fan VALUE=0.5")
        ((_, clock, value),) = s.chip.messages("queue_pca9685_out")
        assert (clock, value) == (s.chip.print_time_to_clock(s.toolhead.print_time), 2048)

    run(tmp_path, config, body)


def test_replicape_motors_share_one_enable_line(tmp_path: Path) -> None:
    config = REPLICAPE + "".join(
        f"stepper_{motor}_microstep_mode: 16\nstepper_{motor}_current: 0.5\n" for motor in "xy"
    )
    config += "".join(f"[output_pin {m}]\npin: replicape:stepper_{m}_enable\n" for m in "xy")

    def body(s: BusSession) -> None:
        for script in ("x VALUE=1", "y VALUE=1", "x VALUE=0", "y VALUE=0"):
            s.gcode.run_script(f"SET_PIN PIN={script}")
            s.toolhead.print_time += 1.0
        assert s.chip.pins["PA5"].log == [(200.0, 1), (203.0, 0)]
        assert s.chip.pins["PA5"].invert

    run(tmp_path, config.replace("_enable\n", "_enable\nvalue: 0\n"), body)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[sx1509 d]\ni2c_address: 61\n", ("i2c_address", "sx1509 d", "line 2", "62, 63, 112, 113")),
        (CHIP + "[output_pin p]\npin: sx1509_duex:PIN_16\n", ("sx1509_duex", "PIN_16", "PIN_15")),
        (CHIP + OUTPUTS.replace("hardware_pwm: yes\n", ""), ("sx1509_duex:PIN_12", "hardware_pwm")),
        (
            CHIP + "[output_pin p]\npin: sx1509_duex:PIN_1\nmaximum_mcu_duration: 2\n",
            ("sx1509_duex:PIN_1", "maximum duration"),
        ),
        (REPLICAPE.replace("B3", "A4"), ("revision", "replicape", "line 2", "B3")),
        (REPLICAPE.replace("mcu: mcu", "mcu: host"), ("host_mcu", "line 3", "[mcu host]")),
        (REPLICAPE + "stepper_x_microstep_mode: 16\n", ("stepper_x_current", "replicape")),
        (REPLICAPE + "[output_pin p]\npin: replicape:stepper_x_enable\n", ("stepper_x_microstep_mode",)),
        (REPLICAPE + "[output_pin p]\npin: replicape:power_x\n", ("power_x", "power_hotbed")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
