"""The printer.cfg text format: parsing to sections of options, and editing text for SAVE_CONFIG.

Grammar (as documented in Klipper's Config_Reference): `[section]` headers; `option: value` or `option = value`; lines
indented deeper than their option continue its value; `#` starts a comment anywhere, `;` at the start of a line or
after a blank; `[include PATTERN]` inserts other files, relative to the including one. Sections and options may be
repeated: the later one wins. At the very end of the main file there may be a block of lines prefixed with `#*#`,
written by SAVE_CONFIG, whose options override those above.

Nothing here knows a printer: text in, `ConfigData` out.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import util

# Of earlier versions
OLD_OPTIONS = {"practical_turn": "two_period_turn", "practical_cutoff": "two_period_cutoff"}
OLD_VALUES = {("control", "practical"): "two_period"}
AUTOSAVE_PREFIX = "#*#"
AUTOSAVE_HEADER = (
    "#*# <---------------------- SAVE_CONFIG ---------------------->\n"
    "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n"
    "#*#\n"
)
_AUTOSAVE_START = re.compile(r"^#\*# <-+ SAVE_CONFIG -+>", re.MULTILINE)
_HEADER = re.compile(r"\[(?P<name>.+)\]")
_OPTION = re.compile(r"(?P<name>[^:=]+?)\s*[:=]\s*(?P<value>.*)")
_SEMICOLON = re.compile(r"(^|\s);.*$")


class ConfigError(Exception):
    """The configuration is wrong; the text is for the user."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Where something was written."""

    path: str
    line: int

    def __str__(self) -> str:
        return f"{os.path.basename(self.path)}, line {self.line}" if self.line else self.path


@dataclass(slots=True)
class OptionText:
    """One option as written."""

    value: str
    origin: Origin


@dataclass(slots=True)
class SectionText:
    """All options of one section name, from all places in the files."""

    name: str
    origin: Origin
    options: dict[str, OptionText] = field(default_factory=dict)


@dataclass(slots=True)
class ConfigData:
    """Parsed configuration: sections by name in order of appearance, notes for the user."""

    sections: dict[str, SectionText] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def set(self, section: str, option: str, value: str, origin: Origin) -> None:
        """Set one option, making its section if need be."""
        target = self.sections.setdefault(section, SectionText(section, origin))
        target.options[option] = OptionText(value, origin)


class FileConfig:
    """A config's text as plugins look at it and change it: with the methods of Python's configparser that they call."""

    def __init__(self, data: ConfigData) -> None:
        self._data = data

    def sections(self) -> list[str]:
        return list(self._data.sections)

    def has_section(self, section: str) -> bool:
        return section in self._data.sections

    def add_section(self, section: str) -> None:
        if self.has_section(section):
            raise ConfigError(f"Section '{section}' is there already.")
        self._data.sections[section] = SectionText(section, Origin("a plugin", 0))

    def remove_section(self, section: str) -> bool:
        return self._data.sections.pop(section, None) is not None

    def _options(self, section: str) -> dict[str, OptionText]:
        found = self._data.sections.get(section)
        if found is None:
            raise ConfigError(f"There is no section '{section}' in the config.")
        return found.options

    def options(self, section: str) -> list[str]:
        return list(self._options(section))

    def items(self, section: str) -> list[tuple[str, str]]:
        return [(name, option.value) for name, option in self._options(section).items()]

    def has_option(self, section: str, option: str) -> bool:
        return self.has_section(section) and option.lower() in self._options(section)

    def get(self, section: str, option: str) -> str:
        if option.lower() not in self._options(section):
            raise ConfigError(f"There is no option '{option}' in section '{section}'.")
        return self._options(section)[option.lower()].value

    def set(self, section: str, option: str, value: str) -> None:
        self._options(section)[option.lower()] = OptionText(str(value), Origin("a plugin", 0))

    def remove_option(self, section: str, option: str) -> bool:
        return self._options(section).pop(option.lower(), None) is not None


def strip_comment(line: str) -> str:
    """The line without its comment and trailing blanks."""
    return _SEMICOLON.sub("", line.partition("#")[0]).rstrip()


def split_autosave(text: str) -> tuple[str, str]:
    """Split the main file into what the user wrote and the body of the SAVE_CONFIG block (prefixes removed).

    A block that was edited by hand (lines without the prefix after its start) raises an error.
    """
    start = _AUTOSAVE_START.search(text)
    if start is None:
        return text, ""
    block = text[start.start() :].rstrip("\n").split("\n")
    body: list[str] = []
    for number, line in enumerate(block):
        if line.strip() and not line.startswith(AUTOSAVE_PREFIX):
            at = text[: start.start()].count("\n") + number + 1
            raise ConfigError(
                f"Line {at} of the main config file is inside the SAVE_CONFIG block but does not start with "
                f"'{AUTOSAVE_PREFIX}'. Move what you added above the block (text: '{line.strip()}')."
            )
        content = line[len(AUTOSAVE_PREFIX) :]
        body.append(content[1:] if content.startswith(" ") else content)
    # Header lines are no options; empty lines in their place keep the line numbers right
    kept = ["" if number == 0 or line.startswith("DO NOT EDIT") else line for number, line in enumerate(body)]
    return text[: start.start()], "\n".join(kept)


def read_text(path: str) -> str:
    """The text of a config file, line ends normalised."""
    try:
        return util.read_plain(path)
    except UnicodeDecodeError as e:
        raise ConfigError(f"Config file {path} is not valid UTF-8 text (byte {e.start}).") from None
    except OSError as e:
        raise ConfigError(f"Unable to open config file {path}: {e.strerror}.") from None


class ConfigParser:
    """Adds the content of texts and files to one `ConfigData`."""

    def __init__(self, data: ConfigData, reader: Callable[[str], str] = read_text) -> None:
        self.data = data
        self._reader = reader
        self._open_files: list[str] = []

    def parse_file(self, path: str) -> None:
        """Read a file and whatever it includes."""
        self.parse_text(self._reader(path), path)

    def parse_text(self, text: str, path: str, first_line: int = 1) -> None:
        """Read text that came from `path`, starting at `first_line` of it."""
        real = os.path.realpath(path)
        if real in self._open_files:
            chain = " -> ".join(os.path.basename(p) for p in [*self._open_files, real])
            raise ConfigError(f"Config file includes itself: {chain}.")
        self._open_files.append(real)
        try:
            _TextReader(self, path).read(text, first_line)
        finally:
            self._open_files.pop()

    def include(self, pattern: str, origin: Origin) -> None:
        """Handle one `[include PATTERN]`."""
        full = os.path.join(os.path.dirname(origin.path), pattern)
        paths = sorted(glob.glob(full))
        if not paths and not glob.has_magic(full):
            raise ConfigError(f"Include file '{full}' does not exist ({origin}).")
        for path in paths:
            self.parse_file(path)


class _TextReader:
    """State of reading one file: current section, and the option whose value may go on."""

    def __init__(self, parser: ConfigParser, path: str) -> None:
        self._parser = parser
        self._path = path
        self._section: SectionText | None = None
        self._option = ""
        self._option_indent = -1
        self._lines: list[str] = []
        self._origin = Origin(path, 0)
        self._seen: set[tuple[str, str]] = set()

    def read(self, text: str, first_line: int) -> None:
        for number, raw in enumerate(text.split("\n"), first_line):
            line = strip_comment(raw.expandtabs(8).replace("\r", "").replace("\ufeff", ""))
            content = line.strip()
            if not content:
                self._lines.append("")
                continue
            indent = len(line) - len(line.lstrip())
            if self._option and indent > self._option_indent:
                self._lines.append(content)
                continue
            self._finish_option()
            self._start_line(content, indent, Origin(self._path, number))
        self._finish_option()

    def _start_line(self, content: str, indent: int, origin: Origin) -> None:
        header = _HEADER.match(content)
        if header is not None:
            self._start_section(header["name"].strip(), origin)
            return
        option = _OPTION.match(content)
        if option is None:
            raise ConfigError(
                f"Unable to understand the line '{content}' in the config ({origin}): "
                "expected '[section]' or 'option: value'."
            )
        if self._section is None:
            raise ConfigError(f"Option '{option['name']}' stands before the first [section] ({origin}).")
        self._option, self._option_indent = option["name"].strip().lower(), indent
        self._lines, self._origin = [option["value"].strip()], origin

    def _start_section(self, name: str, origin: Origin) -> None:
        if name.startswith("include "):
            self._section = None
            self._parser.include(name[len("include ") :].strip(), origin)
        elif not name:
            raise ConfigError(f"Section without a name ({origin}).")
        else:
            sections = self._parser.data.sections
            self._section = sections.setdefault(name, SectionText(name, origin))

    def _finish_option(self) -> None:
        if self._option and self._section is not None:
            key = (self._section.name, self._option)
            if key in self._seen:
                self._parser.data.notes.append(
                    f"Option '{self._option}' is given twice in section '{self._section.name}'; "
                    f"the one at {self._origin} is used."
                )
            self._seen.add(key)
            value = "\n".join(self._lines).strip("\n")
            self._section.options[self._option] = OptionText(value, self._origin)
        self._option, self._option_indent, self._lines = "", -1, []


def read_main(path: str) -> tuple[ConfigData, ConfigData]:
    """(the main config file with all it includes, of that what SAVE_CONFIG wrote). Raises ConfigError."""
    user_text, saved_text = split_autosave(read_text(path))
    data, saved = ConfigData(), ConfigData()
    ConfigParser(data).parse_text(user_text, path)
    ConfigParser(saved).parse_text(saved_text, path, user_text.count("\n") + 1)
    for name, section in saved.sections.items():
        for key, option in section.options.items():
            data.set(name, key, option.value, option.origin)
    return data, saved


def format_autosave(saved: dict[str, dict[str, str]]) -> str:
    """The SAVE_CONFIG block for sections of options; empty text if there is nothing to save."""
    if not any(saved.values()):
        return ""
    lines: list[str] = []
    for section, options in saved.items():
        if not options:
            continue
        lines.append(f"[{section}]")
        for option, value in options.items():
            first, *more = value.split("\n")
            lines.append(f"{option} = {first}".rstrip())
            lines.extend(f"\t{line}" for line in more)
        lines.append("")
    return AUTOSAVE_HEADER + "".join(f"{AUTOSAVE_PREFIX} {line}".rstrip() + "\n" for line in lines[:-1])


def comment_out(text: str, saved: dict[str, dict[str, str]]) -> str:
    """Comment out the options of `saved` in the user's own text; everything else stays byte for byte."""
    section, hiding_indent = "", -1
    result: list[str] = []
    for raw in text.split("\n"):
        line = strip_comment(raw.expandtabs(8))
        content = line.strip()
        indent = len(line) - len(line.lstrip())
        if hiding_indent >= 0 and content and indent <= hiding_indent:
            hiding_indent = -1
        header = _HEADER.match(content)
        option = _OPTION.match(content)
        if hiding_indent < 0 and header is not None and indent == 0:
            section = header["name"].strip()
        elif (
            hiding_indent < 0
            and option is not None
            and option["name"].strip().lower() in saved.get(section, {})
        ):
            hiding_indent = indent
        result.append("#" + raw if hiding_indent >= 0 and content else raw)
    return "\n".join(result)


def replace_old(sections: Mapping[str, SectionText]) -> Iterator[dict[str, Any]]:
    """Replace option names and values of earlier versions in place; a warning for each.

    An option written under today's name, too, keeps that value.
    """
    for name, section in sections.items():
        for key, option in list(section.options.items()):
            value = option.value.strip()
            if new := OLD_OPTIONS.get(key):
                section.options.setdefault(new, section.options.pop(key))
                message = f"Option '{key}' in section '{name}' is now called '{new}' ({option.origin})."
                yield {"type": "deprecated_option", "message": message, "section": name, "option": key}
            elif new := OLD_VALUES.get((key, value)):
                section.options[key] = OptionText(new, option.origin)
                message = (
                    f"Value '{value}' of option '{key}' in section '{name}' is now '{new}' ({option.origin})."
                )
                warning = {"type": "deprecated_value", "message": message, "section": name, "option": key}
                yield {**warning, "value": value}
