"""[adxl345]: the accelerometer ADXL345; accelerometer/sensor.py."""

from __future__ import annotations

from configfile import ConfigWrapper

from .accelerometer import sensor
from .accelerometer.commands import AccelCommandHelper

__all__ = ("AccelCommandHelper", "load_config", "load_config_prefix")


def load_config(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)


def load_config_prefix(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)
