"""The options of [mcu] sections: how a board is reached and reset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from link import canport, serialport
from reactor import Reactor

RESTART_METHODS = ("arduino", "cheetah", "command", "rpi_usb")


@dataclass(frozen=True, slots=True)
class CanAddress:
    """A board on a CAN bus."""

    interface: str
    uuid: bytes
    nodes: canport.CanNodes


@dataclass(frozen=True, slots=True)
class McuOptions:
    """The options of one [mcu] section."""

    serial: str  # of a board on CAN its interface and canbus_uuid
    baud: int
    restart_method: str | None  # None: by command if the firmware can, else by the port
    max_stepper_error_s: float
    can: CanAddress | None
    reconnect_s: float | None  # of a board that may vanish: how often it is looked for


def _read_can(config: Any) -> CanAddress | None:
    text = config.get("canbus_uuid", None)
    interface = config.get("canbus_interface", "can0") if text is not None else ""
    if text is None:
        return None
    section = config.get_name()
    if config.get("serial", None) is not None:
        raise config.error(
            f"Section '{section}' has both serial ({config.where('serial')}) and canbus_uuid "
            f"({config.where('canbus_uuid')}): a board is reached by one of them"
        )
    nodes = canport.printer_nodes(config.get_printer())
    try:
        uuid = canport.parse_uuid(text)
        nodes.add(interface, uuid)
    except ValueError as e:
        raise config.error(
            f"Option 'canbus_uuid' in section '{section}' is '{text}': {e} ({config.where('canbus_uuid')})."
        ) from None
    return CanAddress(interface, uuid, nodes)


def read_options(config: Any) -> McuOptions:
    """Options from the config; raises its error for what this host can not do."""
    can = _read_can(config)
    restart_method = config.getchoice("restart_method", RESTART_METHODS, default=None)
    return McuOptions(
        config.get("serial") if can is None else f"{can.interface} {can.uuid.hex()}",
        config.getint("baud", 250000, minval=2400),
        restart_method,
        config.getfloat("max_stepper_error", 0.000025, minval=0.0),
        can,
        _read_optional(config),
    )


def _read_optional(config: Any) -> float | None:
    is_optional = config.getboolean("is_non_critical", False)
    interval_s = config.getfloat("reconnect_interval", 2.0, minval=0.5)
    if is_optional and config.get_name() == "mcu":
        raise config.error(
            f"Option 'is_non_critical' in section 'mcu' ({config.where('is_non_critical')}): the printer's time is that"
            " of this board, it must stay. Only a board of a section [mcu NAME] may vanish."
        )
    return float(interval_s) if is_optional else None


def port_opener(options: McuOptions, given: serialport.OpenPort | None) -> serialport.OpenPort:
    """Who opens the board's port; `given`: by who started the host, for those not on a CAN bus."""
    can = options.can
    if can is not None:

        def open_can(reactor: Reactor, path: str, baud: int) -> serialport.Port:
            return can.nodes.open_port(reactor, can.interface, can.uuid)

        return open_can
    if given is not None and given is not serialport.open_port:
        return given
    return serialport.open_cheetah_port if options.restart_method == "cheetah" else serialport.open_port


def advice(options: McuOptions) -> str:
    """What to look at if a board does not answer."""
    if options.can is not None:
        return (
            "Check that the board is powered and its cable is plugged in, that two terminating resistors are on the"
            f" bus, that the interface is up (ip -details link show {options.can.interface}) and has the firmware's"
            " bit rate, that the option 'canbus_uuid' is the board's (scripts/canbus_query.py), and that the board"
            " runs the printer's firmware."
        )
    return serialport.ADVICE
