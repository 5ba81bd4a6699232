"""What an ordinary MCU says about itself, for batch mode, and a reader of what batch mode writes."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgproto

MAX_ERROR_S = 25e-6  # by which compression may shift a step
CLOCK_HZ = 72e6
STEP_IDS = {
    "queue_step oid=%c interval=%u count=%hu add=%hi": 11,
    "set_next_step_dir oid=%c dir=%c": 12,
    "reset_step_clock oid=%c clock=%u": 13,
}
QUEUE_STEP, SET_DIR, RESET_CLOCK = STEP_IDS.values()
COMMANDS = (
    "allocate_oids count=%c", "finalize_config crc=%u", "get_config", "get_clock", "get_uptime", "emergency_stop",
    "clear_shutdown", "debug_nop", "config_reset", "reset",
    "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u",
    "stepper_get_position oid=%c", "stepper_stop_on_trigger oid=%c trsync_oid=%c",
    "config_endstop oid=%c pin=%c pull_up=%c", "endstop_query_state oid=%c",
    "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c trsync_oid=%c"
    " trigger_reason=%c",
    "config_trsync oid=%c", "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c",
    "trsync_set_timeout oid=%c clock=%u", "trsync_trigger oid=%c reason=%c",
    "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u",
    "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", "queue_digital_out oid=%c clock=%u on_ticks=%u",
    "update_digital_out oid=%c value=%c", "set_digital_out pin=%u value=%c",
    "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    "queue_pwm_out oid=%c clock=%u value=%hu", "config_analog_in oid=%c pin=%u",
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c"
    " min_value=%hu max_value=%hu range_check_count=%c",
)  # fmt: skip
RESPONSES = (
    "stats count=%u sum=%u sumsq=%u", "clock clock=%u",
    "uptime high=%u clock=%u", "config is_config=%c crc=%u is_shutdown=%c move_count=%hu", "starting",
    "shutdown clock=%u static_string_id=%hu", "is_shutdown static_string_id=%hu",
    "stepper_position oid=%c pos=%i", "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c",
    "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u", "analog_in_state oid=%c next_clock=%u values=%*s",
)  # fmt: skip


def dictionary(clock_hz: float = CLOCK_HZ, **config: int) -> bytes:
    """A firmware dictionary with what printers of all kinds need; message ids are ours."""
    pins = {f"P{port}0": [16 * index, 16] for index, port in enumerate("ABCDEFGH")}
    words = {
        "app": "bench", "license": "none", "version": "bench", "build_versions": "none",
        "commands": {"identify offset=%u count=%c": 1, **STEP_IDS, **{t: 20 + n for n, t in enumerate(COMMANDS)}},
        "responses": {"identify_response offset=%u data=%.*s": 0, **{t: 70 + n for n, t in enumerate(RESPONSES)}},
        "enumerations": {"pin": pins, "static_string_id": {"Timer too close": 2}},
        "config": {"MCU": "bench", "CLOCK_FREQ": clock_hz, "ADC_MAX": 4095, "STATS_SUMSQ_BASE": 256, **config},
    }  # fmt: skip
    return json.dumps(words).encode()


def parser(clock_hz: float = CLOCK_HZ) -> msgproto.MessageParser:
    result = msgproto.MessageParser()
    result.process_identify(dictionary(clock_hz), decompress=False)
    return result


def decode(contents: Sequence[bytes], clock_hz: float = CLOCK_HZ) -> list[dict[str, Any]]:
    """All commands of a row of message contents."""
    reader = parser(clock_hz)
    return [params for content in contents for params in reader.parse_content(content)]


def batch_args(folder: Path) -> dict[str, Any]:
    """Start of a host in batch mode: printer.cfg, in.gcode and dict of the folder; steps go to its file out."""
    return {
        "config_file": str(folder / "printer.cfg"),
        "config_overrides": [],
        "apiserver": None,
        "start_reason": "startup",
        "software_version": "test",
        "cpu_info": "test",
        "debuginput": str(folder / "in.gcode"),
        "gcode_fd": os.open(folder / "in.gcode", os.O_RDONLY),
        "debugoutput": str(folder / "out"),
        "dictionary": str(folder / "dict"),
    }
