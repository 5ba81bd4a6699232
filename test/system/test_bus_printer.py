"""Bus and pin sections on the simulated printer: the real host against the real firmware."""

from __future__ import annotations

from pathlib import Path

from system.conftest import CONFIG, Simulate

EXTRAS = """
[respond]
[neopixel strip]
pin: PF0
chain_count: 20
initial_BLUE: 0.1
[led cabin]
red_pin: PF1
[servo arm]
pin: PF2
initial_angle: 45
[pwm_cycle_time beeper]
pin: PF3
[static_digital_output on]
pins: PF4, !PF5
[multi_pin pair]
pins: PF6, PF7
[fan_generic chamber]
pin: multi_pin:pair
tachometer_pin: ^PF8
[gcode_button door]
pin: ^PF9
press_gcode: M118 door
[gcode_button panel]
pin: PF15
analog_range: 0, 500
press_gcode: M118 panel
[pause_resume]
[filament_switch_sensor runout]
switch_pin: ^PF10
[filament_motion_sensor wheel]
switch_pin: ^PF11
extruder: extruder
pause_on_runout: no
[controller_fan board]
pin: PF12
[temperature_sensor host]
sensor_type: temperature_host
sensor_path: {temp}
[temperature_sensor both]
sensor_type: temperature_combined
sensor_list: temperature_sensor host, heater_bed
combination_method: max
maximum_deviation: 500
[temperature_fan electronics]
pin: PF13
sensor_type: temperature_host
sensor_path: {temp}
control: watermark
min_temp: 0
max_temp: 90
[board_pins more]
aliases: SPARE=PH1
[output_pin spare]
pin: SPARE
[pwm_tool laser]
pin: PH2
cycle_time: 0.001
maximum_mcu_duration: 1
[dotstar chain]
data_pin: PH3
clock_pin: PH4
chain_count: 20
[ad5206 currents]
enable_pin: PH5
channel_1: 0.5
spi_software_sclk_pin: PH6
spi_software_mosi_pin: PH7
spi_software_miso_pin: PH8
"""
# A laser changes its power with each move of 0.1 mm: more values than wait on the board, and denser than they are sent.
ENGRAVING = "".join(f"G1 X{50 + i / 10:.1f}\nSET_PIN PIN=laser VALUE={i % 10 / 10}\n" for i in range(1, 300))
GCODE = """
G28
SET_LED LED=strip RED=1 INDEX=3
SET_LED LED=cabin RED=0.5
SET_SERVO SERVO=arm ANGLE=90
SET_PIN PIN=beeper VALUE=0.5
G4 P500
SET_PIN PIN=beeper VALUE=0.5 CYCLE_TIME=0.01
SET_PIN PIN=spare VALUE=1
SET_FAN_SPEED FAN=chamber SPEED=0.7
SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=electronics TARGET=40
QUERY_BUTTON BUTTON=door
QUERY_FILAMENT_SENSOR SENSOR=runout
QUERY_ADC NAME=heater_bed PULLUP=4700
G1 X50 Y50 F6000
SET_LED LED=chain GREEN=1
SET_PIN PIN=laser VALUE=0.05
G4 P2000
"""
THERMOCOUPLE = """
[temperature_sensor chamber]
sensor_type: MAX31855
sensor_pin: PF0
{more}
"""


def machine(tmp_path: Path, extras: str) -> Path:
    config = tmp_path / "printer.cfg"
    config.write_text(CONFIG.read_text() + extras)
    return config


def test_a_printer_with_everything_on_its_pins_runs(simulate: Simulate, tmp_path: Path) -> None:
    temp = tmp_path / "temp"
    temp.write_text("42000")
    run = simulate(GCODE + ENGRAVING, config=machine(tmp_path, EXTRAS.replace("{temp}", str(temp))))
    assert run.status == 0, run.stderr
    assert not run.summary["faults"], run.summary["faults"]


def test_a_converter_that_is_not_there_stops_the_printer(simulate: Simulate, tmp_path: Path) -> None:
    """Nothing drives the hardware bus: all ones, which a MAX31855 never sends without a fault."""
    config = machine(tmp_path, THERMOCOUPLE.replace("{more}", "spi_bus: spi1"))
    run = simulate("G4 P5000\n", config=config)
    assert run.status == 3, run.stderr
    assert "Thermocouple reader fault" in run.stderr


def test_a_converter_is_read_through_pins_toggled_by_hand(simulate: Simulate, tmp_path: Path) -> None:
    """A line that stays low is 0 degC without a fault: limits that exclude it stop the printer, others do not."""
    pins = "spi_software_sclk_pin: PF1\nspi_software_mosi_pin: PF2\nspi_software_miso_pin: PF3\n"
    config = machine(tmp_path, THERMOCOUPLE.replace("{more}", pins))
    assert simulate("G4 P3000\n", config=config).status == 0
    run = simulate("G4 P3000\n", config=config, settings=["temperature_sensor chamber.min_temp=10"])
    assert run.status == 3, run.stderr
    assert "Thermocouple reader fault" in run.stderr


def test_a_bus_the_board_does_not_have_is_named(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate("G28\n", config=machine(tmp_path, THERMOCOUPLE.replace("{more}", "spi_bus: spi7")))
    assert run.status == 2
    assert "spi7" in run.stderr and "spi0" in run.stderr and "Traceback" not in run.stderr


def test_an_air_sensor_that_is_not_there_stops_the_printer_by_name(
    simulate: Simulate, tmp_path: Path
) -> None:
    chamber = "\n[temperature_sensor chamber]\nsensor_type: BME280\ni2c_bus: i2c0\n"
    run = simulate("G4 P8000\n", config=machine(tmp_path, chamber))
    assert run.status == 3, run.stderr
    assert "Sensor 'chamber' (BME280)" in run.stderr and "address 118" in run.stderr
