"""Real ports with their thread, in real time, over a pseudo terminal and a unix socket; and the file of batch mode."""

from __future__ import annotations

import json
import os
import select
import socket
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import msgproto
import serialhdl
from link import serialport
from reactor import Reactor
from virtual_link import ReferenceMcu, blocks_of

TABLES = {
    "version": "test",
    "commands": {"identify offset=%u count=%c": 1, "ping data=%*s": 5, "mute": 6},
    "responses": {"identify_response offset=%u data=%.*s": 0, "pong data=%*s": 7},
    "config": {"CLOCK_FREQ": 1000000, "SERIAL_BAUD": 250000, "RECEIVE_WINDOW": 192},
}
PARSER = msgproto.MessageParser()
PARSER.process_identify(json.dumps(TABLES).encode(), decompress=False)
PING = PARSER.create_command("ping data=aa55")
IMAGE = zlib.compress(json.dumps(TABLES).encode())


def answer(content: bytes) -> list[bytes]:
    replies = []
    for params in PARSER.parse_content(content):
        if params["#name"] == "identify":
            data = IMAGE[params["offset"] : params["offset"] + params["count"]]
            form = PARSER.lookup_response("identify_response")
            assert form is not None
            replies.append(form.encode([params["offset"], data]))
        elif params["#name"] == "ping":
            form = PARSER.lookup_response("pong")
            assert form is not None
            replies.append(form.encode([params["data"]]))
    return replies


class Board(threading.Thread):
    """A reference MCU on a file descriptor."""

    def __init__(self, fd: int, mcu: ReferenceMcu | None = None) -> None:
        super().__init__(daemon=True)
        self.fd, self.stopping = fd, False
        self.mcu = mcu or ReferenceMcu(answer)
        self.mcu.emit = lambda data: void(os.write(fd, data))
        self.start()

    def run(self) -> None:
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        while not self.stopping:
            try:
                events = poll.poll(20)
                if any(event & select.POLLIN for _, event in events):
                    self.mcu.receive(os.read(self.fd, 4096), time.monotonic())
                elif events:  # nobody at the other end
                    time.sleep(0.01)
            except OSError:
                time.sleep(0.01)  # nobody has opened the other end yet, or it is closed again

    def stop(self) -> None:
        self.stopping = True
        self.join()


def void(value: Any) -> None:
    pass


@pytest.fixture(params=["pty", "socket"])
def board_path(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "pty":
        master, slave = os.openpty()
        board = Board(master)
        yield os.ttyname(slave)
        board.stop()
        os.close(master)
        os.close(slave)
        return
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "board"))
    server.listen()
    boards: list[tuple[Board, socket.socket]] = []

    def accept() -> None:
        connection, _ = server.accept()
        boards.append((Board(connection.fileno()), connection))

    threading.Thread(target=accept, daemon=True).start()
    yield str(tmp_path / "board")
    for board, connection in boards:
        board.stop()
        connection.close()
    server.close()


def in_reactor(body: Callable[[Reactor, serialhdl.SerialReader], None]) -> None:
    """Run `body` as a greenlet of a reactor on the real clock."""
    reactor = Reactor()
    serial = serialhdl.SerialReader(reactor, "test: ")
    failures: list[BaseException] = []

    def run(eventtime: float) -> None:
        try:
            body(reactor, serial)
        except BaseException as e:
            failures.append(e)
        serial.disconnect()
        reactor.end()

    reactor.register_callback(run)
    reactor.run()
    reactor.finalize()
    if failures:
        raise failures[0]


def test_board_is_identified_and_answers(board_path: str) -> None:
    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect(board_path, 250000)
        assert serial.get_msgparser().version == "test"
        ping = serialhdl.CommandQueryWrapper(serial, "ping data=%*s", "pong data=%*s")
        begun = time.monotonic()
        for n in range(100):
            assert ping.send([bytes([n])])["data"] == bytes([n])
        # a round trip needs no timer: well under the 25 ms of the shortest time-out, also on a busy machine
        assert time.monotonic() - begun < 100 * 0.020
        params = serial.send_with_response("ping data=aa55", "pong")
        assert params["data"] == b"\xaa\x55" and params["#receive_time"] <= reactor.monotonic()

    in_reactor(body)


def test_a_number_meant_for_an_earlier_host_does_not_keep_this_one_out() -> None:
    class Interrupted(ReferenceMcu):
        def receive(self, data: bytes, now: float) -> None:
            if not self.naks:  # still on the way when this host opens the line
                self.emit(msgproto.encode_block(2, answer(PING)[0]))
            super().receive(data, now)

    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect(os.ttyname(slave), 250000)
        assert serial.get_msgparser().version == "test"

    master, slave = os.openpty()
    board = Board(master, Interrupted(answer, expected=0))
    in_reactor(body)
    board.stop()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("board_path", ["pty"], indirect=True)
def test_messages_of_a_batch_wake_the_host_together(board_path: str) -> None:
    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect(board_path, 250000)
        batches: list[list[int]] = []

        def wait_for(count: int, seconds: float) -> int:
            end = reactor.monotonic() + seconds
            while len(batches) < count and reactor.monotonic() < end:
                reactor.pause(reactor.monotonic() + 0.01)
            return len(batches)

        def expect(seconds: float, batch_max: int) -> None:
            serial.register_batch(
                lambda messages, count: batches.append([messages[i].data[2] for i in range(count)]),
                "pong data=%*s",
                seconds,
                batch_max,
            )

        expect(60.0, 2)
        serial.send("ping data=01")
        assert wait_for(1, 0.3) == 0
        serial.send("ping data=02")
        assert wait_for(1, 10.0) == 1
        expect(0.05, 2)
        serial.send("ping data=03")
        assert wait_for(2, 10.0) == 2  # nobody comes to keep it company
        expect(60.0, 2)
        serial.send("ping data=04")
        assert wait_for(3, 0.3) == 2
        expect(0.0, 0)  # patience is over
        serial.send("ping data=05")
        wait_for(4, 1.0)
        assert batches[:2] == [[1, 2], [3]] and [number for batch in batches[2:] for number in batch] == [
            4,
            5,
        ]
        with pytest.raises(msgproto.error, match="format mismatch"):
            serial.register_batch(lambda messages, count: None, "pong oid=%c")

    in_reactor(body)


@pytest.mark.parametrize("board_path", ["pty"], indirect=True)
def test_host_can_disconnect_and_connect_again(board_path: str) -> None:
    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        for _ in range(3):
            serial.connect(board_path, 250000)
            assert serial.send_with_response("ping data=01", "pong")["data"] == b"\x01"
            serial.disconnect()

    in_reactor(body)


def test_unanswered_query_names_what_it_waited_for(board_path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serialhdl, "ANSWER_WAITS_S", (0.02, 0.02))

    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect(board_path, 250000)
        with pytest.raises(serialhdl.error, match="Unable to obtain 'pong' response"):
            serial.send_with_response("mute", "pong")

    in_reactor(body)


def test_silent_port_ends_with_advice() -> None:
    master, slave = os.openpty()

    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        with pytest.raises(serialhdl.error, match=r"does not answer.*'serial'.*'baud'"):
            serial.connect(os.ttyname(slave), 250000, timeout_s=0.6)

    in_reactor(body)
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("path", "reason"), [("/dev/no-such", "no such device"), ("/etc/hostname", "neither")]
)
def test_impossible_ports_say_why(path: str, reason: str) -> None:
    with pytest.raises(serialport.PortError, match=reason):
        serialport.open_port(Reactor(), path, 250000)


def test_port_that_breaks_is_logged_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    master, slave = os.openpty()
    board = Board(master)

    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect(os.ttyname(slave), 250000)
        os.close(slave)
        board.stop()
        os.close(master)  # the cable is pulled
        reactor.pause(reactor.monotonic() + 0.2)
        serial.send("mute")
        reactor.pause(reactor.monotonic() + 0.1)

    in_reactor(body)
    assert "failed" in caplog.text


def test_batch_file_is_whole_after_closing(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def body(reactor: Reactor, serial: serialhdl.SerialReader) -> None:
        serial.connect_file(json.dumps(TABLES).encode(), str(out))
        for n in range(10_000):
            serial.send(f"ping data={n:08x}")
        # every answer is made up: all fields zero
        assert serial.send_with_response("ping data=", "pong") == {"data": b"", "#name": "pong"}

    in_reactor(body)
    data = out.read_bytes()
    messages = [p for b in blocks_of(data) for p in PARSER.parse_content(b.content)]
    assert [int.from_bytes(p["data"], "big") for p in messages[:-1]] == list(range(10_000))
    assert sum(len(b.content) + 5 for b in blocks_of(data)) == len(data)


def test_batch_file_that_can_not_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(serialport.PortError, match="Unable to write"):
        serialport.FilePort(str(tmp_path / "no" / "out"))
