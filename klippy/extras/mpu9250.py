"""[mpu9250]: the accelerometer MPU-9250 and its family; accelerometer/sensor.py."""

from __future__ import annotations

from configfile import ConfigWrapper

from .accelerometer import sensor


def load_config(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)


def load_config_prefix(config: ConfigWrapper) -> sensor.Accelerometer:
    return sensor.load(config)
