"""The API server against clients that misbehave: each gets an error or is dropped, nobody else notices."""

from __future__ import annotations

import json
import os
import resource
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from base_rig import Session
from configtext import Origin
from unit.host.test_webhooks import Client, with_client


def config(tmp_path: Path) -> str:
    folder = tmp_path / "gcodes"
    folder.mkdir()
    (folder / "part.gcode").write_text("M117 printing\n")
    (tmp_path / "secret.gcode").write_text("M117 secret\n")
    return f"[virtual_sdcard]\npath: {folder}\n[pause_resume]\n[display_status]\n[respond]\n"


def alive(client: Client) -> bool:
    return bool(client.result("info")["state"] == "ready")


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"[1, 2]\x03", "not a JSON object"),
        (b"7\x03", "not a JSON object"),
        (b'{"id": 1, "method": 5}\x03', "'method' must be a text"),
        (b'{"id": 1}\x03', "'method' must be a text"),
        (b'{"id": 1, "method": "info", "params": [1]}\x03', "'params' must be an object"),
        (b'{"id": 1, "method": "info", "params": null}\x03', "'params' must be an object"),
        (b'{"id": 1, "method": "no/such"}\x03', "No registered callback"),
        (b'{"id": 1, "method": "__init__"}\x03', "No registered callback"),
        (b'{"id": 1, "method": "gcode/script", "params": {"script": ["G28"]}}\x03', "[script]"),
        (b'{"id": 1, "method": "gcode/script", "params": {"script": "M117 \\ud800"}}\x03', "[script]"),
        (b'{"id": 1, "method": "objects/query", "params": {"objects": {"gcode": 1}}}\x03', "Invalid"),
        (b'{"id": 1, "method": "objects/query", "params": {"objects": {"gcode": [[]]}}}\x03', "Invalid"),
        (b'{"id": 1, "method": "objects/subscribe", "params": {"objects": null}}\x03', "[objects]"),
        (
            b'{"id": 1, "method": "objects/subscribe", "params": {"objects": {}, "interval": 1e-9}}\x03',
            "interval",
        ),
        (b'{"id": 1, "method": "register_remote_method", "params": {"remote_method": 1}}\x03', "response"),
    ],
)  # fmt: skip
def test_a_bad_request_is_answered_with_an_error(tmp_path: Path, raw: bytes, words: str) -> None:
    def body(client: Client) -> None:
        client.send_raw(raw)
        answer = client.receive()
        assert answer["error"]["error"] == "WebRequestError"
        assert words in answer["error"]["message"]
        assert alive(client)

    with_client(tmp_path, config(tmp_path), body)


@pytest.mark.parametrize(
    "raw", [b"not json", b"\xff\xfe\x00", b"", b"[" * 100_000], ids=["text", "bytes", "empty", "deep"]
)
def test_what_is_not_json_is_ignored(tmp_path: Path, raw: bytes) -> None:
    def body(client: Client) -> None:
        client.send_raw(raw + b'\x03{"id": 6, "method": "info"}\x03')
        assert client.receive()["id"] == 6

    with_client(tmp_path, config(tmp_path), body)


def test_a_line_of_10_mb_is_refused_without_holding_anybody_up(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        other = Client(client.sock.getpeername())
        slowest_s = 0.0
        for _ in range(10):
            client.send_raw(b"x" * 1_000_000)
            begin = time.monotonic()
            assert alive(other)
            slowest_s = max(slowest_s, time.monotonic() - begin)
        client.send_raw(b'\x03{"id": 5, "method": "info"}\x03')
        assert "longer than" in client.receive()["error"]["message"]
        # the end of the long line is found, and the connection is as good as before
        assert client.receive()["id"] == 5
        # 10 ms at rest; a heater switches off if the host is away for 100 ms
        assert slowest_s < 0.25

    with_client(tmp_path, config(tmp_path), body)


def test_a_client_that_never_ends_its_request_costs_no_memory(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        server = Client(client.sock.getpeername())
        for _ in range(40):
            client.send_raw(b"y" * 1_000_000)
        assert "longer than" in client.receive()["error"]["message"]
        assert alive(server)
        client.sock.close()
        assert alive(server)

    with_client(tmp_path, config(tmp_path), body)


@pytest.mark.parametrize(
    "name",
    ["../secret.gcode", "/../secret.gcode", "a/../../secret.gcode", "..", ".", "", "x" * 5000, "a\\u0000b"],
)
def test_file_names_that_lead_outside_are_refused(tmp_path: Path, name: str) -> None:
    def body(client: Client) -> None:
        if "\\u" in name:
            script = json.loads(f'"SDCARD_PRINT_FILE FILENAME={name}"')
        else:
            script = f'SDCARD_PRINT_FILE FILENAME="{name}"'
        assert "nable to open file" in client.error("gcode/script", script=script)
        assert alive(client)
        assert client.result("gcode/script", script='SDCARD_PRINT_FILE FILENAME="part.gcode"') == {}

    with_client(tmp_path, config(tmp_path), body)


def test_a_status_that_fails_is_empty_and_stops_nobody(tmp_path: Path) -> None:
    class Broken:
        calls = 0

        def get_status(self, eventtime: float) -> dict[str, Any]:
            Broken.calls += 1
            raise RuntimeError("a bug in a plugin")

    def before(session: Session) -> None:
        session.printer.add_object("broken", Broken())

    def body(client: Client) -> None:
        for _ in range(3):
            status = client.result("objects/query", objects={"broken": None, "webhooks": ["state"]})["status"]
            assert status == {"broken": {}, "webhooks": {"state": "ready"}}
        assert alive(client)

    with_client(tmp_path, config(tmp_path), body, before)
    assert Broken.calls == 3


def test_a_script_of_many_lines_lets_others_in(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        lines = "\n".join(["M117 x"] * 50_000)
        client.send_raw(json.dumps({"id": 1, "method": "gcode/script", "params": {"script": lines}}).encode())
        client.send_raw(b"\x03")
        other = Client(client.sock.getpeername())
        begin = time.monotonic()
        assert alive(other)
        assert time.monotonic() - begin < 0.2  # 50,000 lines take about half a second
        assert client.receive() == {"id": 1, "result": {}}

    with_client(tmp_path, config(tmp_path), body)


def test_a_stalled_client_is_dropped_even_if_nothing_more_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from webhooks import connection

    monkeypatch.setattr(connection, "_STALL_S", 0.3)

    def body(client: Client) -> None:
        request = json.dumps({"id": 1, "method": "gcode/help"}).encode() + b"\x03"
        try:
            client.sock.settimeout(0.5)
            for _ in range(2000):  # answers of some 500 bytes each: more than the socket holds
                client.send_raw(request)
        except (BrokenPipeError, ConnectionResetError, TimeoutError):
            pass
        time.sleep(1.0)
        other = Client(client.sock.getpeername()) if is_connected(client.sock) else None
        client.sock.settimeout(2.0)
        with pytest.raises(ConnectionError):
            while True:
                if not client.sock.recv(1 << 20):
                    raise ConnectionResetError
        assert other is None or alive(other)

    with_client(tmp_path, config(tmp_path), body)


def is_connected(sock: socket.socket) -> bool:
    try:
        sock.getpeername()
    except OSError:
        return False
    return True


def test_queries_are_answered_by_the_thousand(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        request = {"id": 1, "method": "objects/query", "params": {"objects": {"print_stats": None}}}
        data = json.dumps(request).encode() + b"\x03"
        count = 2000
        begin = time.monotonic()
        for _ in range(count // 100):
            client.send_raw(data * 100)
            for _ in range(100):
                assert "result" in client.receive()
        rate = count / (time.monotonic() - begin)
        print(f"objects/query: {rate:.0f} a second")
        # Goal 5,000; here client and server share a process, and the computer with other tests
        assert rate > 1000

    with_client(tmp_path, config(tmp_path), body)


def test_fifty_subscribers_to_everything_cost_little(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        path = client.sock.getpeername()
        names = client.result("objects/list")["objects"]
        everything = dict.fromkeys(names)
        others = [Client(path) for _ in range(50)]
        for other in others:
            other.result("objects/subscribe", objects=everything, response_template={"method": "s"})
        begin, cpu = time.monotonic(), time.process_time()
        for number in range(4):
            client.result("gcode/script", script=f"M117 {number}")
            for other in others:
                update = other.receive()
                while "display_status" not in update["params"]["status"]:
                    update = other.receive()
                assert update["params"]["status"]["display_status"] == {"message": str(number)}
        elapsed = time.monotonic() - begin
        # 10 % of a core for the server is the goal; this figure has the 50 clients in it
        assert (time.process_time() - cpu) / elapsed < 0.5

    with_client(tmp_path, config(tmp_path), body)


def test_an_interval_of_ones_own(tmp_path: Path) -> None:
    def before(session: Session) -> None:
        class Counter:
            def get_status(self, eventtime: float) -> dict[str, Any]:
                return {"now": eventtime}

        session.printer.add_object("counter", Counter())

    def body(client: Client) -> None:
        client.result(
            "objects/subscribe", objects={"counter": None}, interval=0.05, response_template={"m": 1}
        )
        times = [client.receive()["params"]["eventtime"] for _ in range(5)]
        # four periods of 50 ms instead of 250 ms
        assert times[-1] - times[0] < 0.6

    with_client(tmp_path, config(tmp_path), body, before)


def longest_hold(session: Session) -> list[float]:
    """Where the longest time between two rounds of the reactor will be, s of this process's work."""
    found = [0.0]
    seen = time.thread_time()

    def look(eventtime: float) -> float:
        nonlocal seen
        now = time.thread_time()
        found[0], seen = max(found[0], now - seen), now
        return eventtime + 0.001

    session.reactor.register_timer(look, session.reactor.NOW)
    return found


def test_a_flood_of_queries_holds_nobody_up_and_an_emergency_stop_goes_first(tmp_path: Path) -> None:
    holds: list[list[float]] = []

    def before(session: Session) -> None:
        session.printer.lookup_object("configfile")._data.set("filler", "text", "x" * 200_000, Origin("-", 1))
        holds.append(longest_hold(session))

    def body(client: Client) -> None:
        query = {"id": 1, "method": "objects/query", "params": {"objects": {"configfile": None}}}
        data = json.dumps(query).encode() + b"\x03"
        holds[0][0] = 0.0
        client.send_raw(data * 700 + b'{"id": 2, "method": "emergency_stop"}\x03')  # 60 kB
        answers = 0
        while client.receive()["id"] != 2:
            answers += 1
        assert answers < 100
        assert holds[0][0] < 0.050

    with_client(tmp_path, config(tmp_path), body, before)


LOOP = b'{"id": 1, "method": "gcode/script", "params": {"script": "TRY"}}'
SUBSCRIBE = {
    "objects": {"id": 1, "method": "objects/subscribe", "params": {"objects": {"configfile": None}}},
    "output": {"id": 1, "method": "gcode/subscribe_output", "params": {"response_template": {"m": 1}}},
}
ABUSES: dict[str, tuple[bytes, int, str]] = {
    "2,000 subscriptions to an object": (json.dumps(SUBSCRIBE["objects"]).encode(), 2000, ""),
    "2,000 subscriptions to the output": (json.dumps(SUBSCRIBE["output"]).encode(), 2000, ""),
    "a request of 1 MB": (
        b'{"id": 1, "method": "info", "params": {"a": [' + b"1," * 500_000 + b"1]}}",
        1,
        "longer",
    ),
    "a number of a billion bits": (LOOP, 1, "bits"),
}


@pytest.mark.parametrize("name", ABUSES)
def test_what_a_client_may_send_holds_nobody_up(tmp_path: Path, name: str) -> None:
    data, count, words = ABUSES[name]
    holds: list[list[float]] = []

    def body(client: Client) -> None:
        holds[0][0] = 0.0
        client.send_raw((data + b"\x03") * count)
        for _ in range(count):
            answer = client.receive()
            while "id" not in answer and answer.get("error") is None:  # of a subscription
                answer = client.receive()
            assert words in str(answer.get("error", "")) and bool(words) == ("error" in answer)
        assert holds[0][0] < 0.050
        assert alive(Client(client.sock.getpeername()))

    macro = "[gcode_macro TRY]\ngcode:\n    M117 {2**(2**30)}\n"
    with_client(tmp_path, config(tmp_path) + macro, body, lambda s: holds.append(longest_hold(s)))


SCRIPTS = {
    "SDCARD_PRINT_FILE FILENAME=none.gcode": "Unable to open file",
    "M23 none.gcode": "Unable to open file",
    "M20": "",
    "SDCARD_PRINT_FILE FILENAME=pipe.gcode": "no plain file",
    "SDCARD_PRINT_FILE FILENAME=zero.gcode": "outside",
    "LOOP": "steps of loops",
}


def test_no_script_in_a_folder_of_20000_files_holds_anybody_up(tmp_path: Path) -> None:
    holds: list[list[float]] = []

    def body(client: Client) -> None:
        for script, words in SCRIPTS.items():
            holds[0][0] = 0.0
            answer = client.request("gcode/script", script=script)
            assert words in str(answer.get("error", "")) and bool(words) == ("error" in answer), script
            assert holds[0][0] < 0.050, script  # 10 ms at rest

    rounds = "{% for i in range(99999) %}" * 2 + "{% endfor %}" * 2
    text = config(tmp_path) + f"[gcode_macro LOOP]\ngcode:\n    {rounds}\n"
    for number in range(20_000):
        (tmp_path / "gcodes" / f"{number}.gcode").touch()
    os.mkfifo(tmp_path / "gcodes" / "pipe.gcode")
    (tmp_path / "gcodes" / "zero.gcode").symlink_to("/dev/zero")
    with_client(tmp_path, text, body, lambda s: holds.append(longest_hold(s)))


def test_more_clients_than_there_may_be_are_refused_and_the_first_ones_stay(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        path = client.sock.getpeername()
        others = []
        for _ in range(150):
            others.append(Client(path))
            time.sleep(0.002)  # the kernel keeps a few waiting
        served = 0
        for other in others:
            try:
                served += alive(other)
            except ConnectionError:
                pass
        assert served == 127 and alive(client)
        for other in others:
            other.sock.close()
        assert alive(client)
        assert alive(Client(path))

    with_client(tmp_path, config(tmp_path), body)


def test_without_a_descriptor_a_client_is_refused_and_the_host_does_not_spin(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        assert alive(client)  # accepted, not only connected
        path = client.sock.getpeername()
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        sockets = [socket.socket(socket.AF_UNIX) for _ in range(3)]
        taken = os.open(os.devnull, os.O_RDONLY)
        resource.setrlimit(resource.RLIMIT_NOFILE, (taken + 1, limits[1]))
        try:
            for sock in sockets:
                sock.connect(path)
                sock.settimeout(2.0)
                assert sock.recv(1) == b""  # closed by the host
            assert alive(client)
            begin = time.process_time()
            time.sleep(0.3)
            assert time.process_time() - begin < 0.2
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            os.close(taken)
        assert alive(Client(path))

    with_client(tmp_path, config(tmp_path), body)


def test_scripts_that_wait_are_limited_and_emergency_stop_is_not_among_them(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        script = json.dumps({"id": 1, "method": "gcode/script", "params": {"script": "WAIT"}}).encode()
        client.send_raw((script + b"\x03") * 600)
        for _ in range(100):
            assert "under way already" in client.receive()["error"]["message"]
        client.send_raw(b'{"id": 2, "method": "emergency_stop"}\x03')
        assert client.receive() == {"id": 2, "result": {}}

    def before(session: Session) -> None:
        session.gcode.register_command("WAIT", lambda gcmd: session.sleep(20.0))

    with_client(tmp_path, config(tmp_path), body, before)


def test_the_socket_is_not_for_everybody(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        assert os.stat(client.sock.getpeername()).st_mode & 0o007 == 0

    with_client(tmp_path, config(tmp_path), body)
