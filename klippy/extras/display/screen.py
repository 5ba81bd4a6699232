"""One display: what it shows, and when that goes out.

    every REDRAW_S, and after a key:   erase ─► menu, or the items of the group ─► the panel's differences

The work is done in steps with other work of the host between them: one template, or a few messages, a step.
"""

from __future__ import annotations

import logging
import os

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .glyphs import read_glyphs
from .groups import Renderer, read_groups, read_templates
from .hd44780 import TYPES as CHARACTER_TYPES
from .menu import Menu
from .page_lcd import TYPES as PAGE_TYPES
from .panel import Panel, Steps
from .st7920 import TYPES as ST7920_TYPES

LCD_TYPES = {**CHARACTER_TYPES, **ST7920_TYPES, **PAGE_TYPES}
DEFAULTS = os.path.join(os.path.dirname(__file__), "display.cfg")
REDRAW_S = 0.5
STEP_S = 0.005  # a message takes a millisecond or two of the line and of the board
RETRY_S = 5.0  # after a display did not answer


class Screen:
    """The object `display` or `display NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name().split()[-1]
        self.panel: Panel = config.getchoice("lcd_type", LCD_TYPES)(config)
        defaults = self.printer.lookup_object("configfile").read_config(DEFAULTS)
        self.glyphs = read_glyphs(config, defaults)
        self._groups = read_groups(config, defaults)
        self._renderer = Renderer(self.printer, self.panel, self.glyphs, read_templates(defaults))
        default_group = f"_default_{self.panel.columns}x{self.panel.rows}"
        self._group = config.get("display_group", default_group)
        if self._group not in self._groups:
            raise config.error(
                f"Option 'display_group' in section '{config.get_name()}': there is no group '{self._group}', only"
                f" {', '.join(sorted(self._groups))} ({config.where('display_group')})."
            )
        self.menu: Menu | None = None
        self._is_started = False
        self._steps: Steps | None = None
        self._timer = self.reactor.register_timer(self._on_timer)
        self.printer.load_object(config, "display_status")
        self.printer.register_event_handler("klippy:ready", self._handle_ready)

    def register(self, is_primary: bool) -> None:
        """Make the command known."""
        gcode = self.printer.lookup_object("gcode")
        for value in (self.name, None) if is_primary else (self.name,):
            gcode.register_mux_command(
                "SET_DISPLAY_GROUP",
                "DISPLAY",
                value,
                self.cmd_SET_DISPLAY_GROUP,
                desc="Set the active display group",
            )

    def cmd_SET_DISPLAY_GROUP(self, gcmd: GCodeCommand) -> None:
        """Show another group."""
        group = gcmd.get("GROUP")
        if group not in self._groups:
            raise gcmd.error(
                f"Unknown display_data group '{group}': there are {', '.join(sorted(self._groups))}."
            )
        self._group = group
        self.redraw_soon()

    def redraw_soon(self) -> None:
        """Something has changed that the user is waiting to see."""
        if self._steps is None and self._is_started:
            self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _handle_ready(self) -> None:
        if not self.panel.mcu.is_fileoutput():
            self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _on_timer(self, eventtime: float) -> float:
        if self.printer.is_shutdown():
            return float(self.reactor.NEVER)
        if self._steps is None:
            self._steps = self._work(eventtime)
        try:
            wait_s = next(self._steps)
        except StopIteration:
            self._steps = None
            return eventtime + REDRAW_S
        except self.printer.command_error as e:
            logging.warning("display '%s': %s", self.name, e)
            self._steps, self._is_started = None, False
            return eventtime + RETRY_S
        return eventtime + (wait_s or STEP_S)

    def _work(self, eventtime: float) -> Steps:
        if not self._is_started:
            yield from self.panel.start()
            self._is_started = True
        self.panel.erase()
        yield from self._draw(eventtime)
        yield from self.panel.changes()

    def _draw(self, eventtime: float) -> Steps:
        if self.menu is not None:
            yield from self.menu.draw(eventtime)
            if self.menu.is_running:
                return
        yield from self._renderer.draw(self._groups[self._group], eventtime)
