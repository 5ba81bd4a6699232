"""API server: JSON requests on a unix socket, answered at once, and subscriptions to status and output.

Messages are JSON objects ended by 0x03, as documented in Klipper's API_Server.md.

    socket ─► ClientConnection ─► WebRequest ─► WebHooks: endpoint by name
                  │ quick endpoints (status, lists) are answered on the spot,
                  └ the others in a greenlet of their own: a long `gcode/script` delays no other request

Status subscriptions are compared every 250 ms and only what changed is sent; clients that want the same share one
comparison and one encoding. What a slow client does not take is queued up to a limit in bytes and in age; then the
client is dropped. A request that is too long is skipped up to its end and answered with an error: parsing it would
hold up the whole host, and a heater that gets no command for 100 ms switches off.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import pathlib
import socket
import sys
from collections.abc import Callable
from typing import Any

import gcode

from .statusfeed import END, Fields, Status, StatusPublisher, StatusReader, Subscription, Wanted, encode

_RECEIVE_SIZE = 65536
_REQUEST_LIMIT = 1024 * 1024  # bytes; 10 ms of parsing
_STALL_S = 5.0  # a client that reads nothing for this time is dropped
_BACKLOG_LIMIT = 32 * 1024 * 1024
_SUBSCRIPTION_PERIOD_S = 0.25
_SHORTEST_PERIOD_S = 0.02
_FAREWELL_S = 3.0  # when the host ends, clients have this time to close their side
_SCRIPT_SLICE_S = 0.01  # a script of many lines lets others run so often


_MISSING: Any = object()


class WebRequestError(gcode.CommandError):
    """A request could not be carried out; the text is for the client."""

    def to_dict(self) -> dict[str, str]:
        """As sent to the client."""
        return {"error": "WebRequestError", "message": str(self)}


class WebRequest:
    """One request of a client."""

    error = WebRequestError

    def __init__(self, client: Any, message: dict[str, Any]) -> None:
        self.client = client
        self.id = message.get("id")
        self.method = message.get("method")
        self.params = message.get("params", {})
        self.response: Any = None

    def check(self) -> None:
        """Raise if it is not a request."""
        if not isinstance(self.method, str):
            raise WebRequestError("Invalid request: 'method' must be a text")
        if not isinstance(self.params, dict):
            raise WebRequestError("Invalid request: 'params' must be an object")

    def get_client_connection(self) -> Any:
        """The connection it came from."""
        return self.client

    def get_method(self) -> str:
        """Name of the endpoint."""
        return str(self.method)

    def get(self, item: str, default: Any = _MISSING, types: tuple[type, ...] | None = None) -> Any:
        """A parameter, of one of `types`."""
        value = self.params.get(item, default)
        if value is _MISSING:
            raise WebRequestError(f"Missing Argument [{item}]")
        if types is not None and type(value) not in types and item in self.params:
            raise WebRequestError(f"Invalid Argument Type [{item}]")
        return value

    def get_str(self, item: str, default: Any = _MISSING) -> Any:
        """A text parameter."""
        return self.get(item, default, (str,))

    def get_int(self, item: str, default: Any = _MISSING) -> Any:
        """A whole number."""
        return self.get(item, default, (int,))

    def get_float(self, item: str, default: Any = _MISSING) -> Any:
        """A number."""
        return self.get(item, default, (int, float))

    def get_dict(self, item: str, default: Any = _MISSING) -> Any:
        """A JSON object."""
        return self.get(item, default, (dict,))

    def send(self, data: Any) -> None:
        """Give the result (once)."""
        if self.response is not None:
            raise WebRequestError("Multiple calls to send not allowed")
        self.response = {"result": data}

    def finish(self) -> dict[str, Any] | None:
        """The answer; None if the client wants none."""
        if self.id is None:
            return None
        return {"id": self.id, **(self.response or {"result": {}})}


class ClientConnection:
    """One connected client."""

    def __init__(self, server: ServerSocket, sock: socket.socket) -> None:
        self._server = server
        self._webhooks = server.webhooks
        self._reactor = server.reactor
        self._sock = sock
        sock.setblocking(False)
        self.uid = id(self)
        self._received = bytearray()
        self._skipping = False  # inside a request that is too long
        self._backlog = bytearray()
        self._stalled_since = 0.0
        self.closed = False
        self._ending = False
        self._handle = self._reactor.register_fd(sock.fileno(), self._receive, self._flush)
        self._stall_timer = self._reactor.register_timer(self._check_stall)

    def is_closed(self) -> bool:
        """Whether the client is gone, or is being disconnected."""
        return self.closed or self._ending

    def end(self) -> None:
        """Say good-bye: the client reads an end of file. What it still sends is read and dropped.

        Closing at once would make a request that is just being written fail at the client's.
        """
        if self.closed:
            return
        self._flush()
        self._ending = True
        try:
            self._sock.shutdown(socket.SHUT_WR)
        except OSError:
            self.close()

    def close(self) -> None:
        """Drop the client."""
        if self.closed:
            return
        self.closed = True
        self._reactor.unregister_timer(self._stall_timer)
        self._reactor.unregister_fd(self._handle)
        self._sock.close()
        self._server.forget(self)

    # --- requests ---
    def _receive(self, eventtime: float) -> None:
        try:
            data = self._sock.recv(_RECEIVE_SIZE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        if self._ending:
            return
        self._received += data
        if END in data:
            *messages, rest = bytes(self._received).split(END)
            self._received = bytearray(rest)
            if self._skipping:  # its end; it was answered when it became too long
                self._skipping = False
                del messages[0]
            for message in messages:
                self._start_request(message)
        if self._skipping:
            self._received.clear()
        elif len(self._received) > _REQUEST_LIMIT:
            self._skipping = True
            self._received.clear()
            self._refuse(None, f"Request is longer than {_REQUEST_LIMIT} bytes")

    def _start_request(self, message: bytes) -> None:
        if len(message) > _REQUEST_LIMIT:
            self._refuse(None, f"Request is longer than {_REQUEST_LIMIT} bytes")
            return
        try:
            content = json.loads(message)
        except (ValueError, RecursionError) as e:
            self._refuse(None, f"Request is not valid JSON: {e}")
            return
        if not isinstance(content, dict):
            self._refuse(None, "Request is not a JSON object")
            return
        request = WebRequest(self, content)
        if self._webhooks.is_quick(request.method):
            self._process(request)
        else:
            self._reactor.register_callback(lambda eventtime: self._process(request))

    def _refuse(self, request_id: Any, reason: str) -> None:
        logging.info("API request refused: %s", reason)
        self.send({"id": request_id, "error": WebRequestError(reason).to_dict()})

    def _process(self, request: WebRequest) -> None:
        try:
            request.check()
            self._webhooks.get_callback(request.get_method())(request)
        except WebRequestError as e:
            request.response = {"error": e.to_dict()}
        except gcode.CommandError as e:
            request.response = {"error": WebRequestError(str(e)).to_dict()}
        except Exception as e:
            message = f"Internal Error on WebRequest: {request.get_method()}"
            logging.exception(message)
            request.response = {"error": WebRequestError(f"{message} ({e})").to_dict()}
            self._webhooks.printer.invoke_shutdown(message)
        answer = request.finish()
        if answer is not None:
            self.send(answer)

    # --- answers ---
    def send(self, data: Any) -> None:
        """Queue one message; drops the client if it takes nothing."""
        if not self.is_closed():
            self.send_encoded(encode(data))

    def send_encoded(self, data: bytes) -> None:
        """As `send`, for several clients at once."""
        self._backlog += data
        self._flush()

    def _flush(self, eventtime: float | None = None) -> None:
        if self.is_closed():
            return
        waited = bool(self._stalled_since)
        try:
            sent = self._sock.send(self._backlog) if self._backlog else 0
        except BlockingIOError:
            sent = 0
        except OSError as e:
            if e.errno not in (errno.EPIPE, errno.ECONNRESET, errno.EBADF):
                logging.info("API client lost: %s", e)
            self.close()
            return
        del self._backlog[:sent]
        if not self._backlog:
            self._stalled_since = 0.0
        elif sent or not waited:
            self._stalled_since = now = self._reactor.monotonic()
            self._reactor.update_timer(self._stall_timer, now + _STALL_S)
        if len(self._backlog) > _BACKLOG_LIMIT:
            self._drop()
        elif waited or self._backlog:
            self._reactor.set_fd_wake(self._handle, True, bool(self._backlog))

    def _check_stall(self, eventtime: float) -> float:
        if not self._stalled_since:
            return float(self._reactor.NEVER)
        if eventtime < self._stalled_since + _STALL_S:
            return self._stalled_since + _STALL_S
        self._drop()
        return float(self._reactor.NEVER)

    def _drop(self) -> None:
        logging.warning("API client dropped: it does not read (%d bytes waiting)", len(self._backlog))
        self.close()


class ServerSocket:
    """The listening socket and its clients."""

    def __init__(self, webhooks: WebHooks, path: str) -> None:
        self.webhooks = webhooks
        self.reactor = webhooks.printer.get_reactor()
        self.clients: dict[int, ClientConnection] = {}
        self._path = path
        if os.path.exists(path):
            os.unlink(path)
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._sock.setblocking(False)
        self._sock.bind(path)
        self._sock.listen(64)
        self._handle = self.reactor.register_fd(self._sock.fileno(), self._accept)
        webhooks.printer.register_event_handler("klippy:disconnect", self._close)

    def _accept(self, eventtime: float) -> None:
        try:
            sock, _ = self._sock.accept()
        except OSError:
            return
        client = ClientConnection(self, sock)
        self.clients[client.uid] = client

    def forget(self, client: ClientConnection) -> None:
        """A client is gone."""
        self.clients.pop(client.uid, None)

    def _close(self) -> None:
        """Remove the socket's path first, so that no client connects; then end the clients in good order."""
        self.reactor.unregister_fd(self._handle)
        self._sock.close()
        try:
            os.unlink(self._path)
        except OSError:
            pass
        for client in list(self.clients.values()):
            client.end()
        deadline = self.reactor.monotonic() + _FAREWELL_S
        while self.clients and self.reactor.monotonic() < deadline:
            self.reactor.pause(self.reactor.monotonic() + 0.01)
        for client in list(self.clients.values()):
            client.close()


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
        with self._gcode.get_mutex():
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
