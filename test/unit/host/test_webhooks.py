"""The API server, over a real socket."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from base_rig import Session
from reactor import SystemTime


class Client:
    """A blocking client, used from its own thread."""

    def __init__(self, path: str) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(5.0)
        self.sock.connect(path)
        self._buffer = b""
        self._next_id = 0
        self.notes: list[dict[str, Any]] = []

    def send_raw(self, data: bytes) -> None:
        self.sock.sendall(data)

    def receive(self) -> dict[str, Any]:
        while b"\x03" not in self._buffer:
            data = self.sock.recv(65536)
            if not data:
                raise ConnectionError("closed by the server")
            self._buffer += data
        message, _, self._buffer = self._buffer.partition(b"\x03")
        parsed: dict[str, Any] = json.loads(message)
        return parsed

    def request(self, method: str, **params: Any) -> dict[str, Any]:
        """The answer to a request; what comes before it is kept in `notes`."""
        self._next_id += 1
        request_id = (1 << 46) + self._next_id  # Moonraker's are that large
        self.send_raw(json.dumps({"id": request_id, "method": method, "params": params}).encode() + b"\x03")
        while True:
            message = self.receive()
            if message.get("id") == request_id:
                return message
            self.notes.append(message)

    def result(self, method: str, **params: Any) -> Any:
        answer = self.request(method, **params)
        assert "error" not in answer, answer
        return answer["result"]

    def error(self, method: str, **params: Any) -> str:
        error = self.request(method, **params)["error"]
        assert error["error"] == "WebRequestError"
        return str(error["message"])


def with_client(
    tmp_path: Path,
    config: str,
    body: Callable[[Client], None],
    before: Callable[[Session], None] | None = None,
) -> Session:
    """Run `body(client)` in a thread against a printer in real time."""
    path = str(tmp_path / "api.sock")
    session = Session(tmp_path, config, SystemTime(), apiserver=path)
    failure: list[BaseException] = []

    def thread_body() -> None:
        try:
            body(Client(path))
        except BaseException as e:
            failure.append(e)

    def drive(s: Session) -> None:
        if before is not None:
            before(s)
        thread = threading.Thread(target=thread_body)
        thread.start()
        while thread.is_alive():
            s.sleep(0.005)
        thread.join()

    session.run(drive)
    if failure:
        raise failure[0]
    assert not Path(path).exists()
    return session


def test_basic_requests(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        info = client.result("info", client_info={"program": "test"})
        assert (info["state"], info["state_message"]) == ("ready", "Printer is ready")
        assert {
            "klipper_path",
            "python_path",
            "hostname",
            "process_id",
            "log_file",
            "config_file",
        } <= info.keys()
        endpoints = client.result("list_endpoints")["endpoints"]
        assert {
            "info", "emergency_stop", "register_remote_method", "gcode/help", "gcode/script", "gcode/restart",
            "gcode/firmware_restart", "gcode/subscribe_output", "objects/list", "objects/query",
            "objects/subscribe", "pause_resume/pause", "pause_resume/resume", "pause_resume/cancel",
        } <= set(endpoints)  # fmt: skip
        assert "RESPOND" in client.result("gcode/help")
        assert {"gcode", "webhooks", "configfile"} <= set(
            client.result("objects/list", objects={})["objects"]
        )

    with_client(tmp_path, "[pause_resume]\n[respond]\n", body)


def test_query_is_validated_and_answered_at_once(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        started_s = time.monotonic()
        for _ in range(20):
            answer = client.result(
                "objects/query",
                objects={"webhooks": ["state", "nothing"], "gone": None, "idle_timeout": None},
            )
        assert time.monotonic() - started_s < 2.0  # stock needs 250 ms each; here about 1 ms
        assert answer["status"]["webhooks"] == {"state": "ready", "nothing": None}
        assert answer["status"]["gone"] == {}
        assert answer["status"]["idle_timeout"]["state"] == "Idle"
        assert client.error("objects/query") == "Missing Argument [objects]"
        assert client.error("objects/query", objects=[]) == "Invalid Argument Type [objects]"
        assert client.error("objects/query", objects={"webhooks": "state"}) == "Invalid argument"
        assert "No registered callback for path 'no/such'" in client.error("no/such")

    with_client(tmp_path, "", body)


def test_script_output_errors_and_broken_requests(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        assert client.result("gcode/subscribe_output", response_template={"method": "out"}) == {}
        client.send_raw(b'{"method": 5}\x03{"method": "info"}\x03')  # without an id there is no answer
        assert client.result("gcode/script", script="M118 hello\nFOO") == {}
        assert client.notes == [
            {"method": "out", "params": {"response": "echo: hello"}},
            {"method": "out", "params": {"response": '// Unknown command:"FOO"'}},
        ]
        assert "TYPE 'x' is invalid" in client.error("gcode/script", script="RESPOND TYPE=x")
        assert client.error("gcode/script") == "Missing Argument [script]"
        assert client.error("gcode/script", script=5) == "Invalid Argument Type [script]"

    with_client(tmp_path, "[respond]\n", body)


def test_a_long_script_does_not_block_other_requests(tmp_path: Path) -> None:
    def before(session: Session) -> None:
        session.gcode.register_command("SLOW", lambda gcmd: session.sleep(0.5))

    def body(client: Client) -> None:
        client.send_raw(b'{"id": 1, "method": "gcode/script", "params": {"script": "SLOW"}}\x03')
        assert client.result("info")["state"] == "ready"
        assert client.notes == []  # the script's answer comes later
        assert client.receive() == {"id": 1, "result": {}}

    with_client(tmp_path, "", body, before)


def test_subscription_sends_only_what_changed(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        first = client.result(
            "objects/subscribe",
            objects={"display_status": None, "webhooks": ["state"]},
            response_template={"method": "status"},
        )
        assert first["status"] == {
            "display_status": {"progress": 0.0, "message": None},
            "webhooks": {"state": "ready"},
        }
        client.result("gcode/script", script="M117 hi")
        update = client.notes.pop() if client.notes else client.receive()
        assert update["method"] == "status"
        assert set(update["params"]) == {"eventtime", "status"}
        assert update["params"]["status"] == {"display_status": {"message": "hi"}}
        client.result("emergency_stop")
        update = client.notes.pop() if client.notes else client.receive()
        assert update["params"]["status"] == {"webhooks": {"state": "shutdown"}}
        assert "Shutdown due to webhooks request" in client.error("gcode/script", script="M117 x")

    with_client(tmp_path, "[display_status]\n", body)


def test_remote_methods(tmp_path: Path) -> None:
    config = '[gcode_macro CALL]\ngcode: {action_call_remote_method("ping", value=42)}\n'

    def body(client: Client) -> None:
        assert "'ping' not registered" in client.error("gcode/script", script="CALL")
        assert (
            client.result(
                "register_remote_method", remote_method="ping", response_template={"method": "ping"}
            )
            == {}
        )
        client.result("gcode/script", script="CALL")
        assert client.notes == [{"method": "ping", "params": {"value": 42}}]

    with_client(tmp_path, config, body)


def test_error_state_answers_everything_but_commands(tmp_path: Path) -> None:
    def body(client: Client) -> None:
        assert client.result("info")["state"] == "error"
        status = client.result("objects/query", objects={"webhooks": None})["status"]
        assert status["webhooks"]["state"] == "error"
        assert "not a valid config section" in client.error("gcode/script", script="G28")

    with_client(tmp_path, "[wrong]\n", body)


def test_a_client_that_does_not_read_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from webhooks import connection

    monkeypatch.setattr(connection, "_STALL_S", 0.2)

    def body(client: Client) -> None:
        client.send_raw(b'{"id": 1, "method": "gcode/subscribe_output"}\x03')
        other = Client(client.sock.getpeername())
        for _ in range(60):  # 60 x 40 kB are more than a socket holds
            other.result("gcode/script", script="M118 " + "x" * 40000)
            time.sleep(0.01)
        client.sock.settimeout(1.0)
        received = 0
        with pytest.raises((ConnectionError, TimeoutError)) as caught:
            while True:
                data = client.sock.recv(1 << 20)
                if not data:
                    raise ConnectionResetError("dropped")
                received += len(data)
        assert caught.type is ConnectionResetError
        assert received < 60 * 40000
        assert other.result("info")["state"] == "ready"

    with_client(tmp_path, "[respond]\n", body)


@pytest.mark.parametrize("closes", [True, False], ids=["client closes", "client stays"])
def test_the_end_of_the_host_is_no_error_for_a_client_that_is_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closes: bool
) -> None:
    """Moonraker writes a traceback into its log when a write to the socket fails."""
    from webhooks import connection

    if not closes:
        monkeypatch.setattr(connection, "_FAREWELL_S", 0.1)
    path = str(tmp_path / "api.sock")
    session = Session(tmp_path, "[respond]\n", SystemTime(), apiserver=path)
    connected, finished, ended = threading.Event(), threading.Event(), threading.Event()
    problems: list[OSError] = []

    def client_life() -> None:
        client = Client(path)
        client.result("info")
        connected.set()
        while client.sock.recv(65536):  # until the host says good-bye
            pass
        try:
            for _ in range(100 if closes else 0):
                client.send_raw(b'{"id": 1, "method": "info"}\x03')
        except OSError as e:
            problems.append(e)
        finished.set()
        if not closes:
            ended.wait(10.0)
        client.sock.close()

    thread = threading.Thread(target=client_life)

    def drive(s: Session) -> None:
        thread.start()
        while not connected.is_set():
            s.sleep(0.005)

    session.run(drive)
    ended.set()
    thread.join()
    assert finished.is_set()
    assert not problems
    assert not Path(path).exists()
