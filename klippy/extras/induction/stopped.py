"""A nozzle after the stop of the printer: it cools, and who looks at it must not take it for cold.

blocks still under way ─┐
a calibration's sensor ─┼─► modelled temperature, never below them ─► an alarm if they rise
current in the coil ────┘   (asked of the board once a second)        an alarm if it flows
"""

from __future__ import annotations

import math
from typing import Any

from thermal.sensing.blocks import Blocks

PERIOD_S = 0.5
FRESH_S = 5.0  # a sensor that reads the same for so long has stopped, too
ASK_S = 1.0


class StoppedWatch:
    """Of one InductionHeater, from the stop until the host disconnects."""

    def __init__(self, heater: Any) -> None:
        self.heater = heater
        self.sensor: Any = None  # a calibration's reference
        self._reactor = heater.printer.get_reactor()
        self._timer: Any = None
        self._blocks_c = math.nan
        self._read = (-math.inf, math.nan)  # since when the sensor reads this
        self._asked_s = -math.inf
        self._has_alarmed = False

    def start(self) -> None:
        heater = self.heater
        heater.shown.stopped(heater.now_s(), heater.loop.state.heat_balance.second_c)
        if heater.shown.temp_c > heater.parameters.loss.ambient_c + PERIOD_S:
            heater.printer.lookup_object("gcode").respond_info(
                f"Induction heater '{heater.section_name}': its temperature is modelled from here on"
            )
        self._timer = self._reactor.register_timer(self._on_timer, self._reactor.NOW)

    def end(self) -> None:
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None

    def take(self, blocks: Blocks) -> None:
        """They were under way."""
        news = self.heater.loop.chain.take(blocks) if self._timer is not None else None
        if news is not None and self.heater.shown.is_calibrated:
            self._blocks_c = news.temp_c

    def _on_timer(self, eventtime: float) -> float:
        heater = self.heater
        seen_c, self._blocks_c = self._blocks_c, math.nan
        if self.sensor is not None:
            read_c = self.sensor.get_temp(eventtime)[0]
            if read_c != self._read[1]:
                self._read = (eventtime, read_c)
            if eventtime - self._read[0] < FRESH_S:
                seen_c = read_c if math.isnan(seen_c) else max(read_c, seen_c)
        alarm = heater.shown.cooled(heater.now_s(), seen_c)
        if alarm:
            heater.notices.warn(alarm)
        if eventtime - self._asked_s >= ASK_S:
            self._asked_s = eventtime
            heater.unit.ask_current(self._on_current)
        return float(eventtime + PERIOD_S)

    def _on_current(self, flows: bool) -> None:
        if flows and not self._has_alarmed:
            self._has_alarmed = True
            self.heater.notices.warn(
                "current flows in the coil after the stop: its bridge still heats. Switch the supply of the bridge off"
            )
