"""A plugin's own endstop in closed loop: it stops the motors by MCU_trsync and reads the planned motion by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from simulation.runner import BAD_INPUT, PRINTED, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"
SENSOR = """
import chelper
from mcu import MCU_trsync


class Sensor:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.pin = config.get("pin")
        self.is_old = config.getboolean("old_form", False)
        self.mcu = self.printer.lookup_object("mcu")
        ffi, self.lib = chelper.get_ffi()
        self.group = ffi.gc(self.lib.trdispatch_alloc(), self.lib.free)
        self.trsync = MCU_trsync(self.mcu, self.group)
        self.oid = self.mcu.create_oid()
        self.mcu.register_config_callback(self.build)
        self.printer.lookup_object("pins").register_chip("sensor", self)
        self.ends = []

    def setup_pin(self, pin_type, pin_params):
        return self

    def build(self):
        self.mcu.add_config_cmd("config_endstop oid=%d pin=%s pull_up=0" % (self.oid, self.pin))
        self.home_cmd = self.mcu.lookup_command(
            "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c"
            " trsync_oid=%c trigger_reason=%c")
        self.query = self.mcu.lookup_query_command(
            "endstop_query_state oid=%c", "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c", oid=self.oid)

    def get_mcu(self):
        return self.mcu

    def add_stepper(self, stepper):
        self.trsync.add_stepper(stepper)

    def get_steppers(self):
        return self.trsync.get_steppers()

    def home_start(self, print_time, sample_time, sample_count, rest_time, triggered=True):
        self.rest = self.mcu.seconds_to_clock(rest_time)
        self.completion = self.printer.get_reactor().completion()
        options = (self.completion, 0.25) if self.is_old else (0.0, self.completion, 0.25)
        self.trsync.start(print_time, *options)
        self.lib.trdispatch_start(self.group, self.trsync.REASON_HOST_REQUEST)
        self.home_cmd.send([
            self.oid, self.mcu.print_time_to_clock(print_time), self.mcu.seconds_to_clock(sample_time), sample_count,
            self.rest, 1, self.trsync.get_oid(), self.trsync.REASON_ENDSTOP_HIT])
        return self.completion

    def home_wait(self, home_end_time):
        self.trsync.set_home_end_time(home_end_time)
        self.completion.wait()
        self.home_cmd.send([self.oid, 0, 0, 0, 0, 0, 0, 0])
        self.lib.trdispatch_stop(self.group)
        if self.trsync.stop() != self.trsync.REASON_ENDSTOP_HIT:
            return 0.0
        clock = self.mcu.clock32_to_clock64(self.query.send([self.oid])["next_clock"]) - self.rest
        time = self.mcu.clock_to_print_time(clock)
        self.check_motion(time)
        return time

    def check_motion(self, time):
        ffi, lib = chelper.get_ffi()
        moves = ffi.new("struct pull_move[4]")
        count = lib.trapq_extract_old(self.printer.lookup_object("toolhead").get_trapq(), moves, 4, 0.0, time)
        assert count and all(a.print_time > b.print_time for a, b in zip(moves[0:count], moves[1:count]))
        move = moves[0]
        assert move.print_time <= time < move.print_time + move.move_t, (move.print_time, move.move_t, time)

    def query_endstop(self, print_time):
        return self.query.send([self.oid])["pin_value"]


def load_config(config):
    return Sensor(config)
"""
SENSOR_OF_X = (("sensor", "pin", "PA4"), ("stepper_x", "endstop_pin", "sensor:x"))
WIRED_X = ("simulator axis x", "endstop_pin", "PA4")


@pytest.fixture
def sim(tmp_path: Path):
    folder = tmp_path / "plugins"
    folder.mkdir()
    (folder / "sensor.py").write_text(SENSOR)

    def go(*overrides: tuple[str, str, str]) -> tuple[int, str, dict[str, Any]]:
        path = tmp_path / "part.gcode"
        path.write_text("G28\nG1 X50 Y60 Z5 F6000\nM400\n")
        options = (("plugins", "path", str(folder)), *SENSOR_OF_X, WIRED_X, *overrides)
        outcome = Simulation(RunOptions(CONFIG, path, 1, options)).run()
        return outcome.status, outcome.reason, outcome.summary

    return go


@pytest.mark.parametrize("old_form", ["True", "False"])
def test_a_plugin_stops_the_motors_at_its_sensor(sim, old_form: str) -> None:
    status, reason, summary = sim(("sensor", "old_form", old_form))
    assert status == PRINTED, reason
    axis = summary["axes"]["x"]
    assert axis["position_mm"] == pytest.approx(50.0, abs=0.03)
    assert axis["steps_lost"] == 0


def test_a_plugins_sensor_that_never_triggers_is_named(sim) -> None:
    status, reason, _ = sim(("sensor", "pin", "PA9"))
    assert status == BAD_INPUT
    assert "No trigger on x after full movement" in reason
