"""The simulated printer in real time, each MCU behind a pseudo terminal.

    host program ── /dev/pts/N ══ master fd ── world_feed / world_drain ── line ── MCU

The world is the same as in a simulated print; only here the wall clock asks for time to pass. A pseudo
terminal takes no time of its own, the line inside the world does (its baud rate and latency).
"""

from __future__ import annotations

import logging
import os
import select
import time
import tty
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import configtext
from configfile import ConfigWrapper
from extras import simulator as simulator_sections

from .machine import Machine, Settings, assemble
from .world import World, WorldError, parameter_tables

STEP_S = 0.001  # how often the world catches up with the wall clock
BEHIND_S = 1.0  # more than this and the world gives up catching up (a suspended computer)


def read_settings(path: Path) -> tuple[list[Settings], dict[str, dict[str, str]]]:
    """Simulator sections and the whole file as text. Raises WorldError with a text for people."""
    data = configtext.ConfigData()
    try:
        text = configtext.split_autosave(configtext.read_text(str(path)))[0]
        configtext.ConfigParser(data).parse_text(text, str(path))
        settings = [_read_section(data, name) for name in data.sections if name.split()[0] == "simulator"]
    except configtext.ConfigError as e:
        raise WorldError(str(e)) from None
    config = {
        name: {key: option.value for key, option in section.options.items()}
        for name, section in data.sections.items()
    }
    return settings, config


def _read_section(data: configtext.ConfigData, name: str) -> Settings:
    # the section readers ask their printer for one thing only
    printer = SimpleNamespace(get_start_args=lambda: {"simulator_parameters": parameter_tables()})
    access: dict[tuple[str, str], Any] = {}
    wrapper = ConfigWrapper(printer, data, access, name)
    settings: Settings
    if " " in name:
        settings = simulator_sections.load_config_prefix(wrapper).settings
    else:
        settings = simulator_sections.read_settings(wrapper)
    for option in data.sections[name].options:
        if (name.lower(), option) not in access:
            raise WorldError(f"Option '{option}' is not valid in section '{name}' ({wrapper.where(option)}).")
    return settings


@dataclass(slots=True)
class _Terminal:
    mcu: int
    master: int
    slave: int  # held open: the master would report an error while no host is connected
    link: Path


class RealTimePrinter:
    """The machine of a config file in real time. By MCU: `terminals`, paths; `builds`, what they run."""

    def __init__(
        self,
        config: Path,
        terminals: Mapping[str, Path],
        seed: int = 1,
        trace: Path | None = None,
        builds: Mapping[str, str] | None = None,
    ) -> None:
        settings, text = read_settings(config)
        self.world = World(seed)
        self.machine: Machine = assemble(self.world, settings, text, builds)
        self.world.open_trace(trace, self.machine.recording.trace_rate_hz)
        paths = {name: Path(serial) for serial, name in self.machine.serials.items()}
        paths.update(terminals)
        unknown = set(terminals) - set(self.machine.mcus)
        if unknown:
            raise WorldError(f"--pty names the MCU '{unknown.pop()}', which is not in {config}.")
        self._terminals: list[_Terminal] = []
        self._poll = select.poll()
        for name, mcu in self.machine.mcus.items():
            if name in paths:
                self._open_terminal(mcu, paths[name])
        if not self._terminals:
            raise WorldError(f"{config} has no MCU with a serial path; give one with --pty PATH.")

    @property
    def paths(self) -> list[Path]:
        """Where a host can connect."""
        return [terminal.link for terminal in self._terminals]

    def _open_terminal(self, mcu: int, link: Path) -> None:
        if link.exists() and not link.is_symlink():
            raise WorldError(
                f"{link} exists and is no link to a pseudo terminal; choose another path with --pty."
            )
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(slave))
        self._terminals.append(_Terminal(mcu, master, slave, link))
        self._poll.register(master, select.POLLIN)

    def run(self, until_s: float | None = None) -> None:
        """Until interrupted, or for `until_s` seconds."""
        begin = time.monotonic() - (self.world.now - self.world.start_s)
        while until_s is None or self.world.now - self.world.start_s < until_s:
            self._poll.poll(1000.0 * STEP_S)
            behind_s = time.monotonic() - begin - (self.world.now - self.world.start_s)
            if behind_s > BEHIND_S:
                logging.warning("simulated printer: %.1f s behind, time skipped", behind_s)
                begin += behind_s - STEP_S
            self._exchange(self.world.start_s + time.monotonic() - begin)

    def _exchange(self, world_time_s: float) -> None:
        for terminal in self._terminals:
            try:
                data = os.read(terminal.master, 4096)
            except BlockingIOError:
                continue
            self.world.feed_bytes(terminal.mcu, data)
        self.world.advance(world_time_s)
        for terminal in self._terminals:
            data = self.world.drain_bytes(terminal.mcu)
            if data:
                try:
                    os.write(terminal.master, data)
                except BlockingIOError:
                    pass  # no reader: bytes are lost, as on a wire

    def close(self) -> None:
        """Remove the terminals and finish the trace."""
        for terminal in self._terminals:
            if terminal.link.is_symlink():
                terminal.link.unlink()
            os.close(terminal.master)
            os.close(terminal.slave)
        self._terminals.clear()
        self.world.close_trace()
        self.world.close()
