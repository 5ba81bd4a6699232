"""API server: JSON requests on a unix socket, answered at once, and subscriptions to status and output.

Messages are JSON objects ended by 0x03, as documented in Klipper's API_Server.md.

    socket ─► ClientConnection ─► WebRequest ─► WebHooks: endpoint by name
                  │ quick endpoints (status, lists) are answered on the spot,
                  └ the others in a greenlet of their own: a long `gcode/script` delays no other request

Status subscriptions are compared every 250 ms and only what changed is sent; clients that want the same share one
comparison and one encoding. connection.py says what a client may ask for in which time.
"""

from __future__ import annotations

import json
import logging
import os
import pathlib
import socket
import sys
from collections.abc import Callable
from typing import Any

from .connection import ClientConnection, ServerSocket, WebRequest, WebRequestError
from .statusfeed import Fields, Status, StatusPublisher, StatusReader, Subscription, Wanted

__all__ = ["ClientConnection", "WebHooks", "WebRequest", "WebRequestError"]

_SUBSCRIPTION_PERIOD_S = 0.25
_SHORTEST_PERIOD_S = 0.02
_SCRIPT_SLICE_S = 0.01  # a script of many lines lets others run so often


class WebHooks:
    """The object `webhooks`: endpoints by name. Other modules add theirs with `register_endpoint`."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self._endpoints: dict[str, Callable[[WebRequest], None]] = {}
        self._quick: set[str] = set()
        self._mux: dict[str, tuple[str, dict[str | None, Callable[[WebRequest], None]]]] = {}
        self._remote: dict[str, list[tuple[ClientConnection, dict[str, Any]]]] = {}
        self.register_endpoint("list_endpoints", self._list_endpoints, quick=True)
        self.register_endpoint("info", self._info, quick=True)
        self.register_endpoint("emergency_stop", self._emergency_stop)
        self.register_endpoint("register_remote_method", self._register_remote_method, quick=True)
        GCodeEndpoints(printer, self)
        ObjectEndpoints(printer, self)
        args = printer.get_start_args()
        path = args.get("apiserver")
        if path and not args.get("debuginput"):
            try:
                ServerSocket(self, path)
            except OSError as e:
                logging.error("Unable to serve the API socket %s: %s", path, e.strerror or e)

    def register_endpoint(
        self, path: str, callback: Callable[[WebRequest], None], quick: bool = False
    ) -> None:
        """Serve requests of this method name. `quick`: the callback never sleeps."""
        if path in self._endpoints:
            raise WebRequestError(f"Path already registered to an endpoint: {path}")
        self._endpoints[path] = callback
        if quick:
            self._quick.add(path)

    def is_quick(self, method: Any) -> bool:
        """Whether a request needs no greenlet of its own."""
        return not isinstance(method, str) or method in self._quick or method not in self._endpoints

    def register_mux_endpoint(
        self, path: str, key: str, value: str | None, callback: Callable[[WebRequest], None]
    ) -> None:
        """Serve requests of this name whose parameter `key` is `value`."""
        if path not in self._mux:
            self._mux[path] = (key, {})
            self.register_endpoint(path, self._dispatch_mux)
        known_key, table = self._mux[path]
        if known_key != key or value in table:
            raise self.printer.config_error(f"Endpoint {path} {key}={value} is already registered")
        table[value] = callback

    def _dispatch_mux(self, request: WebRequest) -> None:
        key, table = self._mux[request.get_method()]
        value = request.get(key, None) if None in table else request.get(key)
        if not (value is None or isinstance(value, str)) or value not in table:
            choices = ", ".join(sorted(name for name in table if name is not None))
            raise request.error(f"The value '{value}' is not valid for {key} (choices: {choices})")
        table[value](request)

    def get_callback(self, path: str) -> Callable[[WebRequest], None]:
        """Handler of an endpoint."""
        handler = self._endpoints.get(path)
        if handler is None:
            raise WebRequestError(f"webhooks: No registered callback for path '{path}'")
        return handler

    def get_status(self, eventtime: float) -> dict[str, str]:
        """State of the printer."""
        message, state = self.printer.get_state_message()
        return {"state": state, "state_message": message}

    def call_remote_method(self, method: str, **kwargs: Any) -> None:
        """Call a method a client registered."""
        clients = [entry for entry in self._remote.get(method, ()) if not entry[0].is_closed()]
        self._remote[method] = clients
        if not clients:
            raise self.printer.command_error(f"Remote method '{method}' not registered")
        for client, template in clients:
            client.send({**template, "params": kwargs})

    def _list_endpoints(self, request: WebRequest) -> None:
        request.send({"endpoints": list(self._endpoints)})

    def _info(self, request: WebRequest) -> None:
        args = self.printer.get_start_args()
        message, state = self.printer.get_state_message()
        root = str(pathlib.Path(__file__).resolve().parents[2])
        answer = {
            "state": state,
            "state_message": message,
            "hostname": socket.gethostname(),
            "klipper_path": root,
            "python_path": sys.executable,
            "process_id": os.getpid(),
            "user_id": os.getuid(),
            "group_id": os.getgid(),
        }
        for name in ("log_file", "config_file", "software_version", "cpu_info"):
            answer[name] = args.get(name)
        request.send(answer)

    def _emergency_stop(self, request: WebRequest) -> None:
        self.printer.invoke_shutdown("Shutdown due to webhooks request")

    def _register_remote_method(self, request: WebRequest) -> None:
        template = request.get_dict("response_template")
        method = request.get_str("remote_method")
        client = request.get_client_connection()
        kept = [entry for entry in self._remote.get(method, ()) if entry[0] is not client]
        self._remote[method] = [*kept, (client, template)]


class GCodeEndpoints:
    """gcode/help script restart firmware_restart subscribe_output."""

    def __init__(self, printer: Any, webhooks: WebHooks) -> None:
        self._reactor = printer.get_reactor()
        self._gcode = printer.lookup_object("gcode")
        self._subscribers: dict[ClientConnection, dict[str, Any]] = {}
        self._listening = False
        webhooks.register_endpoint(
            "gcode/help", lambda request: request.send(self._gcode.get_command_help()), quick=True
        )
        webhooks.register_endpoint("gcode/script", self._run_script)
        webhooks.register_endpoint("gcode/restart", lambda request: self._gcode.run_script("restart"))
        webhooks.register_endpoint(
            "gcode/firmware_restart", lambda request: self._gcode.run_script("firmware_restart")
        )
        webhooks.register_endpoint("gcode/subscribe_output", self._subscribe, quick=True)

    def _run_script(self, request: WebRequest) -> None:
        """As `run_script`; a long one pauses between lines."""
        script = request.get_str("script")
        try:
            script.encode()
        except UnicodeEncodeError:
            raise request.error("Invalid Argument [script]: it is no valid text") from None
        with self._gcode.waits.turn(script):
            slice_end = self._reactor.monotonic() + _SCRIPT_SLICE_S
            for number, line in enumerate(script.split("\n")):
                if number and self._reactor.monotonic() > slice_end:
                    self._reactor.pause(self._reactor.NOW)
                    slice_end = self._reactor.monotonic() + _SCRIPT_SLICE_S
                self._gcode.run_script_from_command(line)

    def _subscribe(self, request: WebRequest) -> None:
        template = request.get_dict("response_template", {})
        self._subscribers[request.get_client_connection()] = template
        if not self._listening:
            self._gcode.register_output_handler(self._send_output)
            self._listening = True

    def _send_output(self, line: str) -> None:
        for client, template in list(self._subscribers.items()):
            if client.is_closed():
                del self._subscribers[client]
            else:
                client.send({**template, "params": {"response": line}})


class ObjectEndpoints:
    """objects/list query subscribe: the status of printer objects."""

    def __init__(self, printer: Any, webhooks: WebHooks) -> None:
        self._reactor = printer.get_reactor()
        self._reader = StatusReader(printer)
        self._publishers: dict[float, StatusPublisher] = {}
        webhooks.register_endpoint(
            "objects/list", lambda request: request.send({"objects": self._reader.names()}), quick=True
        )
        webhooks.register_endpoint("objects/query", self._query, quick=True)
        webhooks.register_endpoint("objects/subscribe", self._subscribe, quick=True)

    @staticmethod
    def _wanted(request: WebRequest) -> Wanted:
        wanted: list[tuple[str, Fields]] = []
        for name, fields in request.get_dict("objects").items():
            if fields is not None and not (
                isinstance(fields, list) and all(isinstance(item, str) for item in fields)
            ):
                raise request.error("Invalid argument")
            wanted.append((name, None if fields is None else tuple(fields)))
        return tuple(wanted)

    def _query(self, request: WebRequest) -> None:
        wanted = self._wanted(request)
        eventtime = self._reactor.monotonic()
        request.send({"eventtime": eventtime, "status": self._reader.collect(wanted, eventtime, {})})

    def _subscribe(self, request: WebRequest) -> None:
        """Replaces this connection's subscription. `interval` (s, ours) sets another period than 0.25 s."""
        wanted = self._wanted(request)
        template = request.get_dict("response_template", {})
        period_s = float(request.get_float("interval", _SUBSCRIPTION_PERIOD_S))
        if not _SHORTEST_PERIOD_S <= period_s <= 60.0:
            raise request.error("Invalid argument [interval]")
        eventtime = self._reactor.monotonic()
        status: Status = {}
        request.send({"eventtime": eventtime, "status": self._reader.collect(wanted, eventtime, status)})
        client = request.get_client_connection()
        for publisher in self._publishers.values():
            publisher.remove(client)
        if wanted:
            publisher = self._publishers.setdefault(
                period_s, StatusPublisher(self._reactor, self._reader, period_s)
            )
            key = json.dumps([wanted, template])
            publisher.add(client, Subscription(wanted, template, key, period_s, status))
