"""[display_glyph NAME]: pictures of 16 x 16 pixels, and of 5 x 8 for character displays, drawn as text."""

from __future__ import annotations

from configfile import ConfigWrapper

from .panel import Glyph

PREFIX = "display_glyph "
_PIXELS = {".": "0", "*": "1", "0": "0", "1": "1"}
LETTERS = {"degrees": "°", "right_arrow": "→"}


def _read_rows(config: ConfigWrapper, option: str, height: int, width: int) -> tuple[int, ...] | None:
    text = config.get(option, None)
    if text is None:
        return None
    lines = [line.strip() for line in text.split("\n") if line.strip()]
    if len(lines) != height or any(len(line) != width or set(line) - set(_PIXELS) for line in lines):
        raise config.error(
            f"Option '{option}' in section '{config.get_name()}' must be {height} lines of {width} pixels:"
            f" '.' or '0' is a dark one, '*' or '1' a lit one ({config.where(option)})."
        )
    return tuple(int("".join(_PIXELS[pixel] for pixel in line), 2) for line in lines)


def read_glyph(config: ConfigWrapper) -> Glyph:
    """One section."""
    rows = _read_rows(config, "data", 16, 16)
    cell = _read_rows(config, "hd44780_data", 8, 5)
    slot = config.getint("hd44780_slot", minval=0, maxval=7) if cell else 0
    return Glyph(rows, cell, slot)


def read_glyphs(config: ConfigWrapper, defaults: ConfigWrapper) -> dict[str, Glyph]:
    """All glyphs by name; the config's own before the defaults."""
    glyphs = {name: Glyph(letter=letter) for name, letter in LETTERS.items()}
    for source in (defaults, config):
        for section in source.get_prefix_sections(PREFIX):
            glyphs[section.get_name().removeprefix(PREFIX).strip()] = read_glyph(section)
    return glyphs
