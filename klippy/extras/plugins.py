"""[plugins]: loads third-party modules from a folder of the user's own.

A plugin is a file NAME.py, or a folder NAME with an __init__.py, written like the modules of this folder: it has
`load_config(config)` for [NAME] and `load_config_prefix(config)` for [NAME something]. Sections of plugins are loaded
where [plugins] stands in the config. Dropping the file into klippy/extras/ works as well, without this section.
"""

from __future__ import annotations

import importlib
import logging
import os
from types import ModuleType
from typing import Any

import extras


def plugin_names(folder: str) -> set[str]:
    """Names of the plugins in a folder."""
    names = set()
    for entry in os.listdir(folder):
        path = os.path.join(folder, entry)
        stem, ending = os.path.splitext(entry)
        if ending == ".py" or os.path.exists(os.path.join(path, "__init__.py")):
            names.add(stem)
    return {name for name in names if name.isidentifier() and not name.startswith("_")}


class Plugins:
    """The object `plugins`."""

    def __init__(self, printer: Any, folder: str) -> None:
        self.printer = printer
        self.folder = os.path.abspath(os.path.expanduser(folder))
        self.names: list[str] = []

    def find(self) -> None:
        """Make the folder's modules importable as extras.NAME; raises for a folder that cannot be used."""
        try:
            found = plugin_names(self.folder)
        except OSError as e:
            raise self.printer.config_error(
                f"Section 'plugins': unable to read the folder {self.folder}: {e.strerror}"
            ) from None
        own = plugin_names(os.path.dirname(os.path.abspath(__file__)))
        for name in sorted(found & own):
            raise self.printer.config_error(
                f"Section 'plugins': {self.folder}/{name} has the name of a module of this program; rename it"
            )
        self.names = sorted(found)
        if self.folder not in extras.__path__:
            extras.__path__.append(self.folder)
        importlib.invalidate_caches()

    def load(self, config: Any) -> None:
        """Load every section that belongs to one of the plugins."""
        for section in config.get_prefix_sections(""):
            words = section.get_name().split()
            if words[0] not in self.names or section.get_name() in self.printer.objects:
                continue
            module = self._import(words[0])
            loader = getattr(module, "load_config_prefix" if len(words) > 1 else "load_config", None)
            if loader is not None:
                self.printer.add_object(section.get_name(), loader(section))

    def _import(self, name: str) -> ModuleType:
        try:
            return importlib.import_module(f"extras.{name}")
        except Exception as e:
            logging.exception("Plugin %s", name)
            raise self.printer.config_error(f"Plugin '{name}' in {self.folder} does not load: {e}") from None

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Folder and names of the plugins in it."""
        return {"path": self.folder, "names": self.names}


def load_config(config: Any) -> Plugins:
    """Section [plugins]."""
    plugins = Plugins(config.get_printer(), config.get("path"))
    plugins.find()
    plugins.load(config)
    return plugins
