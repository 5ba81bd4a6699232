"""Probes that measure, from the config to the world: [simulator gauge SECTION] and the host's section of that name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from extras.simulator import GaugeSettings

from .world import Pin, World, WorldError

Config = Mapping[str, Mapping[str, str]]
LDC_ADDRESS = 42
LDC_NOISE_HZ = 12.0
# Option of the host's section -> the chip's line
PINS = {
    "dout_pin": "ready", "data_ready_pin": "ready", "intb_pin": "ready", "sclk_pin": "clock", "cs_pin": "select",
}  # fmt: skip
RATES = {"hx711": 80.0, "hx717": 320.0}


def measuring_section(config: Config) -> str | None:
    """The section whose probe measures instead of switching, if there is one."""
    names = (name for name in config if name.split()[0] in ("load_cell_probe", "probe_eddy_current"))
    return next(names, None)


def _clock_hz(config: Config, host: Mapping[str, str], kind: str) -> float:
    if kind == "ldc1612":
        return float(host.get("frequency", 12e6))
    if "pwm_clock" in host:
        return float(
            config.get(f"static_pwm_clock {host['pwm_clock'].split()[-1]}", {}).get("frequency", 100.0)
        )
    return float(host.get("clock_freq", 8192000.0))


def add_gauge(
    world: World,
    settings: GaugeSettings,
    config: Config,
    probe: int,
    parse_pin: Callable[[str], Pin],
    mcus: Mapping[str, int],
) -> int:
    """Returns its index. Raises WorldError."""
    host = config.get(settings.name)
    if host is None or "sensor_type" not in host:
        raise WorldError(
            f"Section 'simulator gauge {settings.name}' needs a section '{settings.name}' with a sensor_type."
        )
    kind = host["sensor_type"]
    pins = {line: parse_pin(host[option]) for option, line in PINS.items() if option in host}
    values = {
        **settings.values,
        "clock_hz": _clock_hz(config, host, kind),
        "rate_hz": float(host.get("sample_rate", RATES.get(kind, 0.0))),
        "i2c_mcu": -1,
        "i2c_address": 0,
    }
    if kind == "ldc1612":
        values["i2c_mcu"] = mcus[host.get("i2c_mcu", "mcu")]
        values["i2c_address"] = int(host.get("i2c_address", LDC_ADDRESS))
        coil = config.get(f"temperature_probe {settings.name.split()[-1]}", {})
        if "sensor_pin" in coil:
            pins["temperature"] = parse_pin(coil["sensor_pin"])
    return world.add_gauge(kind, probe, pins, values)
