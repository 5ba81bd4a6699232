"""[display]: a screen on the board with its knob and menu; [display NAME]: further screens.

screen.py   what is shown and when it goes out      panel.py     what is drawn on, whatever chip shows it
groups.py   [display_data], the screens' texts      hd44780.py   character displays
glyphs.py   [display_glyph]                         st7920.py, page_lcd.py   displays of 128 x 64 pixels
display.cfg   the default screens
"""

from __future__ import annotations

from configfile import ConfigWrapper

from .screen import Screen


def load_config(config: ConfigWrapper) -> Screen:
    """Section [display]."""
    screen = Screen(config)
    screen.register(is_primary=True)
    return screen


def load_config_prefix(config: ConfigWrapper) -> Screen:
    """Section [display NAME]."""
    if not config.has_section("display"):
        raise config.error(
            f"Section '{config.get_name()}' is a further display: [display] must be there, too ({config.where()})."
        )
    screen = Screen(config)
    screen.register(is_primary=False)
    return screen
