"""A printer of stand-ins with ordinary heaters and an induction nozzle, and blocks for that."""

from __future__ import annotations

from typing import Any

import chelper
from block_codec import Row, content, pack
from extras import heater_bed, heater_generic, heaters, induction_heater, temperature_sensor, verify_heater
from heater_fakes import FakePrinter
from thermal.sensing import laws

CONFIG = """
[heater_bed]
heater_pin: PE0
sensor_type: Generic 3950
sensor_pin: PE1
control: {control}
pid_Kp: 60
pid_Ki: 1
pid_Kd: 100
max_delta: 3
min_temp: 0
max_temp: 120
[heater_generic chamber]
heater_pin: PE2
sensor_type: Generic 3950
sensor_pin: PE3
control: watermark
min_temp: 0
max_temp: 80
gcode_id: C
[temperature_sensor board]
sensor_type: PT1000
sensor_pin: PE4
[induction_heater nozzle]
sense_pin: PA0
min_temp: 0
max_temp: 320
[extruder]
heater: nozzle
min_extrude_temp: 160
[bad_sensor]
sensor_type: Nothing
"""
LOADERS = {
    "heaters": heaters.load_config,
    "heater_bed": heater_bed.load_config,
    "heater_generic": heater_generic.load_config_prefix,
    "temperature_sensor": temperature_sensor.load_config_prefix,
    "verify_heater": verify_heater.load_config_prefix,
    "induction_heater": induction_heater.load_config_prefix,
    "extruder": lambda config: config.get_printer().load_object(config, "heaters").setup_heater(config, "T0"),
}


def machine(control: str = "pid", **start_args: Any) -> FakePrinter:
    return FakePrinter(CONFIG.replace("{control}", control), LOADERS, **start_args)


def blocks(temp: float, phase: int, count: int = 2) -> bytes:
    error = laws.ExpLaw().error(temp, phase)
    value = int((256.0 + error) * 192) >> 4
    code = int(256.0 + error)
    return pack([Row(192, value, phase, code - 2, code + 3)] * count, 192)  # 0.9 LSB of noise


def nozzle(more: str = "") -> tuple[FakePrinter, Any]:
    printer = FakePrinter(
        CONFIG.replace("{control}", "pid").replace("sense_pin: PA0", f"sense_pin: PA0\n{more}"), LOADERS
    )
    heater = printer.load("extruder")
    printer.mcu.configure()
    printer.send("klippy:connect")
    printer.send("klippy:ready")
    return printer, heater


def deliver(printer: FakePrinter, sequence: int, temp: float, phase: int) -> None:
    clock = int((printer.reactor.now_s - 0.020) * 72e6)
    packed = content(sequence, clock, blocks(temp, phase))
    pulled = chelper.get_ffi()[0].new("struct pull_message[]", 1)
    pulled[0].len, pulled[0].data, pulled[0].receive_time = len(packed), packed, printer.reactor.now_s
    printer.mcu.on_batch(pulled, 1)
