"""Boards on a CAN bus inside this process: numbers are given, bytes go in packets, everybody hears everything."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from test_serialport import answer, in_reactor

import canbus_query
import serialhdl
from link import canport
from link.serialport import Port, PortError
from reactor import Reactor
from virtual_link import ReferenceMcu

UUIDS = (bytes.fromhex("11aa22bb33cc"), bytes.fromhex("0123456789ab"))


class Node:
    """A board as docs/reference/Config_Reference.md describes it."""

    def __init__(self, uuid: bytes, send: Callable[[int, bytes], None]) -> None:
        self.uuid, self._send = uuid, send
        self.number: int | None = None
        self.mcu = ReferenceMcu(answer)
        self.mcu.emit = self._emit
        self._whole = threading.Lock()  # a reset does not come between a packet and its answer

    def _emit(self, data: bytes) -> None:
        assert self.number is not None
        for start in range(0, len(data), 8):
            self._send(257 + 2 * self.number, data[start : start + 8])

    def reset(self) -> None:
        with self._whole:
            self.number, self.mcu.expected = None, 0

    def receive(self, packet_id: int, data: bytes) -> None:
        with self._whole:
            self._receive(packet_id, data)

    def _receive(self, packet_id: int, data: bytes) -> None:
        if packet_id == canport.ADMIN_ID and data[0] == canport.QUERY_UNASSIGNED and self.number is None:
            self._send(canport.ADMIN_ID + 1, bytes([canport.NEED_NODEID]) + self.uuid)
        elif packet_id == canport.ADMIN_ID and data[0] == canport.SET_NODEID and data[1:7] == self.uuid:
            self.number = data[7]
        elif self.number is not None and packet_id == 256 + 2 * self.number:
            self.mcu.receive(data, time.monotonic())


class Bus(threading.Thread):
    """Hands every packet to all nodes, and those of a node to all hosts."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.nodes = [Node(uuid, self._to_hosts) for uuid in UUIDS]
        self.packets: list[tuple[int, bytes]] = []
        self._hosts: list[socket.socket] = []
        self._stopping = False
        self.start()

    def open(self, interface: str, packet_id: int) -> socket.socket:
        """In the place of canport.open_bus; without its filter."""
        if interface != "can0":
            raise OSError(19, "No such device")
        host, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._hosts.append(ours)
        return host

    def _to_hosts(self, packet_id: int, data: bytes) -> None:
        for host in self._hosts:
            try:
                host.send(canport.packet(packet_id, data))
            except OSError:
                pass  # it has left

    def run(self) -> None:
        while not self._stopping:
            for host in select.select(self._hosts, [], [], 0.02)[0]:
                raw = host.recv(canport.PACKET.size)
                if not raw:
                    self._hosts.remove(host)
                    host.close()
                    continue
                packet_id, length, data = canport.PACKET.unpack(raw)
                self.packets.append((packet_id, data[:length]))
                for node in self.nodes:
                    node.receive(packet_id, data[:length])

    def stop(self) -> None:
        self._stopping = True
        self.join()
        for host in self._hosts:
            host.close()


@pytest.fixture
def bus() -> Iterator[Bus]:
    found = Bus()
    yield found
    found.stop()


def test_two_boards_are_identified_and_answer_each_for_itself(bus: Bus) -> None:
    nodes = canport.CanNodes(bus.open)
    numbers = [nodes.add("can0", uuid) for uuid in UUIDS]
    assert numbers[0] != numbers[1]

    def opener(uuid: bytes) -> Callable[[Reactor, str, int], Port]:
        return lambda reactor, path, baud: nodes.open_port(reactor, "can0", uuid)

    def body(reactor: Reactor, _: serialhdl.SerialReader) -> None:
        links = [serialhdl.SerialReader(reactor, "can: ", opener(uuid)) for uuid in UUIDS]
        for link in links:
            link.connect("can0", 0)
        for count in range(30):
            for number, link in enumerate(links):
                data = bytes([count, number] * 20)
                ping = serialhdl.CommandQueryWrapper(link, "ping data=%*s", "pong data=%*s")
                assert ping.send([data])["data"] == data
        for link in links:
            link.disconnect()

    in_reactor(body)
    assert [node.number for node in bus.nodes] == numbers
    assert all(node.mcu.naks <= 1 for node in bus.nodes)  # one at the start: the host begins with sequence 1
    assert max(len(data) for _, data in bus.packets) == 8


def test_a_board_that_was_reset_gets_its_number_again(bus: Bus) -> None:
    nodes = canport.CanNodes(bus.open)
    nodes.add("can0", UUIDS[0])

    def body(reactor: Reactor, _: serialhdl.SerialReader) -> None:
        link = serialhdl.SerialReader(
            reactor, "can: ", lambda reactor, path, baud: nodes.open_port(reactor, "can0", UUIDS[0])
        )
        for _round in range(2):
            link.connect("can0", 0)
            assert link.send_with_response("ping data=01", "pong")["data"] == b"\x01"
            link.disconnect()
            bus.nodes[0].reset()

    in_reactor(body)


def test_the_query_lists_boards_without_a_number(bus: Bus, capsys: pytest.CaptureFixture[str]) -> None:
    bus.nodes[1].number = 9
    assert canbus_query.main(["can0", "--wait", "0.2"], bus.open) == 0
    assert capsys.readouterr().out == "Found canbus_uuid=11aa22bb33cc\nTotal 1 uuids found\n"
    assert canbus_query.main(["can7"], bus.open) == 2
    assert "unable to use the interface 'can7': No such device" in capsys.readouterr().err


def test_an_interface_that_is_not_there_is_named(bus: Bus) -> None:
    nodes = canport.CanNodes(bus.open)
    nodes.add("can3", UUIDS[0])
    with pytest.raises(PortError, match="CAN interface 'can3': No such device"):
        nodes.open_port(Reactor(), "can3", UUIDS[0])
