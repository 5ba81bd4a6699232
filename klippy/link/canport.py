"""Boards on a CAN bus, over the kernel's SocketCAN (docs/reference/Config_Reference.md, Boards).

Every board has a `canbus_uuid` of its own, six bytes. The host gives it a number (node id) with an admin packet; from
then on packets of id 256 + 2 * number carry what the host says, and those of the next id what the board says: a stream
of bytes, eight in a packet at most, without regard to blocks. A board that has been reset waits for a number again.
"""

from __future__ import annotations

import os
import re
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

from link.serialport import Port, PortError, ThreadPort
from reactor import Reactor

ADMIN_ID = 0x3F0  # from the host to all boards; answers have the next id
QUERY_UNASSIGNED = 0x00
SET_NODEID = 0x01
NEED_NODEID = 0x20
FIRST_NODE = 4
LAST_NODE = 119  # its ids end below the admin packets

PACKET = struct.Struct("=IB3x8s")  # id, length, data: struct can_frame of the kernel
_FILTER = struct.Struct("=II")
_STANDARD_MASK = 0xC00007FF  # the id, and that it is neither extended nor a remote request
_UUID = re.compile(r"[0-9a-fA-F]{12}")

OpenBus = Callable[[str, int], socket.socket]


def parse_uuid(text: str) -> bytes:
    """Six bytes. Raises ValueError."""
    if not _UUID.fullmatch(text.strip()):
        raise ValueError("expected 12 digits 0-9 a-f, as scripts/canbus_query.py prints them")
    return bytes.fromhex(text.strip())


def open_bus(interface: str, packet_id: int) -> socket.socket:
    """A socket on a CAN interface that receives packets of one id. Raises OSError."""
    bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, _FILTER.pack(packet_id, _STANDARD_MASK))
        bus.bind((interface,))
    except OSError:
        bus.close()
        raise
    return bus


def packet(packet_id: int, data: bytes) -> bytes:
    """One packet for the kernel."""
    return PACKET.pack(packet_id, len(data), data.ljust(8, b"\0"))


def unassigned(bus: socket.socket, wait_s: float) -> Iterator[bytes]:
    """UUIDs of the boards that wait for a number; `bus` receives answers to admin packets."""
    bus.send(packet(ADMIN_ID, bytes([QUERY_UNASSIGNED])))
    seen: set[bytes] = set()
    end = time.monotonic() + wait_s
    while (rest := end - time.monotonic()) > 0.0:
        if not select.select([bus], [], [], rest)[0]:
            return
        packet_id, length, data = PACKET.unpack(bus.recv(PACKET.size))
        if packet_id == ADMIN_ID + 1 and length >= 7 and data[0] == NEED_NODEID and data[1:7] not in seen:
            seen.add(data[1:7])
            yield data[1:7]


class CanNodes:
    """The boards of one printer, each with its number; makes their ports."""

    def __init__(self, open_socket: OpenBus = open_bus) -> None:
        self._open_socket = open_socket
        self._numbers: dict[tuple[str, bytes], int] = {}

    def add(self, interface: str, uuid: bytes) -> int:
        """A board of the config; returns its number. Raises ValueError for one that is there already, or too many."""
        if (interface, uuid) in self._numbers:
            raise ValueError("another section has this canbus_uuid, too")
        number = FIRST_NODE + len(self._numbers)
        if number > LAST_NODE:
            raise ValueError(f"more than {LAST_NODE - FIRST_NODE + 1} boards")
        self._numbers[interface, uuid] = number
        return number

    def open_port(self, reactor: Reactor, interface: str, uuid: bytes) -> Port:
        """Give the board its number and open its port. Raises `PortError`."""
        send_id = 256 + 2 * self._numbers[interface, uuid]
        try:
            bus = self._open_socket(interface, send_id + 1)
            assign = bytes([SET_NODEID, *uuid, self._numbers[interface, uuid]])
            bus.send(packet(ADMIN_ID, assign))
        except OSError as e:
            reason = e.strerror or os.strerror(e.errno or 0)
            raise PortError(f"Unable to use the CAN interface '{interface}': {reason}.") from None
        return ThreadPort(
            reactor, f"{interface} {uuid.hex()}", bus.fileno(), bus.close, lambda: None, send_id
        )


def printer_nodes(printer: Any) -> CanNodes:
    """The boards of a printer."""
    nodes: CanNodes | None = printer.lookup_object("canbus_nodes", None)
    if nodes is None:
        nodes = CanNodes()
        printer.add_object("canbus_nodes", nodes)
    return nodes
