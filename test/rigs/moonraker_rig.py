"""A simulated printer with Moonraker for tests: scripts/run_printer.py as a user starts it, and a client."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import run_printer

ROOT = Path(__file__).resolve().parents[2]
START_TIMEOUT_S = 60.0  # builds and a busy computer included; usually 3 s


def free_port() -> int:
    """A TCP port nobody uses now."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


class HttpError(Exception):
    """Moonraker refused; `status` and its own words."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(f"{status}: {message}")
        self.status, self.message = status, message


class SimulatedPrinter:
    """run_printer.py in a folder, with a client for Moonraker's HTTP API; ended with its `with`, if it has not been."""

    def __init__(self, folder: Path, *options: str, moonraker: bool = True) -> None:
        self.data = folder
        self.port = free_port()
        if moonraker and run_printer.find_moonraker() is None:
            pytest.fail("Moonraker is not installed; run: scripts/setup.sh test")
        command = [sys.executable, str(ROOT / "scripts" / "run_printer.py"), "--data", str(folder)]
        command += ["--port", str(self.port), *([] if moonraker else ["--no-moonraker"]), *options]
        self._output = folder.parent / f"{folder.name}-output.txt"
        with self._output.open("wb") as output:
            self.process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)

    def __enter__(self) -> SimulatedPrinter:
        return self

    def __exit__(self, *_error: object) -> None:
        if self.process.poll() is None:
            self.stop()

    @property
    def output(self) -> str:
        """What run_printer.py printed so far."""
        return self._output.read_text(encoding="utf-8")

    @property
    def socket_path(self) -> Path:
        return self.data / "comms" / "klippy.sock"

    def log(self, name: str) -> str:
        """Text of a log file."""
        return (self.data / "logs" / name).read_text(encoding="utf-8", errors="replace")

    def stop(self, number: int = signal.SIGTERM) -> int:
        """End it as a user does; returns the exit status."""
        self.process.send_signal(number)
        return self.process.wait(20.0)

    # --- client ---
    def call(
        self,
        path: str,
        body: bytes | None = None,
        kind: str = "application/json",
        method: str | None = None,
        **query: Any,
    ) -> Any:
        """GET (POST with a body or by `method`); the `result` of the answer."""
        text = urllib.parse.urlencode(query)
        url = f"http://127.0.0.1:{self.port}{path}" + (f"?{text}" if text else "")
        request = urllib.request.Request(url, data=body, method=method)
        if body is not None:
            request.add_header("Content-Type", kind)
        try:
            with urllib.request.urlopen(request, timeout=30.0) as answer:
                data = json.load(answer)
        except urllib.error.HTTPError as e:
            text = e.read().decode(errors="replace")
            try:
                text = json.loads(text)["error"]["message"]
            except (ValueError, KeyError, TypeError):
                pass
            raise HttpError(e.code, text) from None
        return data["result"] if isinstance(data, dict) and "result" in data else data

    def post(self, path: str, **query: Any) -> Any:
        """POST without a body."""
        return self.call(path, method="POST", **query)

    def gcode(self, script: str) -> Any:
        """Run G-code through Moonraker."""
        return self.post("/printer/gcode/script", script=script)

    def query(self, name: str) -> dict[str, Any]:
        """Status of one printer object."""
        status: dict[str, Any] = self.call("/printer/objects/query?" + urllib.parse.quote(name))["status"][
            name
        ]
        return status

    def upload(self, name: str, text: str, start: bool = False) -> Any:
        """Put a file into the gcode folder."""
        boundary = uuid.uuid4().hex
        parts = [("root", "gcodes"), ("print", "true" if start else "false")]
        body = "".join(
            f'--{boundary}\r\nContent-Disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'
            for key, value in parts
        )
        body += (
            f'--{boundary}\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n'
            f"Content-Type: application/octet-stream\r\n\r\n{text}\r\n--{boundary}--\r\n"
        )
        return self.call("/server/files/upload", body.encode(), f"multipart/form-data; boundary={boundary}")

    # --- waiting ---
    def wait(self, what: str, condition: Callable[[], Any], timeout_s: float = 20.0) -> Any:
        """Until the condition is true; its value. What the programs said is shown if it never is."""
        deadline = time.monotonic() + timeout_s
        problem: Exception | None = None
        while time.monotonic() < deadline:
            assert self.process.poll() is None, f"run_printer.py ended:\n{self.output}"
            try:
                value = condition()
                if value:
                    return value
            except (HttpError, OSError, KeyError) as e:
                problem = e
            time.sleep(0.05)
        klippy_log = self.data / "logs" / "klippy.log"
        tail = klippy_log.read_text(errors="replace")[-3000:] if klippy_log.exists() else ""
        raise AssertionError(f"{what}: not within {timeout_s} s ({problem})\n{self.output}\n{tail}")

    def wait_ready(self, timeout_s: float = START_TIMEOUT_S) -> None:
        """Until Moonraker calls the printer ready."""
        self.wait("ready", lambda: self.call("/server/info")["klippy_state"] == "ready", timeout_s)

    def wait_start(self, timeout_s: float = START_TIMEOUT_S) -> None:
        """The first time: an error of the start-up ends the wait."""

        def started() -> str:
            state = self.call("/server/info")["klippy_state"]
            return state if state in ("ready", "error", "shutdown") else ""

        state = self.wait("start-up", started, timeout_s)
        assert state == "ready", self.call("/printer/info")["state_message"]

    def wait_state(self, state: str, timeout_s: float = 30.0) -> None:
        """Until print_stats says so."""
        self.wait(f"print state {state}", lambda: self.query("print_stats")["state"] == state, timeout_s)

    def host_pid(self) -> int:
        """Process id of the host."""
        return int(self.call("/printer/info")["process_id"])

    def kill_host(self) -> int:
        """As a crash: no last words. Returns the process id it had."""
        pid = self.host_pid()
        os.kill(pid, signal.SIGKILL)
        return pid
