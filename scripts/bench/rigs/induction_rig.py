"""Closed-loop rig: the thermal chain against the C plant, with a plain model of the MCU and the link between.

    InductionLoop ──PhaseCommand (down_s late)──> phase queue ─> plant.c (heat, tank, ADC)
         ^                                                          │ one code a bridge period
         └── messages of three or six records (up_s late + jitter) <── block sums, cut at phase steps

The MCU model is written from the message contract, independent of src/: its blocks are packed to bytes and
unpacked by thermal/sensing/convert.py, so that stage takes part. It refuses late commands (counted) and runs the
bridge's watchdog.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cffi
import numpy as np

from block_codec import Row, pack, take
from chelper.compiler import read_headers, run_compiler
from thermal.control import actuator, loop, nozzle_model, predictive, two_period
from thermal.control import pid as pid_control
from thermal.identification import sweep
from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.records import PhaseCommand
from thermal.sensing import (
    block_temperature,
    convert,
    features,
    heat_balance_monitor,
    laws,
    supervision,
    temperature_filter,
)

ROOT = Path(__file__).resolve().parents[3]
PLANT = ROOT / "klippy" / "simulation" / "plant"
CLOCK_HZ = 72e6
PERIOD_TICKS = 600
PERIOD_S = PERIOD_TICKS / CLOCK_HZ
CHUNK = 32  # the firmware's ADC half buffer
LONE_RECORD_S = 0.020
DATA_SIZE_MAX = 48  # of records in a message


@functools.cache
def plant_library(header: str) -> tuple[Any, Any]:
    """(ffi, lib) of C files of the plant's folder, built once per content of it."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(PLANT.glob("*.[ch]"))))
    target = ROOT / "out" / "test" / f"{Path(header).stem}-{digest.hexdigest()[:16]}.so"
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_suffix(f".{os.getpid()}")
        run_compiler(
            ["-O2", "-shared", "-fPIC", "-o", str(part), *map(str, PLANT.glob("*.c")), "-lm"], "The plant"
        )
        part.rename(target)
    ffi = cffi.FFI()
    ffi.cdef(read_headers([PLANT / header]))
    return ffi, ffi.dlopen(str(target))


class Plant:
    """The C plant with parameters by name."""

    def __init__(self, seed: int, preset: str = "reference", **values: float) -> None:
        self.ffi, self.lib = plant_library("plant.h")
        count = self.lib.plant_param_count
        self.index = {self.ffi.string(self.lib.plant_params[i].name).decode(): i for i in range(count)}
        table = [getattr(self.lib.plant_params[i], preset) for i in range(count)]
        for name, value in values.items():
            table[self.index[name]] = value
        self._p = self.ffi.gc(self.lib.plant_new(), self.lib.plant_free)
        self.lib.plant_init(self._p, self.ffi.new("double[]", table), seed)
        self._codes = np.zeros(CHUNK, dtype=np.uint16)
        self._codes_p = self.ffi.cast("uint16_t *", self._codes.ctypes.data)
        self._out = self.ffi.new("struct plant_outputs *")

    def set_param(self, name: str, value: float) -> None:
        self.lib.plant_set_param(self._p, self.index[name], value)

    def get_param(self, name: str) -> float:
        return float(self.lib.plant_get_param(self._p, self.index[name]))

    def set_phase(self, phase: float) -> None:
        self.lib.plant_set_phase(self._p, phase)

    def set_inputs(self, flow_mm3_s: float, fan: float) -> None:
        self.lib.plant_set_inputs(self._p, flow_mm3_s, fan)

    def run(self, periods: int) -> np.ndarray:
        """Let `periods` (up to CHUNK) bridge periods pass; their ADC codes."""
        self.lib.plant_advance(self._p, periods * PERIOD_S)
        self.lib.plant_sample(self._p, self._codes_p, periods, PERIOD_S)
        return self._codes[:periods]

    def read(self) -> Any:
        self.lib.plant_read(self._p, self._out)
        return self._out


def true_law(preset: str = "reference", **values: float) -> laws.TankLaw:
    """The tank law a perfect calibration of the C plant would find, from its components."""
    plant = Plant(0, preset, **values)
    v = {name: plant.get_param(name) for name in plant.index}
    omega = 2.0 * math.pi * 120e3 * (1.0 + 1e-6 * v["frequency_ppm"])
    c1_f, l2_h, l1_h = 1e-6 * v["c1_uf"] * v["c1_factor"], 1e-6 * v["l2_uh"], 1e-6 * v["l1_uh"]
    per_k = l1_h * v["l1_slope_per_k"]
    k = omega * omega * l2_h * c1_f - 1.0
    return laws.TankLaw(
        math.degrees(v["gain_units_deg"]),
        v["l1_reference_c"],
        v["r_ohm"] / (omega * per_k),
        (l2_h / k - l1_h) / per_k,
        *_saturation(v, k),
        0.0,
        v["offset_units"],
        v["offset_decay"],
        0.06,
    )


def _saturation(v: dict[str, float], k: float) -> tuple[float, float]:
    """b and q of S = exp(-b u - q u^4), u = (sin(phi/2) cos psi)^2, from the current at full drive in resonance."""
    full_a = 4.0 / math.pi * v["supply_v"] / (v["r_ohm"] * k) / v["l1_saturation_a"]
    return 0.457 * full_a**2, 0.599 * full_a**8


BLOCK_LEN, OVERSAMPLE, RECORDS = 192, 4, 3  # as [induction_heater] has them by default
MESSAGE_S, BATCH_SLACK_S = 0.0048, 0.005  # likewise: messages may wait for one another
BATCH_MESSAGES = int(loop.HELD_BATCH_S / MESSAGE_S)
BATCH_WAIT_S = BATCH_MESSAGES * MESSAGE_S + BATCH_SLACK_S


def default_parameters(**changes: Any) -> loop.LoopParameters:
    """The chain as [induction_heater] configures it by default.

    `changes` by field name of PidParameters/Timing; `law` and `front` replace those.
    """
    from extras.induction import settings as defaults

    block_s, settle_s = BLOCK_LEN * PERIOD_S, 20 * PERIOD_S
    timing = loop.Timing(
        block_s,
        settle_s,
        changes.pop("lead_s", defaults.DEFAULT_LEAD_S),
        0.100,
        control_s=defaults.DEFAULT_CONTROL_S,
    )
    pid = {
        "kp": defaults.DEFAULT_KP_W_PER_K,
        "ki": defaults.DEFAULT_KI_W_PER_K_S,
        "kd": defaults.DEFAULT_KD_W_S_PER_K,
        "output_low": 0.0,
        "output_high": 81.3,
        "derivative_s": defaults.DEFAULT_DERIVATIVE_S,
    }
    law = changes.pop("law", laws.ExpLaw())
    choice = changes.pop("control", "model")
    front = changes.pop("front", features.FeatureParameters())
    drive = DriveLaw(power_full_w=changes.pop("power_full_w", 81.3))
    max_temp_c = changes.pop("max_temp_c", 350.0)
    loss_known = changes.pop("loss_uncertainty", 0.25)
    held = changes.pop("model", {})
    pid.update(changes)
    approach = defaults.CALIBRATED_APPROACH if isinstance(law, laws.TankLaw) else loop.Approach()
    loss, heat = heat_loss.LossLaw(), heat_loss.HeatCapacity()
    balance = heat_balance_monitor.scaled(1.0, 20.0)
    return loop.LoopParameters(
        front,
        block_temperature.EstimatorParameters(law),
        _control(
            choice,
            pid_control.PidParameters(**pid),
            heat,
            balance,
            drive,
            timing,
            held,
            isinstance(law, laws.TankLaw),
        ),
        loss,
        _actuator(drive, block_s, settle_s),
        supervision.SuperviseParameters(-10.0, max_temp_c),
        timing,
        approach,
        temperature_filter.FilterParameters(loss, heat),
        heat_balance_monitor.HeatBalanceParameters(heat, balance, loss_known),
    )


def _actuator(drive: DriveLaw, block_s: float, settle_s: float) -> actuator.ActuatorParameters:
    from extras.induction import settings as defaults

    pulse_s = block_s + settle_s + defaults.SETTLE_MARGIN_SAMPLES * PERIOD_S
    return actuator.ActuatorParameters(
        drive,
        pulse_s,
        pulses_max=math.ceil(defaults.DEFAULT_CONTROL_S / pulse_s) + 1,
        watch_interval_s=defaults.DEFAULT_CONTROL_S,
        look_s=settle_s + defaults.LOOK_SAMPLES * PERIOD_S,
        long_look_s=settle_s + defaults.LONG_LOOK_SAMPLES * PERIOD_S,
    )


def _control(
    choice: str,
    pid: pid_control.PidParameters,
    heat: heat_loss.HeatCapacity,
    balance: heat_balance_monitor.TwoNodeLoss,
    drive: DriveLaw,
    timing: loop.Timing,
    held: dict[str, Any],
    calibrated: bool,
) -> loop.Control:
    power_w = drive.power_max_w
    if choice == "pid":
        return loop.Control(pid_control.PID, replace(pid, output_high=power_w), power_w)
    if choice == "watermark":
        return loop.Control(pid_control.WATERMARK, pid_control.WatermarkParameters(2.0, power_w), power_w)
    if choice == "two_period":
        return loop.Control(two_period.TWO_PERIOD, two_period.TwoPeriodParameters(power_w), power_w)
    parameters = replace(
        nozzle_model.nozzle_model(heat, balance, power_w, timing, calibrated=calibrated), **held
    )
    return loop.Control(predictive.MODEL, parameters, power_w, models=True)


@dataclass
class Trace:
    """What happened, one row a chunk (0.27 ms)."""

    t_s: list[float] = field(default_factory=list)
    target_c: list[float] = field(default_factory=list)
    skin_c: list[float] = field(default_factory=list)
    estimate_c: list[float] = field(default_factory=list)
    request_w: list[float] = field(default_factory=list)
    phase: list[int] = field(default_factory=list)

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(getattr(self, name), dtype=float) for name in self.__dataclass_fields__}


class Rig:
    """One nozzle in closed loop; call `run(until)` after changing target or plant inputs."""

    def __init__(
        self,
        plant: Plant,
        parameters: loop.LoopParameters,
        seed: int = 0,
        up_s: float = 0.003,
        down_s: float = 0.002,
        jitter_s: float = 0.005,
        drop: Callable[[random.Random], bool] | None = None,
    ) -> None:
        self.plant = plant
        self.loop = loop.InductionLoop(parameters)
        self.driver: sweep.Sweep | None = None  # takes the loop's place while it is there
        self.random = random.Random(seed)
        self.up_s, self.down_s, self.jitter_s = up_s, down_s, jitter_s
        self.drop = drop or (lambda _random: False)
        self.stream = convert.Stream(convert.ConvertParameters(OVERSAMPLE, PERIOD_TICKS, CLOCK_HZ, BLOCK_LEN))
        self.period = 0  # bridge periods since the start
        self.phase = 0
        self.late = 0  # commands that came after their time
        self.watchdog_trips = 0
        self._queue: list[tuple[int, int]] = []  # (period, phase)
        self._applied = 0  # period of the newest phase command
        self._settle = 0
        self._sum = self._count = self._max = self._first = self._discarded = 0
        self._min = 65535
        self._records: list[tuple[int, Row]] = []  # (first period, record)
        self.sent_s: list[float] = []  # when the host sent commands
        self._batch_s = 0.0
        self._sequence = 0
        self._mail: list[tuple[float, int, int, bytes]] = []  # (arrival, sequence, clock, data)
        self._last_arrival = 0.0
        self._timer_s = 0.0
        self.trace = Trace()
        self.power_j = 0.0
        self.loop.start(0.0)

    @property
    def now_s(self) -> float:
        return self.period * PERIOD_S

    # The MCU

    def _close_block(self) -> None:
        if self._count >= BLOCK_LEN // 16:
            value = self._sum >> OVERSAMPLE
            row = Row(self._count, value, self.phase, self._min, self._max, self._discarded)
            self._records.append((self._first, row))
            self._discarded = 0
        else:
            self._discarded += self._count
        self._sum = self._count = self._max = 0
        self._min = 65535

    def _take(self, codes: np.ndarray) -> None:
        start = self.period
        skip = min(self._settle, len(codes))
        self._settle -= skip
        self._discarded += skip
        codes, start = codes[skip:], start + skip
        while len(codes):
            if not self._count:
                self._first = start
            part = codes[: BLOCK_LEN - self._count]
            self._sum += int(part.sum(dtype=np.int64))
            self._min = min(self._min, int(part.min()))
            self._max = max(self._max, int(part.max()))
            self._count += len(part)
            codes, start = codes[len(part) :], start + len(part)
            if self._count == BLOCK_LEN:
                self._close_block()

    def _flush(self) -> None:
        """Send records together, fewer when one has waited long enough."""
        while self._records:
            first, row = self._records[0]
            waited_s = (self.period - first - row.count) * PERIOD_S
            if len(self._records) < RECORDS and waited_s < LONE_RECORD_S:
                break
            batch = self._records[:RECORDS]
            while len(data := pack([row for _, row in batch], BLOCK_LEN)) > DATA_SIZE_MAX:
                batch.pop()
            del self._records[: len(batch)]
            base = batch[0][0]
            sequence, self._sequence = self._sequence, self._sequence + len(batch)
            if self.drop(self.random):
                continue
            arrival = self.now_s + self.up_s + self.random.random() * self.jitter_s
            arrival = max(arrival, self._last_arrival)
            self._last_arrival = arrival
            self._mail.append((arrival, sequence & 0xFFFF, base * PERIOD_TICKS, data))

    def _set_phase(self, phase: int) -> None:
        self._applied = self.period
        if phase == self.phase:
            return
        self._close_block()
        self.phase = phase
        self._settle = 20
        self.plant.set_phase(phase)

    # The host

    def _send(self, commands: list[PhaseCommand]) -> None:
        if commands:  # a plan: what was pending from its first time on is void
            self.sent_s.append(self.now_s)
            first = round(commands[0].time_s / PERIOD_S)
            self._queue = [entry for entry in self._queue if entry[0] < first]
        for command in commands:
            period = round(command.time_s / PERIOD_S)
            if command.time_s < self.now_s + self.down_s:
                self.late += 1
            assert not self._queue or period >= self._queue[-1][0], "commands out of order"
            self._queue.append((max(period, self.period), command.phase_ticks))
        self._batch_s = 0.0 if self.driver is not None else self.loop.patience_s()

    def set_target(self, target_c: float) -> None:
        self._send(self.loop.set_target(target_c, self.now_s))

    def _host(self) -> None:
        now_s = self.now_s
        batch = [mail for mail in self._mail if mail[0] <= now_s]
        count = max(1, int(self._batch_s / MESSAGE_S))
        wait_s = count * MESSAGE_S + BATCH_SLACK_S if self._batch_s else 0.0
        if len(batch) >= count or (batch and now_s - batch[0][0] >= wait_s):
            del self._mail[: len(batch)]
            blocks = take(self.stream, CLOCK_HZ, *(mail[1:] for mail in batch))
            self._send((self.driver or self.loop).on_blocks(blocks, now_s))
        if now_s >= self._timer_s:
            refresh_s = self.loop.parameters.timing.refresh_s
            self._timer_s = now_s + refresh_s
            if self.driver is not None:
                self._timer_s = now_s + 0.010
                self._send(self.driver.on_timer(now_s))
            elif now_s - self.loop.state.decided_s >= refresh_s:
                self._send(self.loop.on_timer(now_s))

    # The world

    def run(self, duration_s: float) -> None:
        """Let time pass."""
        end = self.period + round(duration_s / PERIOD_S)
        trace = self.trace
        while self.period < end:
            self._host()
            while self._queue and self._queue[0][0] <= self.period:
                self._set_phase(self._queue.pop(0)[1])
            if self.phase and (self.period - self._applied) * PERIOD_S > 0.100:
                self.watchdog_trips += 1
                self._set_phase(0)
            periods = min(CHUNK, end - self.period)
            if self._queue:
                periods = min(periods, self._queue[0][0] - self.period)
            codes = self.plant.run(periods)
            self._take(codes)
            self.period += periods
            self._flush()
            out = self.plant.read()
            self.power_j += out.power_w * periods * PERIOD_S
            state = self.loop.state
            trace.t_s.append(self.now_s)
            trace.target_c.append(state.target_c)
            trace.skin_c.append(out.skin_c)
            trace.estimate_c.append(state.estimate.temp_c)
            trace.request_w.append(state.request.power_w)
            trace.phase.append(self.phase)
