"""[bmi160]: the accelerometer BMI160; accelerometer/sensor.py."""

from __future__ import annotations

from configfile import ConfigWrapper

from .accelerometer import sensor


def load_config(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)


def load_config_prefix(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)
