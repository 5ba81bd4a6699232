"""Starting inputs for the fuzzer: fuzz_seeds.py FOLDER writes them there."""

from __future__ import annotations

import sys
from pathlib import Path

from mcu_harness import Dictionary


def seed_inputs() -> list[bytes]:
    """Fuzzer inputs that already reach far: configure everything, then use it (format: fuzz_command.c)."""
    commands = Dictionary.built().commands

    def step(*messages: tuple[str, list[int]]) -> bytes:
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
    waits = bytes([0xC0 | 19, 0xC0 | 18, 0xC0 | 16, 0xC0 | 17])
    return [configure + piece + waits for piece in run] + [configure + b"".join(run[:-1]) + waits]


if __name__ == "__main__":
    for number, data in enumerate(seed_inputs()):
        (Path(sys.argv[1]) / f"seed{number}").write_bytes(data)
