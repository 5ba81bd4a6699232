"""A display of the simulated machine: the chip behind a host's section, and the hand at its knob and buttons."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from ..world import Pin, World, WorldError
from .chips import ChipError, Picture
from .image import save_png
from .wires import Wires, with_control_byte

BUTTONS = ("click", "back", "up", "down", "kill")
GRAY = (0, 1, 3, 2)  # states of a knob's switches, turned clockwise; bit 0 is the first pin
STATE_S = 0.008  # the board looks every 2 ms; two looks must agree
PRESS_S, LONG_PRESS_S, REST_S = 0.1, 1.0, 0.1

ParsePin = Callable[[str], Pin]
Waits = Iterator[float]


class SimulatedPanel:
    """`turn` and `press` yield the seconds to wait before they go on."""

    def __init__(
        self, world: World, index: int, wires: Wires, knob: list[Pin], steps: int, buttons: Mapping[str, Pin]
    ) -> None:
        self._world, self._index, self._wires = world, index, wires
        self.chip = wires.chip
        self._knob, self._steps, self._buttons = knob, steps, buttons
        self._position = 0  # of the knob, in states
        self.objection: str | None = None
        for pin in [*knob, *buttons.values()]:
            world.set_input(pin, int(pin.inverted))

    def read(self) -> None:
        """Let the chip take what it has been sent, until it objects."""
        try:
            for event in self._world.read_panel(self._index):
                if self.objection is None:
                    self._wires.take(event >> 12, event & 0xFF, bool(event & 0x100))
        except (ChipError, WorldError) as e:
            self.objection = str(e)
            logging.warning("The simulated display objects: %s", e)

    def picture(self) -> Picture:
        """What is to be seen now. Raises ValueError if the chip has been sent what its data sheet does not allow."""
        self.read()
        if self.objection is not None:
            raise ValueError(f"the simulated display objects: {self.objection}")
        return self._wires.picture()

    def save_picture(self, path: str) -> None:
        """As PNG. Raises OSError."""
        save_png(Path(path), self.picture())

    def turn(self, detents: int) -> Waits:
        """Clockwise, or back with a negative number. Raises ValueError without a knob."""
        if not self._knob:
            raise ValueError("the display has no encoder_pins")
        for _ in range(abs(detents) * self._steps):
            self._position += 1 if detents > 0 else -1
            state = GRAY[self._position % 4]
            for bit, pin in enumerate(self._knob):
                self._world.set_input(pin, (state >> bit & 1) ^ pin.inverted)
            yield STATE_S
        yield REST_S

    def press(self, key: str) -> Waits:
        """A button, or long_click. Raises ValueError for one that is not there."""
        name, held_s = ("click", LONG_PRESS_S) if key == "long_click" else (key, PRESS_S)
        pin = self._buttons.get(name)
        if pin is None:
            raise ValueError(
                f"the display has no {name}_pin; it has {', '.join(self._buttons) or 'no buttons'}"
            )
        self._world.set_input(pin, int(not pin.inverted))
        yield held_s
        self._world.set_input(pin, int(pin.inverted))
        yield REST_S


def add_panel(
    world: World, section: str, host: Mapping[str, str], parse: ParsePin, i2c_mcu: int
) -> SimulatedPanel:
    """The display of the host's section. Raises WorldError."""
    lcd_type = host.get("lcd_type", "")

    def pin(option: str, inverted: bool = False) -> Pin:
        found = parse(host[option]) if option in host else Pin()
        return Pin(found.mcu, found.number, inverted)

    software = {"clock": pin("spi_software_sclk_pin")}
    software_data = [pin("spi_software_mosi_pin")]
    columns, first_column = int(host.get("line_length", "20")), int(host.get("x_offset", "0"))
    wires = Wires(lcd_type, columns, first_column)
    if lcd_type == "st7920":
        lines = {"select": pin("cs_pin"), "clock": pin("sclk_pin")}
        index = world.add_panel("SERIAL", lines, [pin("sid_pin")])
    elif lcd_type == "hd44780":
        data = [pin(f"d{number}_pin") for number in range(4, 8)]
        index = world.add_panel("PARALLEL", {"clock": pin("e_pin"), "is_data": pin("rs_pin")}, data)
    elif lcd_type == "emulated_st7920":
        index = world.add_panel("SERIAL", {"select": pin("en_pin"), **software}, software_data)
    elif lcd_type in ("hd44780_spi", "aip31068_spi"):
        index = world.add_panel("SERIAL", {"select": pin("latch_pin", True), **software}, software_data)
    elif "cs_pin" in host:
        is_uc1701 = lcd_type == "uc1701"
        lines = {
            "select": pin("cs_pin", True),
            "is_data": pin("a0_pin" if is_uc1701 else "dc_pin"),
            **software,
        }
        lines["reset"] = pin("rst_pin" if is_uc1701 else "reset_pin")
        index = world.add_panel("SERIAL", lines, software_data)
    else:
        if "i2c_software_scl_pin" in host:
            raise WorldError(
                f"Section 'simulator panel {section}': a simulated display needs an I2C bus of the board."
            )
        wires.take = with_control_byte(wires.take)
        address = int(host.get("i2c_address", "60"))
        index = world.add_panel("I2C", {"reset": pin("reset_pin")}, i2c=(i2c_mcu, address))
    knob = [parse(text) for text in host.get("encoder_pins", "").split(",") if text.strip()]
    buttons = {
        key: parse(host[f"{key}_pin"])
        for key in BUTTONS
        if f"{key}_pin" in host and f"analog_range_{key}_pin" not in host
    }
    steps = int(host.get("encoder_steps_per_detent", "4"))
    return SimulatedPanel(world, index, wires, knob, steps, buttons)
