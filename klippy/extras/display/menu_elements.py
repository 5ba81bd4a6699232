"""[menu NAME ...]: the elements of a menu, read from the config. The words of a name are the way to the element.

    [menu __main]            a list               [menu __main __fan]      an element of it

Names, conditions and values are templates; in them `menu` is a MenuView.
"""

from __future__ import annotations

import ast
import logging
import math
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from configfile import ConfigWrapper

PREFIX = "menu "
LISTS = ("list", "vsdlist")
TYPES = ("command", "input", "text", "disabled", *LISTS)
VALUE_LIMIT = 99999.0
FAST_STEPS = 10
MANY_STEPS = 100  # of a range, for which turning fast goes by more than one


@dataclass(slots=True)
class MenuView:
    """`menu` in the templates of an element."""

    width: int
    ns: str
    back: Callable[..., str]
    exit: Callable[..., str]
    event: str = ""
    input: float | None = None


@dataclass(slots=True)
class Element:
    """One element. Templates are None where the config gives none; `label` is a name that is no template."""

    kind: str
    ns: str
    name: Any = None
    label: str = ""
    enable: Any = None
    gcode: Any = None
    script: str = ""  # of an element that the menu made itself
    index: int | None = None
    children: list[Element] = field(default_factory=list)
    value: Any = None
    value_min: Any = None
    value_max: Any = None
    step: float = 1.0
    is_realtime: bool = False
    is_back: bool = False

    @property
    def is_list(self) -> bool:
        return self.kind in LISTS


class Templates:
    """Evaluates the templates of elements. Those that fail count as empty, and are logged once."""

    def __init__(self, printer: Any, width: int, back: Callable[..., str], leave: Callable[..., str]) -> None:
        self.printer = printer
        self._width, self._back, self._exit = width, back, leave
        self._failed: set[str] = set()

    def context(self, element: Element, event: str = "", value: float | None = None) -> dict[str, Any]:
        """Names for one element."""
        context: dict[str, Any] = self.printer.lookup_object("gcode_macro").create_template_context()
        context["menu"] = MenuView(self._width, element.ns, self._back, self._exit, event, value)
        return context

    def render(self, template: Any, context: dict[str, Any], otherwise: str = "") -> str:
        """The text of a template."""
        if template is None:
            return otherwise
        try:
            return str(template.render(context))
        except self.printer.command_error as e:
            if template.name not in self._failed:
                self._failed.add(template.name)
                logging.warning("menu: %s", e)
            return ""

    def number(self, template: Any, context: dict[str, Any], otherwise: float) -> float:
        """The number a template gives."""
        text = self.render(template, context, str(otherwise))
        try:
            number = float(text)
        except ValueError:
            return otherwise
        return number if math.isfinite(number) else otherwise

    def is_enabled(self, element: Element) -> bool:
        """Whether an element is shown."""
        if element.kind == "disabled":
            return False
        if element.enable is None:
            return True
        try:
            return bool(ast.literal_eval(self.render(element.enable, self.context(element)).strip()))
        except (ValueError, SyntaxError):
            return False

    def value_of(self, element: Element) -> float | None:
        """The value an input begins with; None for other elements."""
        if element.kind != "input":
            return None
        return self.number(element.value, self.context(element), 0.0)

    def limits(self, element: Element) -> tuple[float, float]:
        """Lowest and highest value of an input."""
        context = self.context(element)
        return (
            self.number(element.value_min, context, -VALUE_LIMIT),
            self.number(element.value_max, context, VALUE_LIMIT),
        )

    def label(self, element: Element, value: float | None) -> str:
        """The name as shown."""
        if element.name is None:
            return element.label
        return self.render(element.name, self.context(element, value=value)).replace("\n", "")


def _read_element(config: ConfigWrapper) -> Element:
    kind = config.getchoice("type", TYPES)
    ns = config.get_name().removeprefix(PREFIX).strip()
    if kind == "disabled":
        for option in config.get_prefix_options(""):  # what it was before
            config.get(option)
        return Element(kind, ns)
    load = config.get_printer().load_object(config, "gcode_macro").load_template

    def optional(option: str) -> Any:
        return None if config.get(option, None) is None else load(config, option)

    element = Element(kind, ns, load(config, "name"), enable=optional("enable"), gcode=optional("gcode"))
    element.index = config.getint("index", None, minval=0)
    if kind == "input":
        element.value = load(config, "input")
        element.value_min, element.value_max = optional("input_min"), optional("input_max")
        element.step = config.getfloat("input_step", above=0.0)
        element.is_realtime = config.getboolean("realtime", False)
    return element


def read_elements(config: ConfigWrapper, defaults: ConfigWrapper) -> dict[str, Element]:
    """All elements by name, in their lists. A section of the config replaces the default one of the same name."""
    own = config.get_prefix_sections(PREFIX)
    replaced = {section.get_name() for section in own}
    kept = [s for s in defaults.get_prefix_sections(PREFIX) if s.get_name() not in replaced]
    sections = [*kept, *own]
    elements = {element.ns: element for element in map(_read_element, sections)}
    for section in sections:
        element = elements[section.get_name().removeprefix(PREFIX).strip()]
        above = element.ns.rpartition(" ")[0]
        if not above:
            continue
        parent = elements.get(above)
        if parent is None or not (parent.is_list or parent.kind == "disabled"):
            raise config.error(
                f"Section '{section.get_name()}' belongs to a list 'menu {above}', which is not there"
                f" ({section.where()})."
            )
        place = len(parent.children) if element.index is None else element.index
        parent.children.insert(place, element)
    return elements


def files_of_card(printer: Any, ns: str) -> Iterator[Element]:
    """The files of the virtual SD card, each a list with what can be done with it."""
    card = printer.lookup_object("virtual_sdcard", None)
    if card is None:
        return
    for name, _ in card.get_file_list(check_subdirs=True):
        start = Element("command", f"{ns} {name} __start", label="Start printing")
        start.script = f"SDCARD_PRINT_FILE FILENAME={shlex.quote(name)}"
        yield Element("list", f"{ns} {name}", label=name, children=[start])
