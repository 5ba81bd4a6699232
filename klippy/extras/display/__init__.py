"""[display]: a screen on the board with its knob and menu; [display NAME]: further screens.

screen.py   what is shown and when it goes out      panel.py     what is drawn on, whatever chip shows it
groups.py   [display_data], the screens' texts      hd44780.py   character displays
glyphs.py   [display_glyph]                         st7920.py, page_lcd.py   displays of 128 x 64 pixels
display.cfg   the default screens
"""

from __future__ import annotations

import os

from configfile import ConfigWrapper

from .keys import Keys
from .menu import Menu
from .menu_elements import read_elements
from .screen import Screen

DEFAULT_MENU = os.path.join(os.path.dirname(__file__), "menu.cfg")


def load_config(config: ConfigWrapper) -> Screen:
    """Section [display]."""
    screen = Screen(config)
    screen.register(is_primary=True)
    screen.menu = _load_menu(config, screen)
    return screen


def _load_menu(config: ConfigWrapper, screen: Screen) -> Menu:
    printer = config.get_printer()
    defaults = printer.lookup_object("configfile").read_config(DEFAULT_MENU)
    elements = read_elements(config, defaults)
    root = config.get("menu_root", "__main")
    if root not in elements or not elements[root].is_list:
        raise config.error(
            f"Option 'menu_root' in section 'display': there is no list [menu {root}] ({config.where('menu_root')})."
        )
    timeout_s = config.getfloat("menu_timeout", 0.0, minval=0.0)
    menu = Menu(
        printer, screen.panel, elements, root, timeout_s, config.getboolean("menu_reverse_navigation", False)
    )

    def on_key(key: str, eventtime: float) -> None:
        menu.on_key(key, eventtime)
        screen.redraw_soon()

    Keys(config, on_key)
    printer.add_object("menu", menu)
    return menu


def load_config_prefix(config: ConfigWrapper) -> Screen:
    """Section [display NAME]."""
    if not config.has_section("display"):
        raise config.error(
            f"Section '{config.get_name()}' is a further display: [display] must be there, too ({config.where()})."
        )
    screen = Screen(config)
    screen.register(is_primary=False)
    return screen
