"""`control: mcu_onoff`: the MCU switches the heater by itself, the host says at which reading (HydraRaptor 2007).

    target degC ─► curve ─► reading ─► set_onoff (once a second) ─► MCU: on below, off above, metered
                                                                  ◄─ onoff_state: clock, on_ticks ─► average power

For slow heaters on small MCUs. The sensor must be an ADC one on the heater's own MCU. Guards: the reading must lie
within min_temp..max_temp or the MCU turns the pin off (and stops the printer, as for any sensor); without news from
the host for MAX_HEAT_TIME_S it turns it off and stops too.
"""

from __future__ import annotations

import math
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

from .laws import HeaterLaw
from .ordinary import MAX_HEAT_TIME_S, AnySensor, Heater, HeaterSettings

RENEW_S = 1.0
POWER_S = 10.0  # time constant of the reported average power
FULL_16_BIT = 0xFFFF


class OnOffUnit:
    """The firmware's config_onoff, and what it meters."""

    def __init__(self, config: ConfigWrapper, sensor: Any) -> None:
        printer = config.get_printer()
        text = config.get("heater_pin")
        pin = printer.lookup_object("pins").lookup_pin(text, can_invert=True)
        self._mcu = pin["chip"]
        self._pin, self._invert = pin["pin"], pin["invert"]
        self._adc: Any = getattr(sensor, "mcu_adc", None)
        self._curve: Any = getattr(sensor, "curve", None)
        if self._adc is None or self._curve is None or self._adc.get_mcu() is not self._mcu:
            raise config.error(
                f"Section '{config.get_name()}': control: mcu_onoff needs an ADC sensor (a thermistor or the like)"
                " on the heater's own MCU"
            )
        self.power = 0.0  # mean share of full power
        self._oid = self._mcu.create_oid()
        self._set: Any = None
        self._seen: tuple[int, int] | None = None  # (clock, on_ticks)
        self._mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Any:
        return self._mcu

    def _build_config(self) -> None:
        mcu = self._mcu
        analog_oid = self._adc.get_oid()
        ticks = mcu.seconds_to_clock(MAX_HEAT_TIME_S)
        mcu.add_config_cmd(
            f"config_onoff oid={self._oid} pin={self._pin} analog_oid={analog_oid} invert={int(self._invert)}"
            f" max_duration={ticks}"
        )
        mcu.register_response(self._on_state, "onoff_state", self._oid)
        self._set = mcu.lookup_command(
            "set_onoff oid=%c enable=%c set_point=%hu rising=%c low=%hu high=%hu",
            cq=mcu.alloc_command_queue(),
        )

    def _reading(self, temp_c: float) -> int:
        """The sum of one group of samples at this temperature."""
        share = min(1.0, max(0.0, self._curve.calc_adc(temp_c)))
        return min(FULL_16_BIT, round(share * self._adc.get_full_scale()))

    def send(self, target_c: float, min_c: float, max_c: float) -> None:
        """Hold this temperature for the next MAX_HEAT_TIME_S; 0: off."""
        ends = sorted((self._reading(min_c), self._reading(max_c)))
        rising = self._reading(max_c) > self._reading(min_c)
        enable = target_c > 0.0
        point = self._reading(target_c) if enable else 0
        self._set.send([self._oid, int(enable), point, int(rising), ends[0], ends[1]])

    def _on_state(self, params: dict[str, Any]) -> None:
        clock, on_ticks = params["clock"], params["on_ticks"]
        if self._seen is not None:
            passed = (clock - self._seen[0]) & 0xFFFFFFFF
            was_on = (on_ticks - self._seen[1]) & 0xFFFFFFFF
            if passed:
                share = min(1.0, was_on / passed)
                weight = -math.expm1(-passed / self._mcu.seconds_to_clock(POWER_S))
                self.power += (share - self.power) * weight
        self._seen = (clock, on_ticks)


class OnOffHeater(Heater):
    """An ordinary heater whose pin the MCU switches; `power` is the metered average."""

    def __init__(
        self, printer: Printer, settings: HeaterSettings, sensor: AnySensor, law: HeaterLaw, unit: OnOffUnit
    ) -> None:
        super().__init__(printer, settings, sensor, law, unit)
        self.unit = unit
        self._sent = (-math.inf, 0.0)  # (print time, target) of the last set_onoff

    def _act(self, read_time_s: float, temp_c: float, target_c: float) -> None:
        self.law.decide(read_time_s, temp_c, target_c)
        self._send(read_time_s, target_c)

    def _send(self, time_s: float, target_c: float) -> None:
        due = target_c > 0.0 and time_s >= self._sent[0] + RENEW_S
        if (due or target_c != self._sent[1]) and not self._stopped:
            self._sent = time_s, target_c
            self.unit.send(target_c, self.min_temp, self.max_temp)
        self._duty = self.unit.power

    def acquire(self, run: Any) -> None:
        raise self.printer.command_error(
            f"Heater '{self.name}' is switched by its MCU (control: mcu_onoff): there is nothing to calibrate"
        )

    def set_control(self, law: HeaterLaw, keep_target: bool = False) -> HeaterLaw:
        if law.name != "mcu_onoff":
            raise self.printer.command_error(
                f"Heater '{self.name}' is switched by its MCU: change control: in printer.cfg and restart"
            )
        return super().set_control(law, keep_target)


def build(config: ConfigWrapper, settings: HeaterSettings, sensor: Any, law: HeaterLaw) -> OnOffHeater:
    """Heater of a section with control: mcu_onoff; raises the config's error if the sensor cannot serve."""
    if settings.max_power < 1.0:
        raise config.error(f"Section '{settings.name}': control: mcu_onoff is on or off, max_power must be 1")
    return OnOffHeater(config.get_printer(), settings, sensor, law, OnOffUnit(config, sensor))
