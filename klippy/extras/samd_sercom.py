"""[samd_sercom NAME]: the pins of a SERCOM of a SAMD board, before anything uses it as a SPI or I2C bus."""

from __future__ import annotations

from configfile import ConfigWrapper

PIN_TYPES = ("tx", "rx", "clk")


def load_config_prefix(config: ConfigWrapper) -> None:
    name = config.get_name()
    pins = config.get_printer().lookup_object("pins")
    sercom = config.get("sercom")
    rx_pin = config.get("rx_pin", None)
    used = {"tx": config.get("tx_pin"), "clk": config.get("clk_pin"), **({"rx": rx_pin} if rx_pin else {})}
    lines = {kind: pins.lookup_pin(pin, share_type=sercom) for kind, pin in used.items()}
    mcu = lines["tx"]["chip"]
    for kind, params in lines.items():
        if params["chip"] is not mcu:
            raise config.error(
                f"Option '{kind}_pin' in section '{name}': all pins must be on the same board"
                f" ({config.where(f'{kind}_pin')})."
            )

    def build_config() -> None:
        known = mcu.get_enumerations().get("bus")
        if known is None:
            return  # a board without buses has no command for their pins either, a check without boards has any
        if "sercom_pin_type" not in mcu.get_enumerations() or sercom not in known:
            raise config.error(
                f"Option 'sercom' in section '{name}': board '{mcu.get_name()}' has no '{sercom}', only"
                f" {', '.join(known)} ({config.where('sercom')})."
            )

    for kind in PIN_TYPES:
        if kind in lines:
            mcu.add_config_cmd(f"set_sercom_pin bus={sercom} sercom_pin_type={kind} pin={lines[kind]['pin']}")
    mcu.register_config_callback(build_config)
