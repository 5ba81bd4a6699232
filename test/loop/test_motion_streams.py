"""motion_report's streams report the motion that was: planned and stepped agree. And the picture of it."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import motion_plot
from simulation.runner import PRINTED, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"
GCODE = """G28 X Y
G1 X20 Y20 F6000
G4 P300
G1 X60 Y40 F4800
G1 X20 Y80
G1 X21
G4 P600
"""
PRINTED_S = 1.38  # at the end, after homing: all in one coordinate system


class Client:
    """Stands for a connection of the API."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []

    def is_closed(self) -> bool:
        return False

    def send(self, message: dict[str, Any]) -> None:
        self.messages.append(message)


class StreamedSimulation(Simulation):
    """Subscribes as soon as the printer is ready."""

    def __init__(self, options: RunOptions) -> None:
        super().__init__(options)
        self.client = Client()
        self.headers: dict[str, Any] = {}
        self.unknown = ""

    def _wait_ready(self) -> bool:
        if not super()._wait_ready():
            return False
        for kind, name in (("stepper", "stepper_x"), ("stepper", "stepper_y"), ("trapq", "toolhead")):
            self._request(kind, name)
        with pytest.raises(self.printer.command_error) as refused:
            self._request("stepper", "stepper_w")
        self.unknown = str(refused.value)
        return True

    def _request(self, kind: str, name: str) -> None:
        hooks = self.printer.lookup_object("webhooks")
        params = {"name": name, "response_template": {"kind": kind, "name": name}}
        method = f"motion_report/dump_{kind}"
        request = hooks_request(self.client, method, params)
        hooks.get_callback(method)(request)
        self.headers[name] = request.response["result"]["header"]


def hooks_request(client: Client, method: str, params: dict[str, Any]) -> Any:
    from webhooks import WebRequest

    return WebRequest(client, {"id": 1, "method": method, "params": params})


@pytest.fixture(scope="module")
def streamed(tmp_path_factory: pytest.TempPathFactory) -> StreamedSimulation:
    path = tmp_path_factory.mktemp("streams") / "part.gcode"
    path.write_text(GCODE)
    sim = StreamedSimulation(RunOptions(CONFIG, path))
    outcome = sim.run()
    assert outcome.status == PRINTED, outcome.reason
    return sim


def sorted_streams(sim: StreamedSimulation) -> motion_plot.LiveHost:
    host = SimpleNamespace(motors={}, plans={})
    for message in sim.client.messages:
        motion_plot.LiveHost.take(host, message)  # type: ignore[arg-type]
    return host  # type: ignore[return-value]


def test_headers_are_the_documented_ones(streamed: StreamedSimulation) -> None:
    assert streamed.headers["stepper_x"] == ["interval", "count", "add"]
    assert streamed.headers["toolhead"] == [
        "time", "duration", "start_velocity", "acceleration", "start_position", "direction",
    ]  # fmt: skip
    assert "stepper_w" in streamed.unknown
    assert "stepper_x" in streamed.unknown, "the choices are named"


def test_messages_join_without_gap(streamed: StreamedSimulation) -> None:
    messages = sorted_streams(streamed).motors["stepper_x"]
    # homing halts the motor among steps that were reported already; what comes after it joins
    printed = [m for m in messages if m["first_time"] > messages[-1]["last_time"] - PRINTED_S]
    assert len(printed) >= 3
    for before, after in itertools.pairwise(printed):
        steps = sum(count for _, count, _ in before["data"])
        assert after["first_clock"] > before["last_clock"]
        assert before["start_mcu_position"] + steps == after["start_mcu_position"]


def test_steps_follow_the_plan(streamed: StreamedSimulation) -> None:
    host = sorted_streams(streamed)
    for name, axis in (("stepper_x", 0), ("stepper_y", 1)):
        motor = motion_plot.motor_from_stream(name, host.motors[name])
        motor = motor.between(motor.times[-1] - PRINTED_S, np.inf)
        assert len(motor.times) > 3000
        planned = host.plans["toolhead"].coordinates(motor.times)[:, axis]
        # a step stands for half a step to both sides, and 25 us at 80 mm/s are 2 um
        assert np.abs(motor.positions - planned).max() < 0.51 * motor.step_mm + 80.0 * 25e-6


def test_the_picture_finds_speed_and_error(streamed: StreamedSimulation) -> None:
    host = sorted_streams(streamed)
    motor = motion_plot.motor_from_stream("stepper_x", host.motors["stepper_x"])
    motor = motor.between(motor.times[-1] - PRINTED_S, np.inf)
    _, _, velocity, _ = motion_plot.on_grid(motor)
    assert np.abs(velocity).max() == pytest.approx(80.0 * 40.0 / np.hypot(40.0, 20.0), rel=0.02)
    error = motion_plot.error_to_plan(motor, host.plans["toolhead"])
    assert error is not None
    assert np.abs(error).max() < 80.0 * 30e-6
    figure = Figure()
    motion_plot.draw([motor], host.plans, figure, "stepper_x")
    assert len(figure.axes) == 4


def test_a_step_that_is_out_of_line_shows(streamed: StreamedSimulation) -> None:
    times = np.arange(200) * 1e-3
    motor = motion_plot.Motor("m", 0.01, times.copy(), 0.01 * np.arange(1, 201))
    assert np.abs(motion_plot.error_to_neighbours(motor)).max() < 1e-9
    motor.times[100] += 100e-6
    error = motion_plot.error_to_neighbours(motor)
    assert np.argmax(np.abs(error)) == 100
    assert abs(error[100]) == pytest.approx(10.0 * 100e-6, rel=0.1)  # 10 mm/s
