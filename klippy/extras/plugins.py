"""[plugins]: loads third-party modules from a folder of the user's own.

A plugin is a file NAME.py, or a folder NAME with an __init__.py, written like the modules of this folder: it has
`load_config(config)` for [NAME] and `load_config_prefix(config)` for [NAME something]. The folder becomes part of the
package `extras`, before any other section is loaded. Dropping the file into klippy/extras/ works as well.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

import extras
from configfile import ConfigWrapper
from roles import Printer


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

    def __init__(self, printer: Printer, folder: str) -> None:
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
        extras.__path__.append(self.folder)
        importlib.invalidate_caches()

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Folder and names of the plugins in it."""
        return {"path": self.folder, "names": self.names}


def load_config(config: ConfigWrapper) -> Plugins:
    """Section [plugins]."""
    plugins = Plugins(config.get_printer(), config.get("path"))
    plugins.find()
    return plugins
