"""What the documentation says and what the program does, side by side.

Config blocks of docs/reference/Config_Reference.md are fenced texts in the form of printer.cfg:

    [section]
    option: value        must be given
    #option: value       may be given; this is the default
    #option:             may be given
    # + options of X     those of the block below the heading "Options of X", too
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from batch_messages import batch_args
from bus_rig import all_boards_dictionary
from printer import Printer
from reactor import Reactor

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
HOST = ROOT / "klippy"

OPTION = re.compile(r"^(#?)([A-Za-z_][\w*]*):[ \t]*(.*)$")
INCLUDE = re.compile(r"^# \+ options of (.+?):?$")
SECTION = re.compile(r"^\[([^\]]+)\]")


# ---- the program ---------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Loaded:
    """A printer that was started in batch mode on one config."""

    message: str  # "Printer is ready", or why not
    access: dict[str, dict[str, Any]]  # section → options it asked for, with value or default
    commands: dict[str, str]  # all G-code commands with their help
    status: dict[str, dict[str, Any]]


def load(folder: Path, config: str) -> Loaded:
    """Start a printer on a config, without a board: batch mode with the dictionary of the simulator's firmware."""
    (folder / "dict").write_bytes(all_boards_dictionary())
    (folder / "printer.cfg").write_text(config)
    (folder / "in.gcode").write_text("")
    (folder / "printer_data" / "plugins").mkdir(parents=True, exist_ok=True)
    reactor = Reactor()
    start_args = {**batch_args(folder), "dictionary_board": str(folder / "dict")}
    printer = Printer(reactor, start_args)
    texts: list[str] = []
    printer.register_event_handler("klippy:ready", lambda: texts.append(printer.get_state_message()[0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(folder))
        printer.run()
    message = texts[0] if texts else printer.get_state_message()[0]
    gcode = printer.lookup_object("gcode")
    access: dict[str, dict[str, Any]] = {}
    configfile = printer.lookup_object("configfile")
    for (section, option), value in configfile._access.items():
        access.setdefault(section, {})[option] = value
    status = {}
    if texts:
        status = {
            name: dict(obj.get_status(reactor.monotonic()))
            for name, obj in printer.lookup_objects()
            if hasattr(obj, "get_status")
        }
    commands = {name: gcode.get_command_help().get(name, "") for name in gcode.get_status(0.0)["commands"]}
    reactor.finalize()
    return Loaded(message, access, commands, status)


def string_constants() -> dict[str, set[Path]]:
    """Every text in the host's code, with the files it is in; formatted ones as a pattern with '*'."""
    found: dict[str, set[Path]] = {}
    for path in sorted(HOST.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                text = "".join(
                    str(part.value) if isinstance(part, ast.Constant) else "*" for part in node.values
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value
            else:
                continue
            found.setdefault(text, set()).add(path)
    return found


# ---- figures -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Figures:
    """A page, or a section of it, on which every figure is one of the program's.

    A test gives the text that the page should have around each figure, made of the program's values: a claim.
    """

    page: str
    section: str = ""  # its heading; "" for the whole page
    facts: tuple[str, ...] = ()  # text with figures of the world, which no code knows

    def text(self) -> str:
        """On one line, without the numbers of lists."""
        found = read_page(self.page)
        if self.section:
            found = found.partition(f"# {self.section}\n")[2]
            assert found, f"{self.page} has no section '{self.section}'"
            found = re.split(r"(?m)^#+ ", found)[0]
        return " ".join(re.sub(r"(?m)^(\*\*)?\d\. ", r"\1", found).split())

    def missing(self, claims: Iterable[str]) -> list[str]:
        """Claims that are not on the page."""
        text = self.text()
        return [claim for claim in claims if claim not in text]

    def unchecked(self, claims: Iterable[str]) -> list[str]:
        """Figures that are in no claim, with the text around them."""
        left = self.text()
        for claim in (*self.facts, *claims):
            left = left.replace(claim, "")
        return re.findall(r".{0,30}(?<![A-Za-z_\d])\d.{0,10}", left)


# ---- the documentation ---------------------------------------------------------------------------------------


def read_page(name: str) -> str:
    """Text of a page of docs/ by its name, whichever folder it is in."""
    (path,) = DOCS.rglob(name)
    return path.read_text(encoding="utf-8")


@dataclass(slots=True)
class Block:
    """One section of a config block."""

    section: str  # "" for the options several sections share
    heading: str  # of the page's part it stands in
    fence: int  # line of the ``` above
    where: str  # page and line, for messages
    required: dict[str, str] = field(default_factory=dict)
    optional: dict[str, str] = field(default_factory=dict)
    includes: list[str] = field(default_factory=list)
    text: list[str] = field(default_factory=list)

    @property
    def options(self) -> set[str]:
        """All options it names, in lower case."""
        return {name.lower() for name in (*self.required, *self.optional)}


def fenced(page: str) -> Iterator[tuple[int, str, str, list[str]]]:
    """(line number, heading, language, lines) of each fenced block of a page."""
    heading, start, language, lines = "", 0, "", []
    inside = False
    for number, line in enumerate(read_page(page).splitlines(), 1):
        if line.startswith("```"):
            if inside:
                yield start, heading, language, lines
            inside, start, language, lines = not inside, number, line[3:].strip(), []
        elif inside:
            lines.append(line)
        elif line.startswith("#"):
            heading = line.lstrip("#").strip()


def config_blocks(page: str) -> list[Block]:
    """The config blocks of a page, one entry for each section in them."""
    blocks: list[Block] = []
    for number, heading, language, lines in fenced(page):
        has_sections = any(SECTION.match(line) for line in lines)
        shared = heading.lower().startswith("options of ") and not has_sections
        if language or not (shared or has_sections):
            continue
        block: Block | None = Block("", heading, number, f"{page}:{number}") if shared else None
        if block:
            blocks.append(block)
        for offset, line in enumerate(lines, 1):
            if section := SECTION.match(line):
                block = Block(section[1], heading, number, f"{page}:{number + offset}")
                blocks.append(block)
            if block is not None:
                _read_line(block, line)
    return blocks


def _read_line(block: Block, line: str) -> None:
    block.text.append(line)
    if include := INCLUDE.match(line):
        block.includes.append(include[1].lower())
    elif option := OPTION.match(line):
        (block.optional if option[1] else block.required)[option[2]] = option[3]
