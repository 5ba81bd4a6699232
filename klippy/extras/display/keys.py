"""The knob and the buttons of a display, as keys for its menu.

A click is counted when the button is let go; held for LONG_CLICK_S it is a long one. A knob turned quickly gives fast_
keys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper

LONG_CLICK_S = 0.8
FAST_TURN_S = 0.030

KeyCallback = Callable[[str, float], None]


class Keys:
    """Calls `on_key(key, eventtime)`, see menu.py; the kill button stops the printer."""

    def __init__(self, config: ConfigWrapper, on_key: KeyCallback) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self._on_key = on_key
        self._last_turn: dict[str, float] = {}
        self._held = self.reactor.register_timer(self._on_held)
        self._is_down = False
        buttons = self.printer.load_object(config, "buttons")
        encoder = config.getlist("encoder_pins", None, count=2)
        steps = config.getchoice("encoder_steps_per_detent", {2: 2, 4: 4}, 4)
        if encoder is not None:
            buttons.register_rotary_encoder(
                *encoder,
                lambda when: self._turn("next", when),
                lambda when: self._turn("previous", when),
                steps,
            )
        self._add(config, buttons, "click", self._on_click)
        self._add(config, buttons, "kill", self._on_kill)
        for key in ("back", "up", "down"):
            self._add(config, buttons, key, self._presser(key))

    def _add(
        self, config: ConfigWrapper, buttons: Any, key: str, callback: Callable[[float, int], None]
    ) -> None:
        """The button of option KEY_pin; with analog_range_KEY_pin a resistor on an analog pin."""
        pullup_ohm = config.getfloat("analog_pullup_resistor", 4700.0, above=0.0)
        low_high = config.getfloatlist(f"analog_range_{key}_pin", None, count=2)
        pin = config.get(f"{key}_pin", None)
        if low_high is not None and pin is None:
            config.get(f"{key}_pin")  # must be there
        if pin is None:
            return
        if low_high is None:
            buttons.register_buttons([pin], callback)
        else:
            buttons.register_adc_button(pin, *sorted(low_high), pullup_ohm, callback)

    def _presser(self, key: str) -> Callable[[float, int], None]:
        return lambda eventtime, state: self._on_key(key, eventtime) if state else None

    def _turn(self, key: str, eventtime: float) -> None:
        is_fast = eventtime - self._last_turn.get(key, 0.0) < FAST_TURN_S
        self._last_turn[key] = eventtime
        self._on_key(f"fast_{key}" if is_fast else key, eventtime)

    def _on_click(self, eventtime: float, state: int) -> None:
        if state:
            self._is_down = True
            self.reactor.update_timer(self._held, self.reactor.monotonic() + LONG_CLICK_S)
        elif self._is_down:
            self._is_down = False
            self.reactor.update_timer(self._held, self.reactor.NEVER)
            self._on_key("click", eventtime)

    def _on_held(self, eventtime: float) -> float:
        self._is_down = False
        self._on_key("long_click", eventtime)
        return float(self.reactor.NEVER)

    def _on_kill(self, eventtime: float, state: int) -> None:
        if state:
            self.printer.invoke_shutdown("Shutdown due to kill button!")
