"""Buttons, switches and encoders, for other modules (loaded by them; object `buttons`).

    register_buttons(pins, callback)            callback(eventtime, bits) at each change, bit i = pins[i]
    register_button_push(pin, callback)         callback(eventtime) when it goes on
    register_adc_button(pin, low, high, pullup, callback)       a resistor on an analog pin, ohm
    register_adc_button_push(...)
    register_rotary_encoder(pin1, pin2, cw, ccw, steps_per_detent)

The MCU looks at its pins every QUERY_TIME_S, debounces, and repeats what is not acknowledged (src/buttons.c). Callbacks
run in the reactor, from message handlers: they must not wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

QUERY_TIME_S = 0.002
RETRANSMIT_COUNT = 50
BUTTONS_PER_GROUP = 8  # of one MCU object

ADC_REPORT_TIME_S = 0.015
ADC_DEBOUNCE_TIME_S = 0.025
ADC_SAMPLE_TIME_S = 0.001
ADC_SAMPLE_COUNT = 6
ADC_RATIO_MAX = 0.9999

StateCallback = Callable[[float, int], None]
PushCallback = Callable[[float], None]


class MCU_buttons:
    """Up to eight pins of one MCU."""

    def __init__(self, printer: Printer, mcu: Any) -> None:
        self.reactor = printer.get_reactor()
        self.mcu = mcu
        self._pins: list[tuple[str, int]] = []  # name, pull-up
        self._invert = 0
        self._listeners: list[tuple[int, int, StateCallback]] = []  # mask, shift, callback
        self._state = 0
        self._received = 0  # states taken so far
        self._oid = -1
        self._ack: Any = None
        mcu.register_config_callback(self._build_config)

    def room(self) -> int:
        """Pins that still fit."""
        return BUTTONS_PER_GROUP - len(self._pins)

    def add(self, pins: Sequence[dict[str, Any]], callback: StateCallback) -> None:
        """Watch these pins, which fit, together."""
        shift = len(self._pins)
        for params in pins:
            self._invert |= params["invert"] << len(self._pins)
            self._pins.append((params["pin"], params["pullup"]))
        self._listeners.append((((1 << len(pins)) - 1) << shift, shift, callback))

    def _build_config(self) -> None:
        mcu = self.mcu
        if not self._pins:
            return
        self._oid = oid = mcu.create_oid()
        mcu.add_config_cmd(f"config_buttons oid={oid} button_count={len(self._pins)}")
        for pos, (pin, pullup) in enumerate(self._pins):
            mcu.add_config_cmd(f"buttons_add oid={oid} pos={pos} pin={pin} pull_up={pullup}")
        mcu.add_config_cmd(
            f"buttons_query oid={oid} clock={mcu.get_query_slot(oid)} rest_ticks={mcu.seconds_to_clock(QUERY_TIME_S)}"
            f" retransmit_count={RETRANSMIT_COUNT} invert={self._invert}",
            is_init=True,
        )
        self._ack = mcu.lookup_command("buttons_ack oid=%c count=%c", cq=mcu.alloc_command_queue())
        mcu.register_response(self._on_state, "buttons_state", oid)

    def _on_state(self, params: dict[str, Any]) -> None:
        """The message repeats states from number ack_count (8 bits of it) on."""
        behind = (self._received - params["ack_count"]) & 0xFF
        fresh = params["state"][behind:]
        if not fresh:
            return
        self._received += len(fresh)
        self._ack.send([self._oid, len(fresh)])
        eventtime = params.get("#receive_time", self.reactor.monotonic())
        for state in fresh:
            changed = state ^ self._state
            self._state = state
            for mask, shift, callback in self._listeners:
                if changed & mask:
                    callback(eventtime, (state & mask) >> shift)


class AdcPin:
    """The buttons of one analog pin: each is a range of resistance to ground."""

    def __init__(self, printer: Printer, pin: str, pullup_ohm: float) -> None:
        self.reactor = printer.get_reactor()
        self._pullup_ohm = pullup_ohm
        self._buttons: list[tuple[float, float, StateCallback]] = []
        self._seen: int | None = None  # newest reading's button
        self._seen_since_s = 0.0
        self._reported: int | None = None
        self._adc = printer.lookup_object("pins").setup_pin("adc", pin)
        self._adc.setup_adc_sample(ADC_SAMPLE_TIME_S, ADC_SAMPLE_COUNT)
        self._adc.setup_adc_callback(ADC_REPORT_TIME_S, self._on_adc)

    def add(self, low_ohm: float, high_ohm: float, callback: StateCallback) -> None:
        self._buttons.append((low_ohm, high_ohm, callback))

    def _which(self, ratio: float) -> int | None:
        ratio = min(ADC_RATIO_MAX, max(0.0, ratio))
        ohm = self._pullup_ohm * ratio / (1.0 - ratio)
        for number, (low_ohm, high_ohm, _) in enumerate(self._buttons):
            if low_ohm <= ohm <= high_ohm:
                return number
        return None

    def _on_adc(self, read_time: float, read_value: float) -> None:
        button = self._which(read_value)
        if button != self._seen:
            self._seen, self._seen_since_s = button, read_time
        elif button != self._reported and read_time - self._seen_since_s >= ADC_DEBOUNCE_TIME_S:
            eventtime = self.reactor.monotonic()
            if self._reported is not None:
                self._buttons[self._reported][2](eventtime, 0)
            self._reported = button
            if button is not None:
                self._buttons[button][2](eventtime, 1)


_GRAY_POSITION = {0: 0, 1: 1, 3: 2, 2: 3}


class RotaryEncoder:
    """Gray code of two switches: a detent is reported when the row of states has gone all the way round.

    Bit 0 is the first pin. Clockwise the first pin closes first: 0 1 3 2 0.
    """

    def __init__(self, cw: PushCallback, ccw: PushCallback, steps_per_detent: int) -> None:
        self._cw, self._ccw = cw, ccw
        self._steps_per_detent = steps_per_detent
        self._position = 0
        self._travel = 0

    def on_state(self, eventtime: float, state: int) -> None:
        """The switches have changed."""
        step = (_GRAY_POSITION[state] - self._position) % 4
        self._position = _GRAY_POSITION[state]
        if step == 2:  # a state was missed: the direction is unknown
            self._travel = 0
            return
        self._travel += {1: 1, 3: -1}.get(step, 0)
        if self._position % self._steps_per_detent:
            return
        travel, self._travel = self._travel, 0
        if travel >= self._steps_per_detent:
            self._cw(eventtime)
        elif travel <= -self._steps_per_detent:
            self._ccw(eventtime)


def _on_push(callback: PushCallback) -> StateCallback:
    return lambda eventtime, state: callback(eventtime) if state else None


class PrinterButtons:
    """The object `buttons`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._groups: list[MCU_buttons] = []
        self._adc_pins: dict[str, AdcPin] = {}

    def register_buttons(self, pins: Sequence[str], callback: StateCallback) -> None:
        """Watch pins of one MCU together; callback(eventtime, bits) at each change."""
        lookup = self.printer.lookup_object("pins")
        params = [lookup.lookup_pin(pin, can_invert=True, can_pullup=True) for pin in pins]
        mcu = params[0]["chip"]
        if any(p["chip"] is not mcu for p in params):
            raise lookup.error(f"Button pins {', '.join(pins)} must be on the same board.")
        if len(params) > BUTTONS_PER_GROUP:
            raise lookup.error(f"At most {BUTTONS_PER_GROUP} button pins can be watched together.")
        group = next((g for g in self._groups if g.mcu is mcu and g.room() >= len(params)), None)
        if group is None:
            group = MCU_buttons(self.printer, mcu)
            self._groups.append(group)
        group.add(params, callback)

    def register_button_push(self, pin: str, callback: PushCallback) -> None:
        """callback(eventtime) when the button goes on."""
        self.register_buttons([pin], _on_push(callback))

    def register_adc_button(
        self, pin: str, min_val: float, max_val: float, pullup: float, callback: StateCallback
    ) -> None:
        """callback(eventtime, 0 or 1) for a button of min_val..max_val ohm."""
        adc_pin = self._adc_pins.get(pin)
        if adc_pin is None:
            adc_pin = self._adc_pins[pin] = AdcPin(self.printer, pin, pullup)
        adc_pin.add(min_val, max_val, callback)

    def register_adc_button_push(
        self, pin: str, min_val: float, max_val: float, pullup: float, callback: PushCallback
    ) -> None:
        """callback(eventtime) when the button goes on."""
        self.register_adc_button(pin, min_val, max_val, pullup, _on_push(callback))

    def register_rotary_encoder(
        self,
        pin1: str,
        pin2: str,
        cw_callback: PushCallback,
        ccw_callback: PushCallback,
        steps_per_detent: int,
    ) -> None:
        """Callbacks at each detent; steps_per_detent 2 or 4."""
        if steps_per_detent not in (2, 4):
            raise self.printer.config_error(f"{steps_per_detent} steps per detent not supported (2 or 4)")
        encoder = RotaryEncoder(cw_callback, ccw_callback, steps_per_detent)
        self.register_buttons([pin1, pin2], encoder.on_state)


def load_config(config: ConfigWrapper) -> PrinterButtons:
    """Loaded by sections that have buttons."""
    return PrinterButtons(config.get_printer())
