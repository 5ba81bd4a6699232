"""The nozzle temperature that people see, and where it comes from.

measured    the calibrated sensing law, smoothed
reference   a calibration's reference sensor, or a reading that was just typed
estimated   no calibrated law: the heat that went in, from the newest reading on
modelled    after a stop: cooling by the model, never below what blocks or a reference sensor still show
"""

from __future__ import annotations

import math

from thermal.control import loop
from thermal.identification.sweep import Sweep
from thermal.records import PhaseCommand, TempEstimate
from thermal.sensing.blocks import Blocks
from thermal.sensing.heat_balance_monitor import HeatBalanceParameters
from thermal.sensing.pipeline import Chain

MEASURED, REFERENCE, ESTIMATED, MODELLED = "measured", "reference", "estimated", "modelled"
MEAN_POWER_S = 1.0  # a calibration visits all powers, some ms each: what is shown is the mean
FRESH_S = 1.0  # an older reading of a reference is carried on by the heat
STEP_S = 0.1  # of the model; its shortest time constant is some seconds
ALARM_C = 15.0  # a nozzle that warms by this much after a stop is alarmed


class HeatModel:
    """Nozzle and second mass, followed from the heat that goes in."""

    def __init__(self, balance: HeatBalanceParameters, temp_c: float, second_c: float) -> None:
        self.balance, self.temp_c, self.second_c = balance, temp_c, second_c

    def advance(self, span_s: float, heat_j: float) -> None:
        steps = max(1, math.ceil(span_s / STEP_S))
        dt_s, loss = span_s / steps, self.balance.loss
        for _ in range(steps):
            out_j = loss.skin_out_w(self.temp_c, self.second_c) * dt_s
            self.second_c += loss.second_rate(self.temp_c, self.second_c) * dt_s
            self.temp_c += (heat_j / steps - out_j) / self.balance.heat.at(self.temp_c)


class ShownTemperature:
    """What `temperature` and `temperature_source` say. Times are print times."""

    def __init__(self, parameters: loop.LoopParameters, smooth_time_s: float) -> None:
        self.temp_c = 0.0
        self.source = MEASURED
        self._smooth_s = smooth_time_s
        self._measured_s = self._read_s = -math.inf
        self._model: HeatModel | None = None
        self._model_s = 0.0
        self._lowest_c = math.inf  # seen since a stop
        self.is_calibrated = False
        self.use(parameters)

    def use(self, parameters: loop.LoopParameters) -> None:
        """A calibrated law is shown; without one the model begins where the nozzle was seen last."""
        self._balance = parameters.heat_balance
        self.is_calibrated = parameters.supervise.calibrated

    def start(self, now_s: float) -> None:
        ambient_c = self._balance.loss.ambient_c
        self._model, self._model_s = HeatModel(self._balance, ambient_c, ambient_c), now_s
        self.source = MEASURED if self.is_calibrated else ESTIMATED
        self.temp_c = 0.0 if self.is_calibrated else ambient_c

    def measured(self, news: TempEstimate) -> None:
        """First-order, over `smooth_time`."""
        since_s = news.time_s - self._measured_s
        if not self.is_calibrated or not news.valid or since_s <= 0.0:
            return
        share = since_s / (since_s + self._smooth_s) if since_s < math.inf else 1.0
        self.temp_c += (news.temp_c - self.temp_c) * share
        self._measured_s, self.source = news.time_s, MEASURED

    def referred(self, temp_c: float, now_s: float) -> None:
        """A reading of a calibration's reference."""
        self._read_s, self.temp_c, self.source = now_s, temp_c, REFERENCE
        if self._model is not None:
            self._model.temp_c = temp_c

    def is_referred(self, now_s: float) -> bool:
        """A reference sensor reads now."""
        return now_s - self._read_s <= FRESH_S

    def heated(self, now_s: float, heat_j: float) -> None:
        """So much heat went in since the last call; shown where nothing measures."""
        model, span_s = self._model, now_s - self._model_s
        if model is None or span_s <= 0.0:
            return
        model.advance(span_s, heat_j)
        self._model_s = now_s
        if not self.is_calibrated and not self.is_referred(now_s):
            self.temp_c, self.source = model.temp_c, ESTIMATED

    # After a stop

    def stopped(self, now_s: float, second_c: float) -> None:
        """Nothing is measured from now on. `second_c`: of the second mass, NaN if not known."""
        second_c = self.temp_c if math.isnan(second_c) else second_c
        self._model, self._model_s = HeatModel(self._balance, self.temp_c, second_c), now_s
        self.source, self._lowest_c = MODELLED, self.temp_c

    def cooled(self, now_s: float, seen_c: float) -> str:
        """`seen_c`: what blocks or a reference show, NaN: nothing. An alarm for people, "" while it cools."""
        model = self._model
        if model is None or now_s <= self._model_s:
            return ""
        model.advance(now_s - self._model_s, 0.0)
        self._model_s = now_s
        if not math.isnan(seen_c):
            model.temp_c = max(model.temp_c, seen_c)
            self._lowest_c = min(self._lowest_c, seen_c)
        self.temp_c = model.temp_c
        if math.isnan(seen_c) or seen_c < self._lowest_c + ALARM_C:
            return ""
        self._lowest_c = seen_c  # said again after as much more
        return f"the nozzle gets hotter after the stop ({seen_c:.0f} C): switch the supply of its bridge off"


class SweepView:
    """What status shows while a sweep commands the bridge: temperature by the law in force, and the power given, a
    mean over the last second."""

    def __init__(self, run: Sweep, p: loop.LoopParameters, now_s: float) -> None:
        self.run = run
        self._chain = Chain()  # the loop's own must not remember what the calibration does
        self._chain.use(p.front, p.estimator, p.supervise, p.actuator.law, p.filter)
        self.command = PhaseCommand(now_s, 0, 0.0)
        self.power_w = 0.0
        self._heat_j = 0.0

    def take(self, blocks: Blocks) -> TempEstimate | None:
        news = self._chain.take(blocks)
        self._chain.samples()
        return news

    def note(self, commands: list[PhaseCommand]) -> None:
        for command in commands:
            span_s = command.time_s - self.command.time_s
            self._heat_j += self.command.power_w * max(0.0, span_s)
            self.power_w += (self.command.power_w - self.power_w) * (1.0 - math.exp(-span_s / MEAN_POWER_S))
            self.command = command

    def take_heat_j(self) -> float:
        """Commanded since last asked."""
        heat_j, self._heat_j = self._heat_j, 0.0
        return heat_j
