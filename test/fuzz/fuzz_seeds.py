"""Starting inputs for the fuzzer: fuzz_seeds.py FOLDER writes them there."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mcu_harness import Dictionary


def seed_inputs() -> list[bytes]:
    """Fuzzer inputs that already reach far: configure everything, then use it (format: fuzz_command.c)."""
    commands = Dictionary.built().commands

    def step(*messages: tuple[str, list[Any]]) -> bytes:
        content = b""
        for name, numbers in messages:
            names = [key for key, _ in commands[name].params]
            content += commands[name].encode(dict(zip(names, numbers, strict=True)))
        return bytes([0x80 | len(content)]) + content

    configure = (
        step(("allocate_oids", [6]), ("config_digital_out", [0, 1, 0, 0, 72000]))
        + step(("config_pwm_out", [1, 2, 3000, 0, 0, 72000]), ("config_analog_in", [2, 3]))
        + step(("config_stepper", [3, 4, 5, 255, 0]), ("config_endstop", [4, 6, 1]), ("config_trsync", [5]))
        + step(("finalize_config", [7]))
    )
    later = 500_000
    run = [
        step(("set_digital_out_pwm_cycle", [0, 7200]), ("queue_digital_out", [0, later, 3000])),
        step(("queue_pwm_out", [1, later, 100]), ("queue_pwm_out", [1, later + 5000, 0])),
        step(("query_analog_in", [2, later, 100, 4, 7200, 6, 0, 65535, 4])),
        step(("reset_step_clock", [3, later]), ("queue_step", [3, 1000, 100, 2])),
        step(("trsync_start", [5, later, 7200, 3]), ("stepper_stop_on_trigger", [3, 5]))
        + step(
            ("endstop_home", [4, later, 100, 4, 7200, 1, 5, 1]), ("trsync_set_timeout", [5, later + 90000])
        ),
        step(("emergency_stop", []), ("clear_shutdown", []), ("get_config", [])),
    ]
    bus = (
        step(("allocate_oids", [9]), ("config_spi", [0, 7, 0]), ("spi_set_sw_bus", [0, 8, 9, 10, 3, 36]))
        + step(("config_spi", [1, 11, 1]), ("spi_set_bus", [1, 1, 0, 100000]))
        + step(("config_spi_shutdown", [2, 0, b"\x01\x02"]), ("config_thermocouple", [3, 1, 2]))
        + step(("config_i2c", [4]), ("i2c_set_sw_bus", [4, 12, 13, 360, 72]))
        + step(("config_buttons", [5, 2]), ("buttons_add", [5, 0, 14, 1]), ("buttons_add", [5, 1, 15, 1]))
        + step(("config_neopixel", [6, 16, 9, 288, 3600]), ("config_counter", [7, 17, 1]))
        + step(("config_tmcuart", [8, 18, 1, 18, 1800]), ("finalize_config", [7]))
    )
    bus_run = [
        step(("spi_transfer", [0, b"abc"]), ("spi_send", [1, b"\x00"]), ("i2c_transfer", [4, b"x", 3])),
        step(("query_thermocouple", [3, later, 7200, 1, 65535, 3]), ("tmcuart_send", [8, b"\x20\x04", 10])),
        step(("buttons_query", [5, later, 7200, 2, 1]), ("buttons_ack", [5, 1]))
        + step(("query_counter", [7, later, 720, 7200])),
        step(("neopixel_update", [6, 2, b"\xff\x00"]), ("neopixel_send", [6])),
        run[-1],
    ]
    waits = bytes([0xC0 | 19, 0xC0 | 18, 0xC0 | 16, 0xC0 | 17])
    sessions = [configure + piece + waits for piece in run] + [configure + b"".join(run[:-1]) + waits]
    return [*sessions, *(bus + piece + waits for piece in bus_run), bus + b"".join(bus_run) + waits]


if __name__ == "__main__":
    for number, data in enumerate(seed_inputs()):
        (Path(sys.argv[1]) / f"seed{number}").write_bytes(data)
