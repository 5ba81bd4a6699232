"""LEDs, servos, fans with tachometer and the small pin sections, against a board with scripted answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bus_rig import FREQ, BusSession, run, start_error
from extras import neopixel as neopixel_module

# ---------------------------------------------------------------- LEDs


def test_pwm_leds_follow_set_led(tmp_path: Path) -> None:
    config = "[led cabin]\nred_pin: PB1\nwhite_pin: PB2\ninitial_WHITE: 0.5\n"

    def body(s: BusSession) -> None:
        assert s.chip.pins["PB2"].setup["start"] == 0.5
        s.gcode.run_script("SET_LED LED=cabin RED=0.25")
        assert s.chip.pins["PB1"].log == [(200.0, 0.25)] and s.chip.pins["PB2"].log == [(200.0, 0.0)]
        assert s.status("led cabin") == {"color_data": [(0.25, 0.0, 0.0, 0.0)]}

    run(tmp_path, config, body)
    assert "red_pin" in start_error(tmp_path, "[led cabin]\n")


def neopixel(tmp_path: Path, options: str, body: Callable[[BusSession], None]) -> None:
    def prepared(s: BusSession) -> None:
        s.chip.answers["neopixel_send"] = lambda data: {"success": 1}
        s.sleep(0.1)
        body(s)

    run(tmp_path, f"[neopixel n]\npin: PB3\n{options}", prepared)


def memory(s: BusSession, size: int) -> bytes:
    """The chain's bytes on the board."""
    data = bytearray(b"\xee" * size)
    for _, position, part in s.chip.messages("neopixel_update"):
        data[position : position + len(part)] = part
    return bytes(data)


def test_a_chain_gets_the_initial_colours_and_then_only_what_changes(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert memory(s, 6) == bytes([0, 51, 0] * 2), "GRB, red 0.2"
        before = len(s.chip.messages("neopixel_update"))
        s.gcode.run_script("SET_LED LED=n RED=1 GREEN=0.5 BLUE=0 INDEX=2")
        s.sleep(0.1)
        assert s.chip.messages("neopixel_update")[before:] == [[0, 3, bytes([128, 255])]]
        assert s.chip.sent[-1][2] == 200 * FREQ, "in step with the moves"
        assert s.status("neopixel n")["color_data"][1] == (1.0, 0.5, 0.0, 0.0)

    neopixel(tmp_path, "chain_count: 2\ninitial_RED: 0.2\n", body)


def test_colours_wait_for_the_transmission(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        sends = len(s.chip.messages("neopixel_send"))
        s.gcode.run_script("SET_LED LED=n RED=1 INDEX=1 TRANSMIT=0\nSET_LED LED=n BLUE=1 INDEX=2 SYNC=0")
        s.sleep(0.1)
        assert len(s.chip.messages("neopixel_send")) == sends + 1
        assert memory(s, 7) == bytes([255, 0, 0, 0]) + bytes([0, 0, 255])

    neopixel(tmp_path, "chain_count: 2\ncolor_order: RGBW, GRB\n", body)


def test_a_spoilt_transmission_is_repeated_but_not_for_ever(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        before = len(s.chip.messages("neopixel_send"))
        outcomes = iter([0, 0, 1])
        s.chip.answers["neopixel_send"] = lambda data: {"success": next(outcomes)}
        s.gcode.run_script("SET_LED LED=n RED=1")
        s.sleep(0.1)
        assert len(s.chip.messages("neopixel_send")) == before + 3
        s.chip.answers["neopixel_send"] = lambda data: {"success": 0}
        s.gcode.run_script("SET_LED LED=n RED=0")
        s.sleep(0.1)
        assert len(s.chip.messages("neopixel_send")) == before + 3 + neopixel_module.TRIES

    neopixel(tmp_path, "", body)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ("color_order: RGX", "RGX"),
        ("chain_count: 3\ncolor_order: RGB, GRB", "2"),
        ("chain_count: 300", "300"),
    ],
)
def test_impossible_chains_are_explained(tmp_path: Path, options: str, word: str) -> None:
    assert word in start_error(tmp_path, f"[neopixel n]\npin: PB3\n{options}\n")


def test_changes_far_apart_are_sent_apart_and_long_ones_in_pieces() -> None:
    old, new = bytes(200), bytes([1] * 120) + bytes(70) + bytes([9] * 10)
    spans = neopixel_module.changed_spans(old, new)
    assert all(len(data) <= neopixel_module.UPDATE_BYTES_MAX for _, data in spans)
    rebuilt = bytearray(old)
    for position, data in spans:
        rebuilt[position : position + len(data)] = data
    assert bytes(rebuilt) == new and len(spans) == 4
    assert neopixel_module.changed_spans(new, new) == []


# ---------------------------------------------------------------- servo, static pins, groups of pins


def test_servo_angles_become_pulse_widths(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        pin = s.chip.pins["PB4"]
        assert pin.setup["cycle_time"] == 0.020 and pin.setup["start"] == pytest.approx(0.05)
        for print_time, command in ((200.0, "ANGLE=90"), (201.0, "WIDTH=0.9"), (202.0, "WIDTH=0")):
            s.toolhead.print_time = print_time
            s.gcode.run_script(f"SET_SERVO SERVO=arm {command}")
        assert pin.log == [(200.0, 0.075), (201.0, 0.1), (202.0, 0.0)]
        assert s.status("servo arm") == {"value": 0.0}

    run(tmp_path, "[servo arm]\npin: PB4\ninitial_angle: 0\n", body)


def test_static_pins_are_set_at_start(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert s.chip.config[:2] == ["set_digital_out pin=PB5 value=1", "set_digital_out pin=PB6 value=0"]

    run(tmp_path, "[static_digital_output s]\npins: PB5, !PB6\n", body)


def test_a_group_of_pins_acts_as_one(tmp_path: Path) -> None:
    config = "[multi_pin both]\npins: PB1, !PB2\n[fan_generic f]\npin: multi_pin:both\nkick_start_time: 0\n"

    def body(s: BusSession) -> None:
        s.gcode.run_script("SET_FAN_SPEED FAN=f SPEED=0.6")
        assert s.chip.pins["PB1"].log == s.chip.pins["PB2"].log == [(200.0, 0.6)]
        assert (s.chip.pins["PB1"].invert, s.chip.pins["PB2"].invert) == (0, 1)

    run(tmp_path, config, body)


def test_a_group_that_is_not_defined_or_no_output_is_refused(tmp_path: Path) -> None:
    group = "[multi_pin both]\npins: PB1, PB2\n"
    assert "[multi_pin x]" in start_error(tmp_path, group + "[fan_generic f]\npin: multi_pin:x\n")
    sensor = "[temperature_sensor s]\nsensor_type: PT1000\nsensor_pin: multi_pin:both\n"
    assert "output" in start_error(tmp_path, group + sensor)


def test_board_aliases_name_pins_and_reserve_the_rest(tmp_path: Path) -> None:
    aliases = "[board_pins b]\naliases: EXP1=PB7, VCC=<5V>\naliases_more: EXP2=PB8\n"
    pins = "[static_digital_output s]\npins: EXP1, EXP2\n"

    def body(s: BusSession) -> None:
        assert "set_digital_out pin=PB7 value=1" in s.chip.config
        assert "set_digital_out pin=PB8 value=1" in s.chip.config

    run(tmp_path, aliases + pins, body)
    assert "<5V>" in start_error(tmp_path, aliases + "[static_digital_output s]\npins: VCC\n")


def test_pwm_with_a_new_cycle_time_pauses_between(tmp_path: Path) -> None:
    config = "[pwm_cycle_time beep]\npin: PB9\ncycle_time: 0.01\nscale: 1000\n"

    def body(s: BusSession) -> None:
        assert f"set_digital_out_pwm_cycle oid=0 cycle_ticks={FREQ // 100}" in s.chip.config
        s.gcode.run_script("SET_PIN PIN=beep VALUE=250")
        s.toolhead.print_time = 201.0
        s.gcode.run_script("SET_PIN PIN=beep VALUE=500 CYCLE_TIME=0.001")
        on, off, cycle, on_again = s.chip.sent
        assert on[1] == [0, 200 * FREQ, FREQ // 400]
        assert off[1] == [0, 201 * FREQ, 0]
        assert cycle[:2] == ("set_digital_out_pwm_cycle", [0, FREQ // 1000])
        assert off[1][1] < cycle[2] < cycle[3] == on_again[1][1] == pytest.approx(201.1 * FREQ, abs=2)
        assert on_again[1][2] == FREQ // 2000
        assert s.status("pwm_cycle_time beep") == {"value": 0.5}

    run(tmp_path, config, body)


# ---------------------------------------------------------------- fans


def test_a_tachometer_reports_revolutions(tmp_path: Path) -> None:
    config = "[fan_generic f]\npin: PB1\ntachometer_pin: ^PB2\ntachometer_ppr: 2\n"

    def body(s: BusSession) -> None:
        assert "config_counter oid=0 pin=PB2 pull_up=1" in s.chip.config
        assert f"poll_ticks={int(0.0015 * FREQ)} sample_ticks={FREQ}" in s.chip.init[0]
        assert s.status("fan_generic f")["rpm"] == 0.0
        # 3000 rpm with 2 pulses of 2 edges: 200 edges a second
        s.chip.report("counter_state", 0, next_clock=2 * FREQ, count=0xFFFFFFF0, count_clock=FREQ)
        s.chip.report(
            "counter_state",
            0,
            next_clock=3 * FREQ,
            count=0xFFFFFFF0 + 199 - 2**32,
            count_clock=int(1.995 * FREQ),
        )
        assert s.status("fan_generic f")["rpm"] == pytest.approx(3000.0)
        s.chip.report("counter_state", 0, next_clock=4 * FREQ, count=183, count_clock=int(1.995 * FREQ))
        assert s.status("fan_generic f")["rpm"] == 0.0, "no edge in a whole second"

    run(tmp_path, config, body)


HEATED = """
[thermistor t]
temperature1: 25
resistance1: 100000
beta: 3950
[heater_generic h]
heater_pin: PC1
sensor_type: t
sensor_pin: PC2
control: watermark
min_temp: 0
max_temp: 200
[verify_heater h]
check_gain_time: 1000
[controller_fan c]
pin: PB1
heater: h
idle_timeout: 10
idle_speed: 0.4
fan_speed: 0.8
kick_start_time: 0
"""


def test_a_controller_fan_runs_with_the_heater_and_a_while_on(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        heater = s.printer.lookup_object("heaters").lookup_heater("h")
        fan = s.chip.pins["PB1"]
        s.sleep(3.0)
        assert fan.log == []
        heater.set_temp(60.0)
        s.sleep(3.0)
        heater.set_temp(0.0)
        s.sleep(3.0)
        assert [value for _, value in fan.log] == [0.8, 0.4]
        s.sleep(12.0)
        assert [value for _, value in fan.log] == [0.8, 0.4, 0.0]
        assert 9.0 <= fan.log[2][0] - fan.log[1][0] <= 11.1

    run(tmp_path, HEATED, body)
    assert "stepper_q" in start_error(tmp_path, HEATED + "stepper: stepper_q\n")


TEMPERATURE_FAN = """
[temperature_fan t]
pin: PB1
kick_start_time: 0
sensor_type: temperature_mcu
sensor_temperature1: 0
sensor_adc1: 0
sensor_temperature2: 100
sensor_adc2: 1
min_temp: 0
max_temp: 90
target_temp: 50
"""


def temperatures(s: BusSession, *temps_c: float) -> list[float]:
    """Fan values after readings a second apart."""
    for i, temp_c in enumerate(temps_c):
        s.chip.pins["ADC_TEMPERATURE"].callback(s.reactor.monotonic() + i, temp_c / 100.0)
    return [value for _, value in s.chip.pins["PB1"].log]


def test_a_temperature_fan_switches_around_its_target(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert temperatures(s, 40.0, 51.9, 52.0, 48.1, 47.9) == [1.0, 0.0]
        status = s.status("temperature_fan t")
        assert (status["temperature"], status["target"], status["speed"]) == (47.9, 50.0, 0.0)
        s.gcode.run_script("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=t TARGET=30 MAX_SPEED=0.7")
        s.sleep(10.0)
        assert temperatures(s, 47.9)[-1] == 0.7
        s.gcode.run_script("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=t TARGET=0")
        s.sleep(10.0)
        assert temperatures(s, 80.0)[-1] == 0.0

    run(tmp_path, TEMPERATURE_FAN + "control: watermark\n", body)


def test_a_temperature_fan_by_pid_blows_harder_the_hotter_it_is(tmp_path: Path) -> None:
    """fan = max - Kp e / 255 with e = target - measured <= 0 at and above the target, and never below min_speed."""

    def body(s: BusSession) -> None:
        values = temperatures(s, 45.0, 40.0)
        assert values[0] == pytest.approx(1.0 - 25.5 * 5.0 / 255.0, abs=0.01)
        assert values[-1] == pytest.approx(0.3, abs=0.01)
        s.sleep(10.0)
        assert temperatures(s, 60.0)[-1] == pytest.approx(1.0)

    run(tmp_path, TEMPERATURE_FAN + "control: pid\npid_Kp: 25.5\npid_Ki: 0\npid_Kd: 0\n", body)


def test_wrong_fan_targets_are_refused(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        for options in ("TARGET=95", "TARGET=40 MIN_SPEED=0.9 MAX_SPEED=0.5"):
            with pytest.raises(s.printer.command_error):
                s.gcode.run_script(f"SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=t {options}")

    run(tmp_path, TEMPERATURE_FAN + "control: watermark\n", body)


TEMPLATES = """
[display_template state]
param_idle: 0.1
text:
  {% if printer["output_pin lamp"].value %}
  1, 0, 0, 0
  {% else %}
  0, {param_idle}, 0, 0
  {% endif %}
[display_template broken]
text: 1, green
[output_pin lamp]
pin: PB7
"""


def test_leds_follow_a_template_until_it_is_taken_away(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        colors = lambda: s.status("neopixel n")["color_data"]  # noqa: E731
        s.gcode.run_script("SET_LED_TEMPLATE LED=n TEMPLATE=state INDEX=2 PARAM_IDLE=0.5")
        s.sleep(1.0)
        assert colors() == [(0.0, 0.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0)]
        s.gcode.run_script("SET_PIN PIN=lamp VALUE=1\nSET_LED_TEMPLATE LED=n TEMPLATE=state INDEX=1")
        s.sleep(1.0)
        assert colors() == [(1.0, 0.0, 0.0, 0.0)] * 2
        s.gcode.run_script("SET_LED_TEMPLATE LED=n TEMPLATE=\nSET_LED LED=n BLUE=1")
        s.sleep(1.0)
        assert colors() == [(0.0, 0.0, 1.0, 0.0)] * 2
        s.gcode.run_script("SET_LED_TEMPLATE LED=n TEMPLATE=broken")
        s.sleep(1.0)
        assert colors() == [(0.0, 0.0, 0.0, 0.0)] * 2, "no colour is black, and harms nobody"

    neopixel(tmp_path, "chain_count: 2\n" + TEMPLATES, body)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("TEMPLATE=nobody", "Unknown display_template 'nobody'"),
        ("TEMPLATE=state PARAM_X=1", "no parameter param_x"),
        ("TEMPLATE=state PARAM_IDLE=a+b", "Unable to parse"),
        ("TEMPLATE=state INDEX=2", "INDEX"),
    ],
)
def test_a_wrong_template_is_refused(tmp_path: Path, command: str, reason: str) -> None:
    def body(s: BusSession) -> None:
        with pytest.raises(s.printer.command_error, match=reason):
            s.gcode.run_script(f"SET_LED_TEMPLATE LED=n {command}")

    neopixel(tmp_path, TEMPLATES, body)


FOLLOWERS = """
[display_template heat]
param_gain: 1.0
text: {printer["output_pin lamp"].value * param_gain}
[display_template nonsense]
text: warm
[output_pin lamp]
pin: PB7
pwm: true
[output_pin relay]
pin: PB6
[output_pin dimmer]
pin: PB5
pwm: true
scale: 10
[fan_generic f]
pin: PB4
kick_start_time: 0
"""


def test_pins_and_fans_follow_a_template_until_they_are_set_by_hand(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        def values() -> tuple[float, float, float]:
            status = s.status
            return (
                status("output_pin relay")["value"],
                status("output_pin dimmer")["value"],
                status("fan_generic f")["speed"],
            )

        s.gcode.run_script(
            "SET_PIN PIN=relay TEMPLATE=heat\nSET_PIN PIN=dimmer TEMPLATE=heat PARAM_GAIN=5\n"
            "SET_FAN_SPEED FAN=f TEMPLATE=heat PARAM_GAIN=0.5"
        )
        s.sleep(1.0)
        assert values() == (0.0, 0.0, 0.0)
        s.gcode.run_script("SET_PIN PIN=lamp VALUE=0.8")
        s.sleep(1.0)
        assert values() == (1.0, 0.4, 0.4)
        assert s.chip.pins["PB5"].log[-1][1] == 0.4
        s.gcode.run_script(
            "SET_PIN PIN=relay VALUE=0\nSET_PIN PIN=dimmer TEMPLATE=nonsense\nSET_FAN_SPEED FAN=f SPEED=1"
        )
        s.sleep(1.0)
        assert values() == (0.0, 0.0, 1.0), "by hand, no value is off, by hand"

    run(tmp_path, FOLLOWERS, body)
