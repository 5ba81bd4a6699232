#!/usr/bin/env python3
"""A G-code console on the host's API socket, with a live line of temperatures.

    scripts/gcode_console.py ~/ferrite_data/comms/klippy.sock

If stdin is no terminal, its lines are run one after the other; the exit status is 1 if one failed.
"""

from __future__ import annotations

import argparse
import json
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

HISTORY = Path.home() / ".ferrite_gcode_history"
DEFAULT_SOCKET = Path.home() / "ferrite_data" / "comms" / "klippy.sock"
END = b"\x03"
ANSWER_TIMEOUT_S = 3600.0  # a script may wait for heaters


class ApiError(Exception):
    """The host refused a request, or is gone; the text is for people."""


class ApiClient:
    """Requests to the host's API server, and what it sends by itself."""

    def __init__(self, path: Path, on_message: Callable[[dict[str, Any]], None]) -> None:
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._sock.connect(str(path))
        except OSError as e:
            raise ApiError(f"no host at {path}: {e.strerror or e}") from None
        self._on_message = on_message
        self._answers: dict[int, queue.SimpleQueue[dict[str, Any]]] = {}
        self._last_id = 0
        self.closed = False
        threading.Thread(target=self._read, daemon=True).start()

    def request(self, method: str, **params: Any) -> Any:
        """The result; raises ApiError."""
        self._last_id += 1
        number = self._last_id
        answer: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._answers[number] = answer
        data = json.dumps({"id": number, "method": method, "params": params}).encode()
        try:
            self._sock.sendall(data + END)
            message = answer.get(timeout=ANSWER_TIMEOUT_S)
        except (OSError, queue.Empty):
            raise ApiError("the host is gone") from None
        finally:
            self._answers.pop(number, None)
        if "error" in message:
            raise ApiError(str(message["error"].get("message", message["error"])))
        return message["result"]

    def _read(self) -> None:
        buffer = b""
        while True:
            try:
                data = self._sock.recv(65536)
            except OSError:
                data = b""
            if not data:
                break
            *messages, buffer = (buffer + data).split(END)
            for text in messages:
                self._deliver(json.loads(text))
        self.closed = True
        for answer in list(self._answers.values()):
            answer.put({"error": {"message": "the host closed the connection"}})

    def _deliver(self, message: dict[str, Any]) -> None:
        answer = self._answers.get(message.get("id", -1))
        if answer is not None:
            answer.put(message)
        elif "method" in message:
            self._on_message(message)


class GcodeConsole:
    """Keeps the last status and prints the host's output."""

    def __init__(self, path: Path, show: Callable[[str], None]) -> None:
        self._path = path
        self._show = show
        self._status: dict[str, dict[str, Any]] = {}
        self.words: list[str] = []
        self._client = self._connect()

    def _connect(self) -> ApiClient:
        client = ApiClient(self._path, self._on_message)
        self._client = client
        client.request("gcode/subscribe_output", response_template={"method": "output"})
        sensors = client.request("objects/query", objects={"heaters": ["available_sensors"]})["status"]
        names = (sensors.get("heaters") or {}).get("available_sensors") or []
        wanted: dict[str, Any] = {name: ["temperature", "target"] for name in names}
        wanted |= {"webhooks": ["state"], "print_stats": ["state"], "virtual_sdcard": ["progress"]}
        first = client.request("objects/subscribe", objects=wanted, response_template={"method": "status"})
        self._status = first["status"]
        self.words = sorted(client.request("gcode/help"))
        return client

    def _on_message(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        if message["method"] == "output":
            self._show(params["response"])
        elif message["method"] == "status":
            for name, fields in params["status"].items():
                self._status.setdefault(name, {}).update(fields)

    def line(self) -> str:
        """`ready | extruder 200.1/200 | heater_bed 60.0/60 | printing 12 %`."""
        parts = [
            "disconnected" if self._client.closed else self._status.get("webhooks", {}).get("state", "?")
        ]
        for name, fields in self._status.items():
            if fields.get("temperature") is not None:
                target = f"/{fields['target']:.0f}" if fields.get("target") is not None else ""
                parts.append(f"{name} {fields['temperature']:.1f}{target}")
        job = self._status.get("print_stats", {}).get("state")
        if job:
            progress = self._status.get("virtual_sdcard", {}).get("progress") or 0.0
            parts.append(f"{job} {100.0 * progress:.0f} %")
        return " | ".join(parts)

    def run(self, script: str) -> bool:
        """One line of G-code; False if it failed (the host says why in its output)."""
        if self._client.closed:
            try:
                self._client = self._connect()
                self._show("(connected again)")
            except ApiError as e:
                self._show(f"!! {e}")
                return False
        try:
            self._client.request("gcode/script", script=script)
        except ApiError as e:
            if self._client.closed:
                self._show(f"!! {e}")
            return False
        return True


def talk(console: GcodeConsole) -> None:
    """Prompt with history, completion and a line of temperatures."""
    from prompt_toolkit import PromptSession
    from prompt_toolkit.completion import WordCompleter
    from prompt_toolkit.history import FileHistory
    from prompt_toolkit.patch_stdout import patch_stdout

    session: Any = PromptSession(history=FileHistory(str(HISTORY)))
    completer = WordCompleter(console.words, ignore_case=True)
    while True:
        try:
            with patch_stdout():
                text = session.prompt(
                    "> ", completer=completer, bottom_toolbar=console.line, refresh_interval=0.5
                )
        except KeyboardInterrupt:
            continue
        except EOFError:
            return
        if text.strip():
            threading.Thread(target=console.run, args=(text,), daemon=True).start()


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="A G-code console on the host's API socket.")
    parser.add_argument(
        "socket", type=Path, nargs="?", default=DEFAULT_SOCKET, help=f"default {DEFAULT_SOCKET}"
    )
    options = parser.parse_args(sys.argv[1:] if argv is None else argv)
    try:
        console = GcodeConsole(options.socket, lambda text: print(text, flush=True))
    except ApiError as e:
        print(f"gcode_console: {e}", file=sys.stderr)
        return 2
    if not sys.stdin.isatty():
        good = [console.run(line.rstrip("\n")) for line in sys.stdin if line.strip()]
        time.sleep(0.05)
        print(console.line())
        return 0 if all(good) else 1
    try:
        talk(console)
    except ImportError:
        print("gcode_console: needs prompt_toolkit (pip install prompt_toolkit)", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
