"""The menu of a display: where the user is in it, what a key does there, and how it looks.

    click at the screen ─► root list ─► click: a list opens, a command runs, a value is edited until the next click
    up, down             ─► the cursor moves, or the value changes       back ─► one list up, then the screen

Keys come from message handlers and must not wait: G-code runs one script after another in a greenlet of its own.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

from .menu_elements import FAST_STEPS, MANY_STEPS, Element, Templates, files_of_card
from .panel import Panel, Steps

CURSOR, EDIT_CURSOR, MORE = ">", "*", ">"
SCROLL_S = 0.5  # a long name moves by a letter
SCROLL_REST_S = 1.5


@dataclass(slots=True)
class Level:
    """One open list: what it shows, the cursor's place, the first line on the display."""

    element: Element
    shown: list[Element] = field(default_factory=list)
    cursor: int = 0
    first: int = 0


class Menu:
    """Drawn on a panel in place of the screen while `is_running`."""

    def __init__(
        self,
        printer: Any,
        panel: Panel,
        elements: dict[str, Element],
        root: str,
        timeout_s: float,
        reverse: bool,
    ) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self._panel, self._root = panel, elements[root]
        self._timeout_s, self._reverse = timeout_s, reverse
        self._templates = Templates(printer, panel.columns, self.back, self.exit)
        self._levels: list[Level] = []
        self._edited: float | None = None  # the value, while one is edited
        self._touched_s = 0.0  # last key
        self._moved_s = 0.0  # last move of the cursor
        self._scripts: list[tuple[Element, str]] = []
        self._is_working = False

    @property
    def is_running(self) -> bool:
        return bool(self._levels)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Where the user is; for the API and for templates."""
        level = self._levels[-1] if self._levels else None
        return {
            "running": self.is_running,
            "list": level.element.ns if level else None,
            "selected": level.shown[level.cursor].ns if level and level.shown else None,
            "editing": self._edited is not None,
        }

    # --- keys ---
    def on_key(self, key: str, eventtime: float) -> None:
        """click, long_click, back; up, down, fast_up, fast_down; next, previous (of a knob: as up and down)."""
        self._touched_s = eventtime
        if not self._levels:
            if key == "click":
                self._open(self._root)
            return
        if key in ("click", "long_click"):
            self._click(key)
        elif key == "back":
            self.back(force=True)
        elif self._edited is not None:
            self._change(1 if key in ("up", "fast_up", "next", "fast_next") else -1, key.startswith("fast_"))
        else:
            self._move(key.removeprefix("fast_"))

    def check_timeout(self, eventtime: float) -> None:
        """Leave a menu that nobody has used for long."""
        if self._levels and self._timeout_s and eventtime - self._touched_s >= self._timeout_s:
            self.exit(force=True)

    def _open(self, element: Element) -> None:
        level = Level(element)
        self._levels.append(level)
        self._populate(level)
        # the way back stands first, the cursor on what comes after it
        level.cursor = min(1, len(level.shown) - 1)
        self._moved_s = self._touched_s

    def _populate(self, level: Level) -> None:
        """The elements that are shown now; the cursor stays on its element."""
        selected = level.shown[level.cursor].ns if level.shown else None
        way_back = Element("command", level.element.ns, label="..", is_back=True)
        children = list(level.element.children)
        if level.element.kind == "vsdlist":
            children += files_of_card(self.printer, level.element.ns)
        level.shown = [way_back, *(child for child in children if self._templates.is_enabled(child))]
        places = [place for place, element in enumerate(level.shown) if element.ns == selected]
        level.cursor = places[0] if places else min(level.cursor, len(level.shown) - 1)

    def _move(self, key: str) -> None:
        level = self._levels[-1]
        forward = (key in ("down", "next")) != self._reverse
        level.cursor = min(max(0, level.cursor + (1 if forward else -1)), len(level.shown) - 1)
        self._moved_s = self._touched_s

    def _click(self, event: str) -> None:
        level = self._levels[-1]
        element = level.shown[level.cursor]
        if element.is_back:
            self.back()
        elif element.is_list:
            self._open(element)
        elif element.kind == "input" and event == "click":
            self._edit(element)
        elif element.kind in ("command", "input"):
            self._run(element, event)

    def _edit(self, element: Element) -> None:
        if self._edited is None:
            low, high = self._templates.limits(element)
            self._edited = min(max(self._templates.value_of(element) or 0.0, low), high)
            return
        if not element.is_realtime:
            self._run(element, "click")
        self._edited = None

    def _change(self, direction: int, is_fast: bool) -> None:
        level = self._levels[-1]
        element = level.shown[level.cursor]
        low, high = self._templates.limits(element)
        step = element.step * (FAST_STEPS if is_fast and (high - low) / element.step > MANY_STEPS else 1)
        before = self._edited or 0.0
        # steps add up without the error of binary fractions: 0.1 + 0.2 is 0.3
        self._edited = round(min(max(before + direction * step, low), high), 9)
        if element.is_realtime and self._edited != before:
            self._run(element, "change")

    # --- what templates may call, too ---
    def back(self, force: bool = False, update: bool = True) -> str:
        """One list up; while a value is edited only if forced, and then the value is given up."""
        if self._edited is not None and not force:
            return ""
        if self._edited is not None:
            self._edited = None
        elif self._levels:
            self._levels.pop()
            self._moved_s = self._touched_s
            if update and self._levels:
                self._populate(self._levels[-1])
        return ""

    def exit(self, force: bool = False) -> str:
        """Back to the screen."""
        if self._edited is None or force:
            self._edited = None
            self._levels.clear()
        return ""

    # --- scripts ---
    def _run(self, element: Element, event: str) -> None:
        if element.script:
            script = element.script
            self.exit()
        else:
            script = self._templates.render(
                element.gcode, self._templates.context(element, event, self._edited)
            )
        if not script.strip():
            return
        if event == "change":  # of values that nobody has taken yet only the newest counts
            self._scripts = [waiting for waiting in self._scripts if waiting[0] is not element]
        self._scripts.append((element, script))
        if not self._is_working:
            self._is_working = True
            self.reactor.register_callback(self._work)

    def _work(self, eventtime: float) -> None:
        gcode = self.printer.lookup_object("gcode")
        while self._scripts:
            element, script = self._scripts.pop(0)
            try:
                gcode.run_script(script)
            except self.printer.command_error as e:
                logging.info("menu %s: %s", element.ns, e)
                gcode.respond_error(str(e))
        self._is_working = False

    # --- the picture ---
    def draw(self, eventtime: float) -> Steps:
        """Put the list on the panel, an element a step."""
        self.check_timeout(eventtime)
        if not self._levels:
            return
        level = self._levels[-1]
        if self._edited is None:
            self._populate(level)
        rows = self._panel.rows
        level.first = min(max(level.first, level.cursor - rows + 1), level.cursor)
        for row, element in enumerate(level.shown[level.first : level.first + rows]):
            yield 0.0
            if self._levels[-1:] != [level]:
                return  # a key came between: the picture is drawn anew
            self._panel.put_text(row, 0, self._line(element, level.first + row == level.cursor, eventtime))

    def _line(self, element: Element, is_selected: bool, eventtime: float) -> str:
        value = (
            self._edited if is_selected and self._edited is not None else self._templates.value_of(element)
        )
        label = self._templates.label(element, value)
        width = self._panel.columns - 1 - element.is_list
        if is_selected and self._edited is None and len(label) > width:
            rest = len(label) - width
            label = label[min(rest, max(0, int((eventtime - self._moved_s - SCROLL_REST_S) / SCROLL_S))) :]
        cursor = (EDIT_CURSOR if self._edited is not None else CURSOR) if is_selected else " "
        return f"{cursor}{label[:width]:{width}}{MORE if element.is_list else ''}"
