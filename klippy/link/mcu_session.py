"""What is sent to an MCU at the start of a session, and what it reports about itself. No reactor, no link: only data.

An MCU keeps its configuration until it is reset. The host builds the text of the configuration anew at each start
and compares its CRC with the one the MCU was configured with: equal, and the MCU can go on as it is.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

STATS_INTERVAL_S = 5.0  # an MCU reports its load this often


@dataclass(slots=True)
class ConfigScript:
    """The commands that make an MCU what the configuration wants it to be."""

    oid_count: int = 0
    reserved_move_slots: int = 0
    callbacks: list[Callable[[], None]] = field(default_factory=list)
    config_cmds: list[str] = field(default_factory=list)  # once after a reset
    init_cmds: list[str] = field(default_factory=list)  # at each start, when the configuration is in force
    restart_cmds: list[str] = field(default_factory=list)  # only if the MCU was configured already
    crc: int = 0
    _given: tuple[Any, ...] | None = None  # before the callbacks added theirs

    def add(self, cmd: str, is_init: bool, on_restart: bool) -> None:
        target = self.init_cmds if is_init else self.restart_cmds if on_restart else self.config_cmds
        target.append(cmd)

    def build(self, resolve: Callable[[str], str]) -> None:
        """Let the callbacks add their commands, put real pin names in, and compute the CRC of the text.

        Again for a board that returns: its clock is another, and so are the times in its commands."""
        if self._given is None:
            lists = (self.callbacks, self.config_cmds, self.init_cmds, self.restart_cmds)
            self._given = (self.reserved_move_slots, *(tuple(part) for part in lists))
        self.reserved_move_slots, *lists_given = self._given
        self.callbacks, self.config_cmds, self.init_cmds, self.restart_cmds = map(list, lists_given)
        for callback in self.callbacks:  # may add callbacks
            callback()
        for commands in (self.config_cmds, self.init_cmds, self.restart_cmds):
            commands[:] = [resolve(cmd) for cmd in commands]
        self.config_cmds.insert(0, f"allocate_oids count={self.oid_count}")
        self.crc = zlib.crc32("\n".join(self.config_cmds).encode()) & 0xFFFFFFFF
        self.config_cmds.append(f"finalize_config crc={self.crc}")


def read_dictionary(start_args: dict[str, Any], name: str) -> tuple[bytes, str]:
    """Batch mode: an MCU's data dictionary, and the path for what would be sent. Raises ValueError."""
    key = "dictionary" if name == "mcu" else f"dictionary_{name}"
    path = start_args.get(key)
    if path is None:
        option = "-d FILE" if name == "mcu" else f"-d {name}=FILE"
        raise ValueError(f"batch mode (-o) needs the data dictionary of its firmware: give it with {option}.")
    try:
        with open(path, "rb") as handle:
            return handle.read(), start_args["debugoutput"] + ("" if name == "mcu" else f"-{name}")
    except OSError as e:
        raise ValueError(f"the data dictionary '{path}' can not be read: {e.strerror}.") from None


def missing_command(name: str, version: str, msgformat: str, problem: Exception) -> str:
    """The config asks for what the firmware does not have."""
    section = "mcu" if name == "mcu" else f"mcu {name}"
    return (
        f"The configuration asks the board of section [{section}] for the command '{msgformat.partition(' ')[0]}',"
        f" which its firmware (version {version}) does not have in this form ({problem}). Build and flash the firmware"
        " again from this version, with the feature enabled, or remove the config section that needs it."
    )


@dataclass(slots=True)
class TaskLoad:
    """Load of an MCU by its `stats` messages: count, sum and sum of squares of task run times in ticks."""

    freq: float = 1.0
    sumsq_base: float = 256.0  # the MCU sends the sum of squares divided by this
    awake: float = 0.0  # part of the time spent in tasks
    task_avg_s: float = 0.0
    task_stddev_s: float = 0.0

    def update(self, params: dict[str, Any]) -> None:
        count, total, sumsq = params["count"], params["sum"], params["sumsq"] * self.sumsq_base
        if not count:
            return
        self.awake = total / (self.freq * STATS_INTERVAL_S)
        self.task_avg_s = total / (count * self.freq)
        self.task_stddev_s = math.sqrt(max(0.0, count * sumsq - total * total)) / (count * self.freq)

    def as_stats(self) -> dict[str, float]:
        return {
            "mcu_awake": round(self.awake, 3),
            "mcu_task_avg": round(self.task_avg_s, 6),
            "mcu_task_stddev": round(self.task_stddev_s, 6),
        }


# Shutdown texts of the firmware → what a user can do about it. The first key contained in the text counts.
SHUTDOWN_HELP = (
    (
        (
            "Timer too close",
            "No next step",
            "Missed scheduling of next ",
            "Rescheduled timer in the past",
            "Stepper too far in past",
        ),
        "The board was asked to do something at a time already past. Usually the host computer was too busy, swapping"
        " memory, or too slow for the step rate (microsteps, speed); a bad cable has the same effect.",
    ),
    (
        ("ADC out of range",),
        "A temperature sensor reads outside the range its section allows (min_temp, max_temp). Check the sensor and"
        " its cable: a broken one reads far too cold, a shorted one far too hot.",
    ),
    (
        ("Induction coil signal stands still",),
        "The signal of the induction coil did not change by one step of the ADC although the drive did; a live signal"
        " follows the drive. Check the sensing coil's lead, the amplifier's supply, and that sense_pin is the pin it"
        " is connected to.",
    ),
    (
        ("Induction coil signal at the end",),
        "The signal of the induction coil reaches the end of the ADC's range. Check the sensing coil's lead for a"
        " break or a short, and the amplifier's zero and gain.",
    ),
    (
        ("Induction coil signal below",),
        "The signal of the induction coil is lower than that of any cold nozzle. Check coil, tank and sensing lead for"
        " a break; a calibration of another coil or nozzle has the same effect (INDUCTION_CALIBRATE).",
    ),
    (
        ("Induction coil signal above",),
        "The signal of the induction coil is that of a nozzle far above max_temp, or of a coil without a nozzle."
        " Check that the nozzle is in the coil and that the bridge can be switched off; a calibration of another coil"
        " or nozzle has the same effect (INDUCTION_CALIBRATE).",
    ),
    (
        ("Induction coil signal does not follow",),
        "The board moved the instant at which it samples the signal of the induction coil, and the reading did not move"
        " by as much as it must: the coil carries no current, its signal stands still, or its gain is not signal_gain."
        " Check the coil, the bridge's supply, the sensing lead, the amplifier and its supply.",
    ),
    (
        ("Induction coil carries current",),
        "The board turned the bridge off, and the signal was not that of a coil without current: the bridge conducts,"
        " or the signal stands still. Cut the supply. Then check the transistors of the bridge and their drivers for"
        " one that conducts all the time, the amplifier and the sensing lead, and adc_zero: it must be what the ADC"
        " reads without current.",
    ),
    (
        ("Induction coil signal changed faster",),
        "The reading of the induction coil jumped by more than the temperature of a nozzle can in that time. Check coil"
        " and sensing lead for a break, the connections of the capacitor, whether the nozzle sits firmly in the coil,"
        " and the bridge's supply.",
    ),
    (
        ("Induction bridge off: no phase command",),
        "The board received nothing from the host for 3 s; it had switched the bridge off before. The host program"
        " ended, the host computer was too busy or swapping memory, or the cable came off.",
    ),
    (
        ("Thermocouple reader fault",),
        "A thermocouple or RTD converter (MAX31855, MAX31856, MAX31865, MAX6675) reported a fault, or a temperature"
        " outside min_temp and max_temp, several times in a row. Check the sensor, its cable, and the converter's"
        " wiring to the board.",
    ),
    (
        ("Command request", "Force shutdown command"),
        "The host stopped the board (M112, an emergency stop, or an error on another board).",
    ),
    (
        ("Watchdog timer", "sentinel timer called", "spontaneous restart"),
        "The board restarted by itself: look at its power supply, wiring and temperature.",
    ),
    (
        ("Move queue overflow",),
        "The board's queue of moves was too small for what it was sent; this points to a mismatch of firmware and"
        " host, or to a clock that jumps.",
    ),
    (
        ("exceed max_duration",),
        "An output with a limit on its on-time (a heater) was not refreshed in time, because the host was too busy"
        " or the connection too slow.",
    ),
    (
        ("Command parser error", "Invalid command", "Message encode error"),
        "Firmware and host disagree about the commands: build and flash the firmware again from this version.",
    ),
)

RECOVERY = (
    "Once the cause is removed, use the command FIRMWARE_RESTART to reset the board, reload the configuration and"
    " start again."
)


def shutdown_help(reason: str) -> str:
    """A paragraph for people about a shutdown reason; always says how to go on."""
    for keys, text in SHUTDOWN_HELP:
        if any(key in reason for key in keys):
            return f"{text} {RECOVERY}"
    return RECOVERY
