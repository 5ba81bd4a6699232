"""The printer's configuration: typed access to sections, the check for unknown options, and SAVE_CONFIG."""

from __future__ import annotations

import difflib
import logging
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import configreaders
import configtext
import util
from configtext import ConfigData, ConfigError, Origin

error = ConfigError


class _Required:
    """Marks an option without default."""

    def __repr__(self) -> str:
        return "(required)"


REQUIRED: Any = _Required()
_BOOLEANS = {
    "1": True,
    "yes": True,
    "true": True,
    "on": True,
    "0": False,
    "no": False,
    "false": False,
    "off": False,
}


def _parse_bool(text: str) -> bool:
    return _BOOLEANS[text.strip().lower()]


def _parse_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _parse_int(text: str) -> int:
    return int(text.strip(), 10)


_KINDS: dict[Any, str] = {
    _parse_bool: "yes or no (true, false, 1, 0)",
    _parse_float: "a number",
    _parse_int: "a whole number",
    float: "numbers",
    int: "whole numbers",
}


class ConfigWrapper:
    """One section of the configuration, as handed to the module that owns it."""

    error = ConfigError

    def __init__(
        self, printer: Any, data: ConfigData, access: dict[tuple[str, str], Any], section: str
    ) -> None:
        self.printer = printer
        self.section = section
        self._data = data
        self._access = access

    # --- what plugins look into ---
    @property
    def fileconfig(self) -> configtext.FileConfig:
        """The text of the whole config."""
        return configtext.FileConfig(self._data)

    @property
    def access_tracking(self) -> dict[tuple[str, str], Any]:
        """(section, option), in lower case, that count as read, with their values."""
        return self._access

    # --- the section itself ---
    def get_printer(self) -> Any:
        """The printer being configured."""
        return self.printer

    def get_name(self) -> str:
        """Full name of the section, e.g. `stepper_x` or `gcode_macro foo`."""
        return self.section

    def getsection(self, section: str) -> ConfigWrapper:
        """Another section of the same configuration (it need not exist)."""
        return ConfigWrapper(self.printer, self._data, self._access, section)

    def has_section(self, section: str) -> bool:
        """Whether a section is written in the config."""
        return section in self._data.sections

    def get_prefix_sections(self, prefix: str) -> list[ConfigWrapper]:
        """All sections whose name starts with `prefix`, in order."""
        return [self.getsection(name) for name in self._data.sections if name.startswith(prefix)]

    def get_prefix_options(self, prefix: str) -> list[str]:
        """Names of this section's options that start with `prefix`, in order."""
        section = self._data.sections.get(self.section)
        return [name for name in section.options if name.startswith(prefix)] if section else []

    def where(self, option: str | None = None) -> str:
        """Where the option (or the section) is written, for messages: `printer.cfg, line 12`."""
        section = self._data.sections.get(self.section)
        if section is None:
            return f"there is no section [{self.section}] in the config"
        found = section.options.get(option.lower()) if option else None
        return str(found.origin if found else section.origin)

    # --- options ---
    def get(self, option: str, default: Any = REQUIRED, note_valid: bool = True) -> Any:
        """The option's text, or `default`."""
        return self._fetch(option, default, str, note_valid)

    def getint(
        self,
        option: str,
        default: Any = REQUIRED,
        minval: int | None = None,
        maxval: int | None = None,
        note_valid: bool = True,
    ) -> Any:
        """A whole number within [minval, maxval]."""
        return self._bounded(option, self._fetch(option, default, _parse_int, note_valid), minval, maxval)

    def getfloat(
        self,
        option: str,
        default: Any = REQUIRED,
        minval: float | None = None,
        maxval: float | None = None,
        above: float | None = None,
        below: float | None = None,
        note_valid: bool = True,
    ) -> Any:
        """A finite number within [minval, maxval] and strictly between `above` and `below`."""
        value = self._fetch(option, default, _parse_float, note_valid)
        return self._bounded(option, value, minval, maxval, above, below)

    def getboolean(self, option: str, default: Any = REQUIRED, note_valid: bool = True) -> Any:
        """True or False."""
        return self._fetch(option, default, _parse_bool, note_valid)

    def getchoice(
        self,
        option: str,
        choices: Mapping[Any, Any] | Sequence[Any],
        default: Any = REQUIRED,
        note_valid: bool = True,
    ) -> Any:
        """One of `choices`: the mapped value, or the item itself if a list is given."""
        table = dict(choices) if isinstance(choices, Mapping) else {item: item for item in choices}
        parser = _parse_int if table and all(isinstance(key, int) for key in table) else str
        value = self._fetch(option, default, parser, note_valid)
        if value not in table:
            if not self._is_written(option):
                return value
            names = ", ".join(str(key) for key in table)
            raise self._problem(option, f"'{value}' is not one of the choices ({names})")
        return table[value]

    def getlists(
        self,
        option: str,
        default: Any = REQUIRED,
        seps: Sequence[str] = (",",),
        count: int | None = None,
        parser: Callable[[str], Any] = str,
        note_valid: bool = True,
    ) -> Any:
        """Nested tuples; `seps` from the innermost separator outwards, `count` items in the innermost."""

        def split(text: str, level: int) -> tuple[Any, ...]:
            parts = [part.strip() for part in text.split(seps[level])]
            if level == 0:
                items = tuple(parser(part) for part in parts if part)
                if count is not None and len(items) != count:
                    raise ConfigError(f"must have {count} elements, it has {len(items)}")
                if any(isinstance(item, float) and not math.isfinite(item) for item in items):
                    raise ValueError(text)
                return items
            return tuple(split(part, level - 1) for part in parts if part)

        kind = f"a list of {_KINDS.get(parser, 'values')} separated by '{seps[0]}'"
        return self._fetch(option, default, lambda text: split(text, len(seps) - 1), note_valid, kind)

    def getlist(
        self,
        option: str,
        default: Any = REQUIRED,
        sep: str = ",",
        count: int | None = None,
        note_valid: bool = True,
    ) -> Any:
        """A tuple of texts."""
        return self.getlists(option, default, (sep,), count, str, note_valid)

    def getintlist(
        self,
        option: str,
        default: Any = REQUIRED,
        sep: str = ",",
        count: int | None = None,
        note_valid: bool = True,
    ) -> Any:
        """A tuple of whole numbers."""
        return self.getlists(option, default, (sep,), count, int, note_valid)

    def getfloatlist(
        self,
        option: str,
        default: Any = REQUIRED,
        sep: str = ",",
        count: int | None = None,
        note_valid: bool = True,
    ) -> Any:
        """A tuple of numbers."""
        return self.getlists(option, default, (sep,), count, float, note_valid)

    def deprecate(self, option: str, value: str | None = None) -> None:
        """Warn the user if the option (with this value, if given) is in the config."""
        section = self._data.sections.get(self.section)
        written = section.options.get(option.lower()) if section else None
        if written is None or (value is not None and written.value.strip() != value):
            return
        what = f"Option '{option}' in section '{self.section}' is deprecated."
        if value is not None:
            what = f"Value '{value}' in option '{option}' in section '{self.section}' is deprecated."
        self.printer.lookup_object("configfile").add_warning(
            {
                "type": "deprecated_option" if value is None else "deprecated_value",
                "message": what,
                "section": self.section,
                "option": option,
                **({} if value is None else {"value": value}),
            }
        )

    # --- internals ---
    def _is_written(self, option: str) -> bool:
        section = self._data.sections.get(self.section)
        return section is not None and option.lower() in section.options

    def _problem(self, option: str, what: str) -> ConfigError:
        return ConfigError(f"Option '{option}' in section '{self.section}': {what} ({self.where(option)}).")

    def _fetch(
        self, option: str, default: Any, parser: Callable[[str], Any], note_valid: bool, kind: str = ""
    ) -> Any:
        key = option.lower()
        section = self._data.sections.get(self.section)
        written = section.options.get(key) if section is not None else None
        if written is None:
            if default is REQUIRED:
                raise ConfigError(
                    f"Option '{option}' in section '{self.section}' must be specified ({self.where()})."
                )
            if note_valid and default is not None:
                self._access.setdefault((self.section.lower(), key), default)
            return default
        try:
            value = parser(written.value)
        except ConfigError as e:
            raise self._problem(option, str(e)) from None
        except (ValueError, KeyError, TypeError, ArithmeticError):
            expected = kind or _KINDS.get(parser, "a valid value")
            raise self._problem(option, f"unable to parse '{written.value}', expected {expected}") from None
        if note_valid:
            self._access[(self.section.lower(), key)] = value
        return value

    def _bounded(
        self,
        option: str,
        value: Any,
        minval: float | None,
        maxval: float | None,
        above: float | None = None,
        below: float | None = None,
    ) -> Any:
        section = self._data.sections.get(self.section)
        if value is None or section is None or option.lower() not in section.options:
            return value  # a default is the module's own affair
        if minval is not None and value < minval:
            raise self._problem(option, f"must have minimum of {minval}, it is {value}")
        if maxval is not None and value > maxval:
            raise self._problem(option, f"must have maximum of {maxval}, it is {value}")
        if above is not None and value <= above:
            raise self._problem(option, f"must be above {above}, it is {value}")
        if below is not None and value >= below:
            raise self._problem(option, f"must be below {below}, it is {value}")
        return value


def _bare_pin(text: str) -> str:
    """A pin description without modifiers, blanks and the default chip."""
    return "".join(text.split()).lstrip("^~!").removeprefix("mcu:")


def _suggestion(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.7)
    return f" Did you mean '{close[0]}'?" if close else ""


def section_modules() -> set[str]:
    """Names a section may have because there is a module for it; a module without a loader is a helper of others."""
    folder = Path(__file__).with_name("extras")
    modules = {path.stem: path for path in folder.glob("*.py")}
    modules |= {path.parent.name: path for path in folder.glob("*/__init__.py")}
    return {name for name, path in modules.items() if "load_config" in path.read_text(encoding="utf-8")}


class PrinterConfig:
    """The object `configfile`: loads printer.cfg, reports it, and writes what modules want kept."""

    error = ConfigError

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self._data = ConfigData()
        self._saved: dict[str, dict[str, str]] = {}
        self._access: dict[tuple[str, str], Any] = {}
        self._pending: dict[str, dict[str, str] | None] = {}
        self._warnings: list[dict[str, Any]] = []
        self._settings: dict[str, dict[str, Any]] = {}
        printer.lookup_object("gcode").register_command(
            "SAVE_CONFIG", self.cmd_SAVE_CONFIG, desc="Overwrite config file and restart"
        )

    # --- loading ---
    def read_main_config(self) -> ConfigWrapper:
        """Parse the printer's config file and apply the overrides of the command line."""
        start_args = self.printer.get_start_args()
        data, saved = configtext.read_main(start_args["config_file"])
        self._saved = {
            name: {key: option.value for key, option in section.options.items()}
            for name, section in saved.sections.items()
        }
        for name, key, value in start_args.get("config_overrides", ()):
            data.set(name, key.lower(), str(value), Origin("command line", 0))
        for note in data.notes:
            logging.warning(note)
            self.add_warning({"type": "runtime_warning", "message": note})
        for warning in configtext.replace_old(data.sections):
            logging.warning(warning["message"])
            self.add_warning(warning)
        self._data = data
        return ConfigWrapper(self.printer, data, self._access, "printer")

    def read_config(self, filename: str) -> ConfigWrapper:
        """Another config file, for plugins that bring their data in one."""
        data = ConfigData()
        configtext.ConfigParser(data).parse_file(filename)
        return ConfigWrapper(self.printer, data, {}, "printer")

    def unused_options(self, failed: set[str]) -> list[str]:
        """What is wrong with sections and options that no module asked for.

        `failed`: parts of the printer that did not load; their sections may have been read in part only.
        """
        known_sections = {section for section, _ in self._access}
        known_sections.update(name.lower() for name, _ in self.printer.lookup_objects())
        problems: list[str] = []
        for name, section in self._data.sections.items():
            if name in failed or (failed and configreaders.is_read_last(name)):
                continue
            reader = configreaders.READ_BY.get(configreaders.kind_of(name))
            if reader in failed:
                continue
            if reader is not None and reader not in self._data.sections:
                problems.append(f"Section '{name}' needs a section [{reader}] ({section.origin}).")
                continue
            if name.lower() not in known_sections:
                hint = _suggestion(name, known_sections | section_modules())
                problems.append(f"Section '{name}' is not a valid config section ({section.origin}).{hint}")
                continue
            known_options = {option for sec, option in self._access if sec == name.lower()}
            for key, option in section.options.items():
                if key not in known_options:
                    hint = _suggestion(key, known_options)
                    problems.append(
                        f"Option '{key}' is not valid in section '{name}' ({option.origin}).{hint}"
                    )
        return problems

    def note_settings(self) -> None:
        """The config is in force: its values for status."""
        for (name, key), value in self._access.items():
            self._settings.setdefault(name, {})[key] = value

    def users_of(self, value: str) -> list[str]:
        """`[section] option` of every option read so far that names the pin `value` (for messages)."""
        wanted = _bare_pin(value)
        return [
            f"[{section}] {option}"
            for (section, option), text in self._access.items()
            if isinstance(text, str) and _bare_pin(text) == wanted
        ]

    def log_config(self, config: ConfigWrapper) -> None:
        """Write the configuration in force to the log (kept across log rollover)."""
        lines = ["===== Config file ====="]
        for name, section in self._data.sections.items():
            lines.append(f"[{name}]")
            for key, option in section.options.items():
                lines.append(f"{key} = " + option.value.replace("\n", "\n\t"))
            lines.append("")
        lines.append("=======================")
        self.printer.set_rollover_info("config", "\n".join(lines))

    # --- status ---
    def add_warning(self, warning: dict[str, Any]) -> None:
        """Add an entry to `configfile.warnings`, once."""
        if warning not in self._warnings:
            self._warnings = [*self._warnings, warning]

    def runtime_warning(self, message: str) -> None:
        """Warn the user of something found while running."""
        logging.warning(message)
        self.add_warning({"type": "runtime_warning", "message": message})

    @property
    def status_raw_config(self) -> dict[str, dict[str, str]]:
        """The text of every option; plugins read it, too."""
        return {
            name: {key: option.value for key, option in section.options.items()}
            for name, section in self._data.sections.items()
        }

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Raw text, typed settings, warnings and what SAVE_CONFIG would write."""
        return {
            "config": self.status_raw_config,
            "settings": self._settings,
            "warnings": self._warnings,
            "save_config_pending": bool(self._pending),
            "save_config_pending_items": self._pending,
        }

    # --- saving ---
    def set(self, section: str, option: str, value: Any) -> None:
        """Remember a value for the next SAVE_CONFIG."""
        text = str(value)
        self._saved.setdefault(section, {})[option.lower()] = text
        pending = dict(self._pending.get(section) or {})
        pending[option.lower()] = text
        self._pending = {**self._pending, section: pending}
        logging.info("save_config: set [%s] %s = %s", section, option, text)

    def remove_section(self, section: str) -> None:
        """Forget a section of the SAVE_CONFIG block."""
        if self._saved.pop(section, None) is not None:
            self._pending = {**self._pending, section: None}

    def cmd_SAVE_CONFIG(self, gcmd: Any) -> None:
        """Write the pending values into the config file (keeping a backup), then restart."""
        if not self._pending:
            gcmd.respond_info("SAVE_CONFIG: there is nothing to save")
            return
        try:
            backup = self._write(self.printer.get_start_args()["config_file"])
        except (OSError, ConfigError) as e:
            raise gcmd.error(f"SAVE_CONFIG: unable to write the config file: {e}") from None
        logging.info("SAVE_CONFIG: backup in %s", backup)
        self._pending = {}
        if gcmd.get_int("RESTART", 1):
            self.printer.lookup_object("gcode").request_restart("restart")

    def _write(self, path: str) -> str:
        """Replace the config file; returns the path of the backup."""
        user_text, _ = configtext.split_autosave(configtext.read_text(path))
        edited = configtext.comment_out(user_text, self._saved)
        self._check_includes(edited, path)
        block = configtext.format_autosave(self._saved)
        text = edited.rstrip("\n") + "\n" + ("\n" + block if block else "")
        stem, ending = os.path.splitext(path)
        backup = stem + time.strftime("-%Y%m%d_%H%M%S") + ending
        util.replace_file(path, text, backup)
        return backup

    def _check_includes(self, edited: str, path: str) -> None:
        """An option to be saved must not be set by an included file: we do not edit those."""
        data = ConfigData()
        configtext.ConfigParser(data).parse_text(edited, path)
        for section, options in self._saved.items():
            for option in options:
                written = data.sections.get(section)
                if written is not None and option in written.options:
                    raise ConfigError(
                        f"option '{option}' of section '{section}' is set in an included file "
                        f"({written.options[option].origin}); move it to the main config file first"
                    )
