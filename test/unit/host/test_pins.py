"""Pin descriptions, double use, aliases."""

from __future__ import annotations

from pathlib import Path

import pytest

from base_rig import start_error
from pins import PinError, PinResolver, PrinterPins


class Chip:
    """Records what is asked of it."""

    def setup_pin(self, pin_type: str, pin_params: dict) -> tuple[str, str]:
        return pin_type, pin_params["pin"]


@pytest.fixture
def pins() -> PrinterPins:
    pins = PrinterPins()
    pins.register_chip("mcu", Chip())
    pins.register_chip("tool", Chip())
    return pins


@pytest.mark.parametrize(
    ("text", "chip", "pin", "invert", "pullup"),
    [
        ("PA1", "mcu", "PA1", 0, 0),
        ("!PA1", "mcu", "PA1", 1, 0),
        ("^PA1", "mcu", "PA1", 0, 1),
        ("~!tool:PB2", "tool", "PB2", 1, -1),
        (" ^ ! tool : PB2 ", "tool", "PB2", 1, 1),
    ],
)
def test_descriptions(pins: PrinterPins, text: str, chip: str, pin: str, invert: int, pullup: int) -> None:
    params = pins.lookup_pin(text, can_invert=True, can_pullup=True)
    assert (params["chip_name"], params["pin"], params["invert"], params["pullup"]) == (
        chip,
        pin,
        invert,
        pullup,
    )


@pytest.mark.parametrize("text", ["", "!", "PA1 PA2", "a:b:c", "!^PA1", "PA1!", "^^PA1", "mcu:"])
def test_malformed_descriptions(pins: PrinterPins, text: str) -> None:
    with pytest.raises(PinError, match="Invalid pin description"):
        pins.parse_pin(text, can_invert=True, can_pullup=True)


def test_modifiers_where_they_make_no_sense(pins: PrinterPins) -> None:
    with pytest.raises(PinError, match=r"Format is: \[chip_name:\] pin_name"):
        pins.setup_pin("adc", "!PA1")
    with pytest.raises(PinError, match="Invalid pin"):
        pins.setup_pin("pwm", "^PA1")
    assert pins.setup_pin("endstop", "^!PA1") == ("endstop", "PA1")


def test_unknown_chip_lists_the_known(pins: PrinterPins) -> None:
    with pytest.raises(PinError, match=r"Unknown pin chip name 'toool'.*known: mcu, tool"):
        pins.lookup_pin("toool:PA1")


def test_a_pin_has_one_user_unless_shared(pins: PrinterPins) -> None:
    pins.lookup_pin("PA1")
    pins.lookup_pin("tool:PA1")
    with pytest.raises(PinError, match="PA1 is used multiple times"):
        pins.lookup_pin("mcu:PA1")
    first = pins.lookup_pin("PB1", share_type="stepper")
    assert pins.lookup_pin("PB1", share_type="stepper") is first
    with pytest.raises(PinError, match="used multiple times"):
        pins.lookup_pin("PB1", share_type="endstop")
    with pytest.raises(PinError, match="same polarity"):
        pins.lookup_pin("!PB1", can_invert=True, share_type="stepper")
    pins.allow_multi_use_pin("PC1")
    pins.lookup_pin("PC1")
    pins.lookup_pin("PC1")
    with pytest.raises(PinError, match="Invalid pin description"):
        pins.allow_multi_use_pin("^PC1")


def test_a_pin_that_may_be_shared_may_be_so_by_any_of_its_names(pins: PrinterPins) -> None:
    pins.allow_multi_use_pin("LIGHT")
    pins.get_pin_resolver("mcu").alias_pin("LIGHT", "PA1")
    pins.lookup_pin("PA1")
    pins.lookup_pin("LIGHT")
    with pytest.raises(PinError, match="used multiple times"):
        pins.lookup_pin("tool:PA1") and pins.lookup_pin("tool:PA1")


def test_an_alias_is_the_same_pin(pins: PrinterPins) -> None:
    pins.get_pin_resolver("mcu").alias_pin("EXP1_1", "PA1")
    pins.lookup_pin("EXP1_1")
    with pytest.raises(PinError, match="used multiple times"):
        pins.lookup_pin("PA1")


def test_resolver_rewrites_config_commands() -> None:
    resolver = PinResolver("mcu")
    resolver.alias_pin("ar5", "PE3")
    assert resolver.update_command("config_digital_out oid=1 pin=ar5 value=0") == (
        "config_digital_out oid=1 pin=PE3 value=0"
    )
    assert resolver.update_command("config_stepper oid=1 step_pin=PA0 dir_pin=PA1") == (
        "config_stepper oid=1 step_pin=PA0 dir_pin=PA1"
    )
    with pytest.raises(PinError, match="two names"):
        resolver.update_command("config_x pin=PE3")
    resolver.reserve_pin("PA9", "USART1")
    with pytest.raises(PinError, match="PA9 of mcu is reserved for USART1"):
        resolver.update_command("config_x pin=PA9")
    with pytest.raises(PinError, match="reserved for USART1"):
        resolver.reserve_pin("PA9", "SPI1")


FAN = "max_power: 1\n"


def test_config_error_names_the_pin_and_who_asks(tmp_path: Path) -> None:
    text = start_error(tmp_path, f"[fan]\npin: nochip:PA1\n{FAN}")
    assert text.startswith("Unknown pin chip name 'nochip' in pin 'nochip:PA1' (by [fan] pin)")
