"""The sensors of the filament's width: what they measure, and the flow that follows."""

from __future__ import annotations

from pathlib import Path

import pytest

from bus_rig import BusSession, run, start_error

FLOW = "[gcode_macro M221]\ngcode: M118 flow {params.S}\n[respond]\n[virtual_sdcard]\npath: /tmp\n"
HALL = """\
[hall_filament_width_sensor]
adc1: PC0
adc2: PC1
default_nominal_filament_diameter: 1.75
measurement_delay: 70
pause_on_runout: no
enable: yes
"""
LINE = """\
[tsl1401cl_filament_width_sensor]
pin: PC0
default_nominal_filament_diameter: 1.75
measurement_delay: 20
"""


def flows(s: BusSession) -> list[int]:
    return [int(line.split()[-1]) for line in s.lines if line.startswith("echo: flow")]


def see(s: BusSession, diameter_mm: float) -> None:
    """Two SS49E: of the sum, 9500 at 1.5 mm and 10500 at 2 mm, each has half."""
    raw = 9500 + (diameter_mm - 1.5) * 2000
    for pin in ("PC0", "PC1"):
        s.chip.pins[pin].callback(s.reactor.monotonic(), raw / 20000)


def extrude(s: BusSession, length_mm: float) -> None:
    """At 2 mm a second."""
    s.sleep(length_mm / 2.0)


def start(s: BusSession) -> None:
    s.printer.lookup_object("extruder").start_s = s.reactor.monotonic()


def test_the_flow_follows_when_the_filament_melts(tmp_path: Path) -> None:
    """Thicker filament at the sensor is 70 mm away from the melt; the volume stays the same."""

    def body(s: BusSession) -> None:
        see(s, 1.75)
        start(s)
        extrude(s, 30)
        see(s, 1.85)
        extrude(s, 60)
        assert flows(s) == []
        extrude(s, 40)
        # the interval in which it changed has a mean of both, the next are 1.85 alone
        assert flows(s)[-1] == round(100 * (1.75 / 1.85) ** 2) and all(89 <= flow < 100 for flow in flows(s))
        s.gcode.run_script("DISABLE_FILAMENT_WIDTH_SENSOR")
        s.sleep(1.0)
        assert flows(s)[-1] == 100

    run(tmp_path, FLOW + HALL, body)


def test_a_reading_that_cannot_be_filament_does_not_change_the_flow(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        see(s, 1.65)
        start(s)
        extrude(s, 100)
        assert flows(s) == [round(100 * (1.75 / 1.65) ** 2)]
        see(s, 1.4)  # 0.35 mm off: more than max_difference
        extrude(s, 100)
        assert flows(s)[-1] == 100

    run(tmp_path, FLOW + HALL, body)


def test_without_flow_compensation_it_is_a_runout_sensor(tmp_path: Path) -> None:
    config = HALL.replace("pause_on_runout: no", "pause_on_runout: no\nrunout_gcode: M118 runout")

    def body(s: BusSession) -> None:
        see(s, 1.85)
        start(s)
        s.toolhead.moving = True
        extrude(s, 120)
        assert flows(s) == [] and s.status("hall_filament_width_sensor")["filament_detected"]
        see(s, 0.2)
        s.sleep(1.0)
        assert "echo: runout" in s.lines
        s.gcode.run_script("QUERY_FILAMENT_WIDTH_COMPENSATION")
        assert "disabled" in s.lines[-1]

    m400 = "[gcode_macro M400]\ngcode: M118 done\n"
    run(tmp_path, FLOW + m400 + config + "enable_flow_compensation: no\n", body)


def test_raw_values_and_status_are_for_the_calibration(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        see(s, 1.8)
        s.gcode.run_script("QUERY_RAW_FILAMENT_WIDTH")
        assert s.lines[-1] == "// ADC1=5050 ADC2=5050 RAW=10100"
        status = s.status("hall_filament_width_sensor")
        assert (status["Raw"], status["is_active"]) == (10100, True)
        assert status["Diameter"] == pytest.approx(1.8)
        s.gcode.run_script("QUERY_FILAMENT_WIDTH")
        assert "1.800" in s.lines[-1]
        s.gcode.run_script("ENABLE_FILAMENT_WIDTH_LOG")
        start(s)
        extrude(s, 12)
        assert sum("Filament width: 1.800 mm" in line for line in s.lines) == 1

    run(tmp_path, FLOW + HALL, body)


def test_the_current_width_may_count_until_a_measured_one_has_melted(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        see(s, 1.85)
        start(s)
        extrude(s, 20)
        assert flows(s) == [round(100 * (1.75 / 1.85) ** 2)]

    run(tmp_path, FLOW + HALL + "use_current_dia_while_delay: yes\n", body)


def test_the_volts_of_the_line_sensor_are_millimetres(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.pins["PC0"].callback(s.reactor.monotonic(), 1.7 / 5.0)
        assert s.status("tsl1401cl_filament_width_sensor")["Diameter"] == pytest.approx(1.7)
        start(s)
        extrude(s, 40)
        assert flows(s) == [round(100 * (1.75 / 1.7) ** 2)]
        s.gcode.run_script("RESET_FILAMENT_WIDTH_SENSOR")
        s.sleep(1.0)
        assert flows(s)[-1] == 100

    run(tmp_path, FLOW + LINE, body)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (HALL + "raw_dia1: 9000\nraw_dia2: 9000\n", ("raw_dia2", "hall_filament_width_sensor", "line 9")),
        (HALL + "max_difference: 2\n", ("max_difference", "line 8", "1.75")),
        (HALL.replace("measurement_delay: 70\n", ""), ("measurement_delay", "hall_filament_width_sensor")),
        (LINE + "adc_voltage: 0\n", ("adc_voltage", "tsl1401cl_filament_width_sensor", "line 5")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
