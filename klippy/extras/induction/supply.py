"""The bridge's supply voltage, measured, for an [induction_heater]: options vdc_pin, vdc_scale.

Heat goes with V^1.5 and the steel's saturation with V, so a sagging supply costs power and moves the thermometer.
Without a sensor the option `vdc` is used.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from configfile import ConfigWrapper

REPORT_S = 0.050
SAMPLE_S = 0.001
SAMPLES = 8
SMOOTH = 0.3  # share of a new report: ripple of the mains is not the supply's mean
MIN_V = 5.0  # below, the wire is off or the supply is: keep what was known


class SupplySensor:
    """An ADC pin behind a divider; the heater gets each change of the voltage."""

    def __init__(self, adc: Any, volt_full_scale: float) -> None:
        self.volt_full_scale = volt_full_scale
        self.volt: float | None = None
        self._heater: Any = None
        adc.setup_adc_sample(SAMPLE_S, SAMPLES)
        adc.setup_adc_callback(REPORT_S, self._on_adc)

    def serve(self, heater: Any) -> None:
        self._heater = heater

    def _on_adc(self, read_time: float, value: float) -> None:
        volt = value * self.volt_full_scale
        if volt < MIN_V:
            return
        self.volt = volt if self.volt is None else self.volt + SMOOTH * (volt - self.volt)
        if self._heater is not None:
            set_supply(self._heater, self.volt)


def set_supply(heater: Any, volt: float) -> None:
    """Put a voltage into the drive law and the sensing law of a heater."""
    parameters = heater.parameters
    drive = parameters.actuator.law
    if abs(volt - drive.vdc_v) < 0.01:
        return
    law = replace(drive, vdc_v=volt)
    changed = replace(
        parameters,
        actuator=replace(parameters.actuator, law=law),
        estimator=replace(parameters.estimator, supply=volt / drive.vdc_reference_v),
    )
    heater.parameters = heater.loop.parameters = changed


def read(config: ConfigWrapper) -> SupplySensor | None:
    """The section's sensor, None without `vdc_pin`."""
    pin = config.get("vdc_pin", None)
    if pin is None:
        return None
    scale = config.getfloat("vdc_scale", above=0.0)  # volts at the ADC's full scale
    return SupplySensor(config.get_printer().lookup_object("pins").setup_pin("adc", pin), scale)
