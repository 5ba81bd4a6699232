"""HEATER_PROFILE: named tunings of any heater, whatever its `control:`.

    HEATER_PROFILE HEATER=extruder SAVE=fast        keep the tuning in use under a name
    HEATER_PROFILE HEATER=extruder LOAD=fast        work with it from now on, until the next restart
    HEATER_PROFILE HEATER=extruder USE=fast         the same, and make it the heater's own
    HEATER_PROFILE HEATER=extruder REMOVE=fast
    HEATER_PROFILE [HEATER=extruder] LIST=1

SAVE_CONFIG writes what SAVE, USE and REMOVE changed: a profile is a section [heater_profile HEATER NAME] whose options
are those of the tuning. Switching keeps the target and continues at the present output.
"""

from __future__ import annotations

import re
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

from .heater import laws as heater_laws
from .heater import tuning as heater_tuning

SECTION = "heater_profile"
NAME = re.compile(r"[A-Za-z0-9_.-]+")
VERBS = ("SAVE", "LOAD", "USE", "REMOVE")


class HeaterProfiles:
    """All profiles of all heaters."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.profiles: dict[tuple[str, str], dict[str, str]] = {}  # (heater, profile) → tuning
        self._sections: dict[tuple[str, str], Any] = {}  # the same, as written in the config
        self.loaded: dict[str, str] = {}  # heater → profile in use

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "HEATER_PROFILE",
            self.cmd_HEATER_PROFILE,
            desc="Save, load, use, list or remove tunings of a heater",
        )
        self.printer.register_event_handler("klippy:connect", self._check)

    def read(self, config: ConfigWrapper) -> None:
        """One section [heater_profile HEATER NAME]."""
        words = config.get_name().split()
        if len(words) != 3:
            raise config.error(
                f"Section '{config.get_name()}' must be named [{SECTION} HEATER NAME] ({config.where()})."
            )
        names = {*heater_tuning.INDUCTION_OPTIONS, *(n for o in heater_laws.OPTIONS.values() for n in o)}
        texts = {name: config.get(name, None) for name in sorted(names | {"control"})}
        self.profiles[words[1], words[2]] = {name: text for name, text in texts.items() if text is not None}

        self._sections[words[1], words[2]] = config

    def _check(self) -> None:
        """All heaters are there: a profile that none of them could use is reported now, not when it is requested."""
        heaters = self.printer.lookup_object("heaters")
        for (name, _), config in self._sections.items():
            try:
                heater = heaters.lookup_heater(name)
            except config.error as e:
                raise config.error(f"Section '{config.get_name()}': {e} ({config.where()}).") from None
            heater_tuning.read(heater, config, self.profiles[name, config.get_name().split()[2]])

    def cmd_HEATER_PROFILE(self, gcmd: GCodeCommand) -> None:
        verbs = [verb for verb in VERBS if gcmd.get(verb, None) is not None]
        if gcmd.get("LIST", None) is not None and not verbs:
            self._list(gcmd)
            return
        if len(verbs) != 1:
            raise gcmd.error("HEATER_PROFILE needs one of SAVE=, LOAD=, USE=, REMOVE= with a name, or LIST=1")
        heater = heater_tuning.heater_of(self.printer, gcmd)
        name = gcmd.get(verbs[0])
        if not NAME.fullmatch(name):
            raise gcmd.error(f"'{name}' is no profile name: letters, digits, '_', '-' and '.' only")
        if verbs[0] == "SAVE":
            self._save(gcmd, heater, name)
            return
        tuning = self.profiles.get((heater.name, name))
        if tuning is None:
            known = ", ".join(sorted(n for h, n in self.profiles if h == heater.name)) or "none"
            raise gcmd.error(f"Heater '{heater.name}' has no profile '{name}' (known: {known})")
        if verbs[0] == "REMOVE":
            self._remove(gcmd, heater, name)
        else:
            self._load(gcmd, heater, name, tuning, keep=verbs[0] == "USE")

    def _list(self, gcmd: GCodeCommand) -> None:
        wanted = gcmd.get("HEATER", None)
        if wanted is not None:
            wanted = heater_tuning.heater_of(self.printer, gcmd).name
        lines = []
        for (heater, name), tuning in sorted(self.profiles.items()):
            if wanted in (None, heater):
                mark = " (in use)" if self.loaded.get(heater) == name else ""
                lines.append(f"{heater} {name}{mark}: " + " ".join(f"{k}={v}" for k, v in tuning.items()))
        gcmd.respond_info("\n".join(lines) or "There are no heater profiles")

    def _save(self, gcmd: GCodeCommand, heater: Any, name: str) -> None:
        heater_tuning.refuse_in_calibration(heater)
        tuning = dict(heater_tuning.options_of(heater))
        configfile = self.printer.lookup_object("configfile")
        section = f"{SECTION} {heater.name} {name}"
        configfile.remove_section(section)
        for option, value in tuning.items():
            configfile.set(section, option, value)
        self.profiles[heater.name, name] = tuning
        self.loaded[heater.name] = name
        gcmd.respond_info(
            f"Profile '{name}' of heater '{heater.name}' saved; SAVE_CONFIG writes it to the file"
        )

    def _load(self, gcmd: GCodeCommand, heater: Any, name: str, tuning: dict[str, str], keep: bool) -> None:
        heater_tuning.use(self.printer, heater, tuning)
        self.loaded[heater.name] = name
        if keep:
            heater_tuning.stage(self.printer, heater, tuning)
        end = "; SAVE_CONFIG makes it the heater's own" if keep else " until the next restart"
        gcmd.respond_info(f"Heater '{heater.name}' works with profile '{name}'{end}")

    def _remove(self, gcmd: GCodeCommand, heater: Any, name: str) -> None:
        del self.profiles[heater.name, name]
        if self.loaded.get(heater.name) == name:
            del self.loaded[heater.name]
        self.printer.lookup_object("configfile").remove_section(f"{SECTION} {heater.name} {name}")
        gcmd.respond_info(
            f"Profile '{name}' of heater '{heater.name}' removed; SAVE_CONFIG removes it from the file"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        names: dict[str, list[str]] = {}
        for heater, name in sorted(self.profiles):
            names.setdefault(heater, []).append(name)
        return {"profiles": names, "loaded": dict(self.loaded)}


def load_config(config: ConfigWrapper) -> HeaterProfiles:
    profiles = HeaterProfiles(config.get_printer())
    profiles.register()
    for section in config.get_prefix_sections(f"{SECTION} "):
        profiles.read(section)
    return profiles


def load_config_prefix(config: ConfigWrapper) -> HeaterProfiles:
    """A profile is read with all the others."""
    profiles: HeaterProfiles = config.get_printer().load_object(config, SECTION)
    return profiles
