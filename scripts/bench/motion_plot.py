#!/usr/bin/env python3
"""Draw what the motors do: position, velocity, acceleration and step error over time.

    scripts/bench/motion_plot.py batch DICT OUT --config printer.cfg --out motion.png [--from S] [--to S]
            [--stepper NAME]
    scripts/bench/motion_plot.py live SOCKET --seconds 10 --out motion.png

batch reads the output of a batch run (klippy.py -i -o); the config says which motor a step pin belongs to and how far
a step goes. live subscribes to motion_report/dump_stepper and dump_trapq of a running host.

The step error is the time by which a step comes earlier or later than smooth motion would have it: with a live host
against the planned motion of the axes (of machines whose motors follow them linearly), otherwise against the parabola
through the steps around it. Compression may shift a step by up to 25 us.

Exit status 0 drawn, 2 bad input.
"""

from __future__ import annotations

import harness

import argparse
import configparser
import json
import re
import socket
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "klippy"))

import msgproto
import parsedump

Array = NDArray[np.float64]

END = b"\x03"
WINDOW_STEPS = 16  # steps on each side that a local parabola is fitted through
GRID_S = 0.001  # velocity and acceleration are worked out on a grid
SMOOTH_S = 0.008
COMPRESSION_US = 25.0  # a step may be shifted by so much
ERROR_SCALE_US = 30.0  # the scale is this at least, and holds this percentage of the steps
ERROR_SHOWN_PERCENT = 99.0
SLOWEST_MM_S = 0.5  # below, a step's error in time says nothing
LINEAR_MISS_STEPS = 1.5  # a motor that follows the axes linearly is never farther from them


class PlotError(Exception):
    """Text for people."""


@dataclass
class Motor:
    """Steps of one stepper: when, and where it stands after each (mm, or mm of filament)."""

    name: str
    step_mm: float
    times: Array = field(default_factory=lambda: np.zeros(0))
    positions: Array = field(default_factory=lambda: np.zeros(0))

    def between(self, start_s: float, end_s: float) -> Motor:
        inside = (self.times >= start_s) & (self.times < end_s)
        return Motor(self.name, self.step_mm, self.times[inside], self.positions[inside])


@dataclass
class Plan:
    """Stretches of constant acceleration of one motion queue, as motion_report/dump_trapq gives them."""

    rows: list[Any] = field(default_factory=list)

    def coordinates(self, times: Array) -> Array:
        """(n, 3): x, y, z at these times; at rest between the stretches."""
        starts = np.array([row[0] for row in self.rows])
        number = np.clip(np.searchsorted(starts, times, "right") - 1, 0, None)
        table = np.array([[row[1], row[2], row[3], *row[4], *row[5]] for row in self.rows])
        duration, speed, accel = table[number, 0], table[number, 1], table[number, 2]
        t = np.clip(times - starts[number], 0.0, duration)
        way = (speed + 0.5 * accel * t) * t
        places: Array = table[number, 3:6] + table[number, 6:9] * way[:, None]
        return places


def run_steps(first: float, interval: int, count: int, add: int) -> Array:
    """Clocks of the steps of one command, of which the first comes at `first`."""
    k = np.arange(abs(count), dtype=float)
    clocks: Array = first + k * interval + add * k * (k + 1.0) / 2.0
    return clocks


# --- batch output ---


def step_lengths(path: Path) -> dict[str, tuple[str, float]]:
    """Step pin (without marks) → (section, mm per step), from a printer config."""
    text = path.read_text(encoding="utf-8")
    reader = configparser.RawConfigParser(
        strict=False, inline_comment_prefixes=("#", ";"), delimiters=(":", "=")
    )
    try:
        reader.read_string(text)
    except configparser.Error as e:
        raise PlotError(f"{path}: {e}") from None
    found: dict[str, tuple[str, float]] = {}
    for section in reader.sections():
        options = reader[section]
        if "step_pin" not in options or "rotation_distance" not in options:
            continue
        turns = 1.0
        for pair in options.get("gear_ratio", "").split(","):
            if ":" in pair:
                driven, driving = pair.split(":")
                turns *= float(driven) / float(driving)
        full = float(options.get("full_steps_per_rotation", "200"))
        steps = full * float(options.get("microsteps", "16")) * turns
        pin = re.sub(r"^[!^~\s]*(?:[^:]*:)?\s*", "", options["step_pin"])
        found[pin] = (section, float(options["rotation_distance"]) / steps)
    return found


def read_batch(dictionary: Path, output: Path, lengths: dict[str, tuple[str, float]]) -> list[Motor]:
    """The motors of one MCU."""
    parser = msgproto.MessageParser()
    try:
        parser.process_identify(dictionary.read_bytes(), decompress=False)
        freq = parser.get_constant_float("CLOCK_FREQ")
        lines = parsedump.decode(parser, output)
        return list(_decode(lines, freq, lengths))
    except (OSError, msgproto.error) as e:
        raise PlotError(str(e)) from None


@dataclass
class _Trace:
    pin: str
    clock: int = 0
    forward: int = 1
    commands: list[tuple[int, int, int, int]] = field(
        default_factory=list
    )  # clock before, interval, count, add


def _decode(lines: Iterable[str], freq: float, lengths: dict[str, tuple[str, float]]) -> Iterable[Motor]:
    traces: dict[str, _Trace] = {}
    for line in lines:
        name, _, rest = line.partition(" ")
        if name not in ("config_stepper", "reset_step_clock", "set_next_step_dir", "queue_step"):
            continue
        value = dict(word.split("=", 1) for word in rest.split() if "=" in word)
        if name == "config_stepper":
            traces[value["oid"]] = _Trace(value["step_pin"])
            continue
        trace = traces[value["oid"]]
        if name == "reset_step_clock":  # 32 bits on the wire
            trace.clock += (int(value["clock"]) - trace.clock) & 0xFFFFFFFF
        elif name == "set_next_step_dir":
            trace.forward = 1 if value["dir"] == "1" else -1
        else:
            interval, count, add = int(value["interval"]), int(value["count"]), int(value["add"])
            trace.commands.append((trace.clock, interval, trace.forward * count, add))
            trace.clock += interval * count + add * count * (count - 1) // 2
    for trace in traces.values():
        section, step_mm = lengths.get(trace.pin, (f"pin {trace.pin}", 1.0))
        motor = Motor(section, step_mm)
        if trace.commands:
            clocks = [run_steps(c + i, i, n, a) for c, i, n, a in trace.commands]
            ways = [np.full(abs(n), np.sign(n), dtype=float) for _, _, n, _ in trace.commands]
            motor.times = np.concatenate(clocks) / freq
            motor.positions = np.cumsum(np.concatenate(ways)) * step_mm
        yield motor


# --- live ---


class LiveHost:
    """A connection to the API socket, collecting both streams."""

    def __init__(self, path: str) -> None:
        self.motors: dict[str, list[dict[str, Any]]] = {}
        self.plans: dict[str, Plan] = {}
        self._rest = b""
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._sock.connect(path)
        except OSError as e:
            raise PlotError(f"{path}: {e.strerror}") from None

    def _messages(self, until: float) -> Iterable[dict[str, Any]]:
        while (left_s := until - time.monotonic()) > 0.0:
            while END in self._rest:
                message, _, self._rest = self._rest.partition(END)
                yield json.loads(message)
            self._sock.settimeout(max(0.01, left_s))
            try:
                data = self._sock.recv(1 << 16)
            except TimeoutError:
                return
            if not data:
                raise PlotError("the host has closed the connection")
            self._rest += data

    def ask(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        self._sock.sendall(json.dumps({"id": 1, "method": method, "params": params}).encode() + END)
        for message in self._messages(time.monotonic() + 5.0):
            if message.get("id") == 1:
                if "error" in message:
                    raise PlotError(f"{method}: {message['error']['message']}")
                return dict(message["result"])
            self.take(message)
        raise PlotError(f"{method}: no answer")

    def subscribe(self) -> None:
        status = self.ask("objects/query", {"objects": {"motion_report": None}})["status"]["motion_report"]
        for kind, names in (("stepper", status["steppers"]), ("trapq", status["trapq"])):
            for name in names:
                template = {"kind": kind, "name": name}
                self.ask(f"motion_report/dump_{kind}", {"name": name, "response_template": template})

    def take(self, message: dict[str, Any]) -> None:
        """Sort a message of a stream in."""
        if message.get("kind") == "stepper":
            self.motors.setdefault(message["name"], []).append(message["params"])
        elif message.get("kind") == "trapq":
            self.plans.setdefault(message["name"], Plan()).rows += message["params"]["data"]

    def collect(self, seconds: float) -> None:
        for message in self._messages(time.monotonic() + seconds):
            self.take(message)


def motor_from_stream(name: str, messages: list[dict[str, Any]]) -> Motor:
    """The steps in messages of motion_report/dump_stepper."""
    motor = Motor(name, messages[0]["step_distance"])
    times, positions = [], []
    for message in messages:
        first, last = message["first_clock"], message["last_clock"]
        ticks, commands = [], []
        clock = first - message["data"][0][0]
        for interval, count, add in message["data"]:
            n = abs(count)
            ticks.append(run_steps(clock + interval, interval, count, add))
            commands.append(np.full(n, np.sign(count), dtype=float))
            clock += interval * n + add * n * (n - 1) // 2
        clocks, ways = np.concatenate(ticks), np.concatenate(commands)
        scale = (message["last_time"] - message["first_time"]) / (last - first) if last > first else 0.0
        times.append(message["first_time"] + (clocks - first) * scale)
        positions.append(message["first_position"] + np.cumsum(ways) * motor.step_mm)
    motor.times, motor.positions = np.concatenate(times), np.concatenate(positions)
    return motor


# --- figures ---


def on_grid(motor: Motor) -> tuple[Array, Array, Array, Array]:
    """(times, positions, velocities, accelerations) on a grid, smoothed over SMOOTH_S."""
    grid = np.arange(motor.times[0], motor.times[-1] + GRID_S, GRID_S)
    # half a step before each edge: there the wanted position passed
    ways = np.diff(
        motor.positions, prepend=2.0 * motor.positions[0] - motor.positions[min(1, len(motor.positions) - 1)]
    )
    middles = motor.positions - 0.5 * ways
    position = np.interp(grid, motor.times, middles)
    width = max(3, int(SMOOTH_S / GRID_S))
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()

    def smooth(values: Array) -> Array:
        return np.convolve(np.pad(values, width, mode="edge"), window, mode="same")[width:-width]

    velocity = smooth(np.gradient(position, GRID_S))
    return grid, position, velocity, smooth(np.gradient(velocity, GRID_S))


def error_to_plan(motor: Motor, plan: Plan) -> Array | None:
    """Position error (mm) against the best linear following of the planned axes; None if it does not fit."""
    if not plan.rows or len(motor.times) < 10:
        return None
    axes = np.column_stack([plan.coordinates(motor.times), np.ones(len(motor.times))])
    ways = np.sign(np.diff(motor.positions, prepend=motor.positions[0] - motor.step_mm))
    wanted = motor.positions - 0.5 * motor.step_mm * ways
    mix, *_ = np.linalg.lstsq(axes, wanted, rcond=None)
    error: Array = wanted - axes @ mix
    return error if np.abs(error).max() < LINEAR_MISS_STEPS * motor.step_mm else None


def error_to_neighbours(motor: Motor) -> Array:
    """Position error (mm) of each step against the parabola through the steps around it."""
    n = 2 * WINDOW_STEPS + 1
    error = np.zeros(len(motor.times))
    if len(motor.times) < n:
        return error
    times = np.lib.stride_tricks.sliding_window_view(motor.times, n)
    places = np.lib.stride_tricks.sliding_window_view(motor.positions, n)
    t = times - times[:, WINDOW_STEPS : WINDOW_STEPS + 1]
    scale = np.abs(t).max(axis=1, keepdims=True)
    base = np.stack([np.ones_like(t), t / scale, (t / scale) ** 2], axis=2)
    normal = np.einsum("nki,nkj->nij", base, base)
    right = np.einsum("nki,nk->ni", base, places - places[:, :1])
    fitted = np.linalg.solve(normal, right[:, :, None])[:, 0, 0]
    error[WINDOW_STEPS:-WINDOW_STEPS] = places[:, WINDOW_STEPS] - places[:, 0] - fitted
    return error


def draw_errors(axes: Axes, errors: list[tuple[Array, Array]]) -> None:
    """Step errors in µs over time, on a scale that fits; marks at its edge for what goes beyond."""
    every = np.concatenate([np.abs(error_us) for _, error_us in errors] or [np.zeros(1)])
    scale = max(ERROR_SCALE_US, 1.2 * float(np.percentile(every, ERROR_SHOWN_PERCENT)) if every.size else 0.0)
    for times, error_us in errors:
        (dots,) = axes.plot(times, error_us, ".", ms=1.5)
        for sign, mark in ((1.0, "^"), (-1.0, "v")):
            beyond = sign * error_us > scale
            marks = np.full(int(beyond.sum()), sign * 0.97 * scale)
            axes.plot(times[beyond], marks, mark, ms=4, color=dots.get_color())
    for limit_us in (-COMPRESSION_US, COMPRESSION_US):
        axes.axhline(limit_us, color="0.4", lw=0.7, ls="--")
    cut = int((every > scale).sum())
    title = f"Step error (dashed: compression; large at corners without a plan); {cut} of {every.size} beyond"
    axes.set(ylabel="step error, µs", xlabel="print time, s", ylim=(-scale, scale))
    axes.set_title(title, fontsize=9, loc="left")


def draw(motors: list[Motor], plans: dict[str, Plan], figure: Figure, title: str) -> None:
    """Four panels over a common time."""
    figure.suptitle(title)
    place, speed, accel, miss = figure.subplots(4, 1, sharex=True)
    errors = []
    for motor in motors:
        if len(motor.times) < 3:
            continue
        grid, position, velocity, acceleration = on_grid(motor)
        place.plot(grid, position, lw=0.8, label=motor.name)
        speed.plot(grid, velocity, lw=0.8)
        accel.plot(grid, acceleration, lw=0.8)
        plan = plans.get(motor.name) or plans.get("toolhead")
        error = error_to_plan(motor, plan) if plan else None
        if error is None:
            error = error_to_neighbours(motor)
        local = np.interp(motor.times, grid, velocity)
        fast = np.abs(local) > SLOWEST_MM_S
        errors.append((motor.times[fast], 1e6 * error[fast] / local[fast]))
    draw_errors(miss, errors)
    place.set(ylabel="position, mm")
    place.legend(loc="upper right", fontsize="small")
    speed.set(ylabel="velocity, mm/s")
    accel.set(ylabel="acceleration, mm/s²")
    for axes, name in (
        (place, "Position"),
        (speed, "Velocity"),
        (accel, f"Acceleration, over {1e3 * SMOOTH_S:.0f} ms"),
    ):
        axes.set_title(name, fontsize=9, loc="left")
    for axes in (place, speed, accel, miss):
        axes.margins(x=0.01)
        axes.grid(alpha=0.3)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    batch = kinds.add_parser("batch", help="from the output of a batch run")
    batch.add_argument("dictionary", type=Path)
    batch.add_argument("output", type=Path)
    batch.add_argument("--config", type=Path, required=True)
    live = kinds.add_parser("live", help="from a running host")
    live.add_argument("socket")
    live.add_argument("--seconds", type=float, default=10.0)
    for kind in (batch, live):
        kind.add_argument("--out", type=Path, default=Path("motion.png"))
        kind.add_argument("--from", dest="start", type=float, default=-np.inf, help="print time, s")
        kind.add_argument("--to", dest="end", type=float, default=np.inf)
        kind.add_argument("--stepper", action="append", help="only this one (repeatable)")
    options = parser.parse_args(argv)
    try:
        plans: dict[str, Plan] = {}
        if options.kind == "batch":
            motors = read_batch(options.dictionary, options.output, step_lengths(options.config))
        else:
            host = LiveHost(options.socket)
            host.subscribe()
            host.collect(options.seconds)
            motors, plans = [motor_from_stream(n, m) for n, m in host.motors.items()], host.plans
        motors = [m.between(options.start, options.end) for m in motors]
        motors = [m for m in motors if len(m.times) and (not options.stepper or m.name in options.stepper)]
        if not motors:
            raise PlotError("nothing moves in that time")
    except (OSError, PlotError) as e:
        print(f"motion_plot: {e}", file=sys.stderr)
        return 2
    figure = Figure(figsize=(12, 10), layout="constrained")
    draw(
        motors, plans, figure, f"Motors, from {options.output if options.kind == 'batch' else options.socket}"
    )
    figure.savefig(options.out, dpi=110)
    for motor in motors:
        print(f"{motor.name}: {len(motor.times)} steps in {motor.times[-1] - motor.times[0]:.3f} s")
    print(f"written to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
