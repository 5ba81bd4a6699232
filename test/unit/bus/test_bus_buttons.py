"""Buttons and filament sensors, against a board with scripted answers."""

from __future__ import annotations

from pathlib import Path

from bus_rig import BusSession, run, start_error
from extras import buttons as buttons_module

# ---------------------------------------------------------------- buttons


def press(s: BusSession, state: bytes, ack_count: int = 0, oid: int = 0) -> None:
    s.chip.report("buttons_state", oid, ack_count=ack_count, state=state)
    s.sleep(0.1)


BUTTON = """
[respond]
[gcode_button go]
pin: ^!PA5
press_gcode: M118 pressed {printer["gcode_button go"].state}
release_gcode: M118 released
"""


def test_a_button_runs_its_gcode_and_reports_its_state(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert "config_buttons oid=0 button_count=1" in s.chip.config
        assert "buttons_add oid=0 pos=0 pin=PA5 pull_up=1" in s.chip.config
        assert s.chip.init[0].endswith("retransmit_count=50 invert=1")
        assert s.status("gcode_button go") == {"state": "RELEASED"}
        press(s, b"\x01")
        s.gcode.run_script("QUERY_BUTTON BUTTON=go")
        press(s, b"\x00", ack_count=1)
        text = "\n".join(s.lines)
        assert text.index("pressed PRESSED") < text.index("go: PRESSED") < text.index("released")

    run(tmp_path, BUTTON, body)


def test_repeated_states_count_once_and_are_acknowledged(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        press(s, b"\x01")
        press(s, b"\x01\x00")  # the first again, with the next
        press(s, b"\x01\x00")
        press(s, b"\x01\x00", ack_count=2)
        assert s.chip.messages("buttons_ack") == [[0, 1], [0, 1], [0, 2]]
        assert sum("pressed" in line for line in s.lines) == 2

    run(tmp_path, BUTTON, body)


def test_a_failing_script_is_reported_and_the_button_lives_on(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        press(s, b"\x01")
        press(s, b"\x00", ack_count=1)
        assert any(line.startswith("!!") and "no thanks" in line for line in s.lines)
        assert "released" in "\n".join(s.lines) and s.state[1] == "ready"

    config = BUTTON.replace("M118 pressed", '{action_raise_error("no thanks")}')
    run(tmp_path, config, body)


ANALOG = """
[respond]
[gcode_button low]
pin: PA6
analog_range: 300, 600
press_gcode: M118 low on
release_gcode: M118 low off
[gcode_button high]
pin: PA6
analog_range: 1800, 2200
press_gcode: M118 high on
"""


def test_analog_buttons_share_a_pin_and_are_debounced(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        def hold(ohm: float, *times: float) -> None:
            for time_s in times:
                s.chip.pins["PA6"].callback(time_s, ohm / (ohm + 4700.0))
            s.sleep(0.1)

        hold(450.0, 1.000, 1.015)
        assert echoed(s) == []
        hold(450.0, 1.030)
        hold(2000.0, 1.045, 1.060, 1.075)
        hold(1e9, 1.090, 1.105, 1.120)
        assert echoed(s) == ["low on", "low off", "high on"]

    run(tmp_path, ANALOG, body)


def test_an_encoder_counts_full_detents_only() -> None:
    turns: list[str] = []
    encoder = buttons_module.RotaryEncoder(lambda t: turns.append("cw"), lambda t: turns.append("ccw"), 4)
    for state in (1, 3, 2, 0, 1, 3, 2, 0, 2, 3, 1, 0, 1, 0, 1, 3, 1, 0):
        encoder.on_state(0.0, state)
    assert turns == ["cw", "cw", "ccw"]


def test_more_than_eight_pins_take_another_group(tmp_path: Path) -> None:
    sections = "[respond]\n" + "".join(
        f"[gcode_button b{i}]\npin: PA{i}\npress_gcode: M118 {i}\n" for i in range(10)
    )

    def body(s: BusSession) -> None:
        counts = [line.split("=")[-1] for line in s.chip.config if line.startswith("config_buttons")]
        assert counts == ["8", "2"]

    run(tmp_path, sections, body)


# ---------------------------------------------------------------- filament sensors

SWITCH = """
[respond]
[pause_resume]
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode: M118 paused
[gcode_macro M400]
gcode: M118 done
[virtual_sdcard]
path: /tmp
[filament_switch_sensor f]
switch_pin: ^PA7
runout_gcode: M118 runout
insert_gcode: M118 insert
event_delay: 3
"""


def echoed(s: BusSession) -> list[str]:
    return [line.removeprefix("echo: ") for line in s.lines if line.startswith("echo: ")]


def printing(s: BusSession, moving: bool = True) -> None:
    s.toolhead.moving = moving
    s.sleep(3.0)


def test_runout_while_printing_pauses_then_runs_the_script(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        press(s, b"\x01")  # within the first seconds: only noted
        assert s.status("filament_switch_sensor f") == {"filament_detected": True, "enabled": True}
        printing(s)
        press(s, b"\x00", 1)
        s.sleep(1.0)
        assert echoed(s) == ["paused", "runout", "done"]
        s.gcode.run_script("QUERY_FILAMENT_SENSOR SENSOR=f")
        assert "filament not detected" in s.lines[-1]

    run(tmp_path, SWITCH, body)


def test_insert_while_not_printing_runs_its_script_but_not_twice_at_once(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        printing(s, moving=False)
        press(s, b"\x01")
        press(s, b"\x00\x01", 1)
        assert echoed(s) == ["insert", "done"]
        s.sleep(4.0)
        press(s, b"\x00\x01", 3)
        s.sleep(1.0)
        assert echoed(s) == ["insert", "done"] * 2

    run(tmp_path, SWITCH, body)


def test_a_disabled_sensor_only_reports(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        press(s, b"\x01")
        s.gcode.run_script("SET_FILAMENT_SENSOR SENSOR=f ENABLE=0")
        printing(s)
        press(s, b"\x00", 1)
        s.sleep(1.0)
        assert echoed(s) == []
        assert s.status("filament_switch_sensor f") == {"filament_detected": False, "enabled": False}

    run(tmp_path, SWITCH, body)


def test_an_encoder_wheel_that_stands_still_is_a_runout(tmp_path: Path) -> None:
    config = SWITCH.replace("filament_switch_sensor", "filament_motion_sensor")
    config = config.replace("event_delay: 3", "extruder: extruder\ndetection_length: 7")

    def body(s: BusSession) -> None:
        extruder = s.printer.lookup_object("extruder")
        extruder.start_s = s.reactor.monotonic()
        printing(s)
        for count in range(5):  # pulses every 3 s: 6 mm apart, near enough
            press(s, bytes([~count & 1]), count)
            s.sleep(2.9)
        assert echoed(s) == [] and s.status("filament_motion_sensor f")["filament_detected"]
        s.sleep(2.0)
        assert echoed(s) == ["paused", "runout", "done"]
        assert not s.status("filament_motion_sensor f")["filament_detected"]

    run(tmp_path, config, body)


def test_a_motion_sensor_without_its_extruder_is_refused(tmp_path: Path) -> None:
    config = "[filament_motion_sensor f]\nswitch_pin: PA1\nextruder: extruder9\npause_on_runout: no\n"
    assert "extruder9" in start_error(tmp_path, config)
