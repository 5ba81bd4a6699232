"""The data folder of a printer, as Moonraker and the web front ends expect it, and its first contents.

prepare(config)   config/*.cfg ── serial and gcode paths of this folder put in ──► DATA/config/printer.cfg
                  what front ends need and the config lacks,                   ──► DATA/config/frontend.cfg
                  macros of config/macros-induction.cfg among it
"""

from __future__ import annotations

import re
from pathlib import Path

import configtext

_SOCKET_PATH_LIMIT = 107  # bytes; sockaddr_un
_FOLDERS = ("config", "gcodes", "logs", "comms", "misc")
_HEADER = re.compile(r"\[([^\]]+)\]")
_INCLUDE = re.compile(r"\[include\s+([^\]]+)\]")

# Section → text, in the order in which they are written. Front ends warn if one of them is missing.
FRONT_END_SECTIONS = {
    "virtual_sdcard": "path: {gcodes}\n",
    "display_status": "",
    "pause_resume": "",
    "exclude_object": "",
    "respond": "",
}
# So they do for these, which are taken from the file with whatever else it has. PAUSE and RESUME belong together.
FRONT_END_MACROS = frozenset(f"gcode_macro {name}" for name in ("pause", "resume", "cancel_print"))
PAUSE_AND_RESUME = frozenset({"gcode_macro pause", "gcode_macro resume"})
MACROS_FILE = Path("config") / "macros-induction.cfg"

MOONRAKER_CONF = """\
# Moonraker for the simulated printer: this computer only, no services, nothing fetched from the network.
[server]
host: 127.0.0.1
port: {port}
klippy_uds_address: {socket}

[authorization]
trusted_clients:
    127.0.0.0/8
    ::1/128
cors_domains:
    http://127.0.0.1:*
    http://localhost:*

[machine]
provider: none
validate_service: False
validate_config: False

[announcements]
enable_moonlight: False

[octoprint_compat]

[history]
"""


class DataError(Exception):
    """The folder cannot be used; the text is for people."""


class PrinterData:
    """Paths of one data folder. `checkout`: where the program is."""

    def __init__(self, root: Path, checkout: Path) -> None:
        self.root = root.expanduser().resolve()
        if checkout.resolve() in (self.root, *self.root.parents):
            # Moonraker refuses uploads below the host's own folder
            raise DataError(
                f"the data folder {self.root} must be outside of the program's folder {checkout}."
            )
        self._macros = checkout / MACROS_FILE
        self.config = self.root / "config" / "printer.cfg"
        self.gcodes = self.root / "gcodes"
        self.logs = self.root / "logs"
        self.log = self.logs / "klippy.log"
        self.socket = self.root / "comms" / "klippy.sock"
        self.terminal = self.root / "comms" / "klippy.serial"
        if len(str(self.socket).encode()) > _SOCKET_PATH_LIMIT:
            raise DataError(
                f"the path {self.socket} is too long for a socket; choose a shorter --data folder."
            )

    def prepare(self, source: Path) -> str:
        """Make folders and, if there is none, printer.cfg; returns what was done, for people."""
        for name in _FOLDERS:
            (self.root / name).mkdir(parents=True, exist_ok=True)
        (self.root / "misc" / "usb.ids").touch()  # Moonraker fetches it from the network if it is missing
        if self.config.exists():
            return f"{self.config} kept as it is"
        data = configtext.ConfigData()
        try:
            configtext.ConfigParser(data).parse_text(
                configtext.split_autosave(configtext.read_text(str(source)))[0], str(source)
            )
        except configtext.ConfigError as e:
            raise DataError(str(e)) from None
        self._copy(source, self.config, set())
        extra = self._front_end(set(data.sections))
        if extra:
            (self.config.parent / "frontend.cfg").write_text(extra, encoding="utf-8")
            text = self.config.read_text(encoding="utf-8")
            self.config.write_text(
                "# What web front ends need: pausing, macros, files.\n[include frontend.cfg]\n\n" + text,
                encoding="utf-8",
            )
        return f"{self.config} made from {source}"

    def _copy(self, source: Path, target: Path, done: set[Path]) -> None:
        """A config file and those it includes, with the paths of this folder."""
        if source.resolve() in done:
            return
        done.add(source.resolve())
        text = source.read_text(encoding="utf-8")
        target.write_text(self.localise(text), encoding="utf-8")
        for line in text.splitlines():
            include = _INCLUDE.match(line.strip())
            if include is None or Path(include[1].strip()).is_absolute():  # that stays where it is
                continue
            for path in source.parent.glob(include[1].strip()):
                inner = target.parent / path.relative_to(source.parent)
                inner.parent.mkdir(parents=True, exist_ok=True)
                self._copy(path, inner, done)

    def localise(self, text: str) -> str:
        """`serial` of MCUs and `path` of the virtual SD card become paths of this folder; the rest is untouched."""
        section = ""
        lines = []
        for line in text.split("\n"):
            header = _HEADER.match(line)
            if header is not None:
                section = header[1].strip()
            name = re.split(r"[:=]", line, maxsplit=1)[0].strip()
            if section.split()[:1] == ["mcu"] and name == "serial":
                lines.append(f"serial: {self.root / 'comms' / section.replace(' ', '_')}")
            elif section == "virtual_sdcard" and name == "path":
                lines.append(f"path: {self.gcodes}")
            else:
                lines.append(line)
        return "\n".join(lines)

    def _front_end(self, present: set[str]) -> str:
        blocks = [
            f"[{section}]\n{text.format(gcodes=self.gcodes)}"
            for section, text in FRONT_END_SECTIONS.items()
            if section not in present
        ]
        own = {section.lower() for section in present}
        if own & PAUSE_AND_RESUME:
            own |= PAUSE_AND_RESUME
        if not own >= FRONT_END_MACROS:
            blocks.append(_without(self._macros.read_text(encoding="utf-8"), own))
        return "\n".join(blocks)

    def write_moonraker_conf(self, port: int) -> Path:
        """moonraker.conf of this folder; one that is there is kept, except for port and socket."""
        path = self.config.parent / "moonraker.conf"
        if path.exists():
            text = path.read_text(encoding="utf-8")
            text = re.sub(r"(?m)^port\s*:.*$", f"port: {port}", text)
            text = re.sub(r"(?m)^klippy_uds_address\s*:.*$", f"klippy_uds_address: {self.socket}", text)
        else:
            text = MOONRAKER_CONF.format(port=port, socket=self.socket)
        path.write_text(text, encoding="utf-8")
        return path


def _without(text: str, sections: set[str]) -> str:
    """The text of a config file without these sections (small letters)."""
    kept = []
    for block in re.split(r"(?m)^(?=\[)", text):
        header = _HEADER.match(block)
        if header is None or header[1].strip().lower() not in sections:
            kept.append(block)
    return "".join(kept)
