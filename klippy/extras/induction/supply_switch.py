"""The switch in the supply of an [induction_heater]'s bridge: option enable_pin, carried out by src/supplycmds.c.

Its MCU closes it once configured and opens it at any shutdown; nothing of this host can close it again.
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

SWITCH_FORMAT = "config_supply_switch oid=%c pin=%u active=%c interval=%u"


class SupplySwitch:
    """One pin on its MCU. `interval_s`: from edge to edge; 0: the level counts."""

    def __init__(self, mcu: Any, pin: str, invert: bool, interval_s: float, name: str) -> None:
        self._mcu, self._pin, self._invert, self._interval_s, self._name = mcu, pin, invert, interval_s, name
        self._oid = mcu.create_oid()
        mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu = self._mcu
        if mcu.try_lookup_command(SWITCH_FORMAT) is None:
            raise mcu.get_printer().config_error(
                f"Option 'enable_pin' in section '{self._name}': the firmware of MCU '{mcu.get_name()}' has no switch"
                " for a supply; flash it with this version."
            )
        mcu.add_config_cmd(
            f"config_supply_switch oid={self._oid} pin={self._pin} active={int(not self._invert)}"
            f" interval={mcu.seconds_to_clock(self._interval_s)}"
        )


def read(config: ConfigWrapper) -> SupplySwitch | None:
    """The section's switch, None without `enable_pin`."""
    pin = config.get("enable_pin", None)
    interval_s = config.getfloat("enable_interval", 0.0, minval=0.0, maxval=0.1)
    if 0.0 < interval_s < 0.001:
        raise config.error(
            f"Option 'enable_interval' in section '{config.get_name()}' ({config.where('enable_interval')}): must be 0"
            f" (the level of enable_pin counts) or 0.001 to 0.1 s from edge to edge, not {interval_s:g}."
        )
    if pin is None:
        return None
    params = config.get_printer().lookup_object("pins").lookup_pin(pin, can_invert=True)
    return SupplySwitch(params["chip"], params["pin"], bool(params["invert"]), interval_s, config.get_name())
