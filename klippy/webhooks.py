"""API server: JSON requests on a unix socket, answered at once, and subscriptions to status and output.

Messages are JSON objects ended by 0x03, as documented in Klipper's API_Server.md. A request runs in a greenlet
of its own, so a long `gcode/script` delays no other request. Status subscriptions are compared every 250 ms and
only what changed is sent. What a slow client does not take is queued up to a limit in bytes and in age; then the
client is dropped.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import socket
import sys
from collections.abc import Callable
from typing import Any

import gcode

_END = b"\x03"
_RECEIVE_SIZE = 65536
_REQUEST_LIMIT = 20 * 1024 * 1024  # bytes; the limit Moonraker keeps itself
_STALL_S = 5.0  # a client that took nothing for so long is dropped
_BACKLOG_LIMIT = 32 * 1024 * 1024
_SUBSCRIPTION_PERIOD_S = 0.25

_MISSING: Any = object()


class WebRequestError(gcode.CommandError):
    """A request could not be carried out; the text is for the client."""

    def to_dict(self) -> dict[str, str]:
        """As sent to the client."""
        return {"error": "WebRequestError", "message": str(self)}


class WebRequest:
    """One request of a client."""

    error = WebRequestError

    def __init__(self, client: Any, message: Any) -> None:
        if not isinstance(message, dict):
            raise ValueError("not a top-level dictionary")
        self.client = client
        self.id = message.get("id")
        self.method = message.get("method")
        self.params = message.get("params", {})
        if not isinstance(self.method, str) or not isinstance(self.params, dict):
            raise ValueError("invalid request type")
        self.response: Any = None

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
        self._backlog = bytearray()
        self._stalled_since = 0.0
        self.closed = False
        self._handle = self._reactor.register_fd(sock.fileno(), self._receive, self._flush)

    def is_closed(self) -> bool:
        """Whether the client is gone."""
        return self.closed

    def close(self) -> None:
        """Drop the client."""
        if self.closed:
            return
        self.closed = True
        self._reactor.unregister_fd(self._handle)
        self._sock.close()
        self._server.forget(self)

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
        self._received += data
        if _END in data:
            *messages, rest = bytes(self._received).split(_END)
            self._received = bytearray(rest)
            for message in messages:
                self._start_request(message)
        if len(self._received) > _REQUEST_LIMIT:
            logging.warning("API client dropped: request without an end")
            self.close()

    def _start_request(self, message: bytes) -> None:
        try:
            request = WebRequest(self, json.loads(message))
        except (ValueError, RecursionError) as e:
            logging.info("API request ignored: %s", e)
            return
        self._reactor.register_callback(lambda eventtime: self._process(request))

    def _process(self, request: WebRequest) -> None:
        try:
            handler = self._webhooks.get_callback(request.get_method())
            handler(request)
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

    def send(self, data: Any) -> None:
        """Queue one message; drops the client if it takes nothing."""
        if self.closed:
            return
        try:
            text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        except (TypeError, ValueError):
            text = json.dumps(_plain(data), separators=(",", ":"))
        self._backlog += text.encode() + _END
        self._flush()

    def _flush(self, eventtime: float | None = None) -> None:
        if self.closed:
            return
        now = self._reactor.monotonic()
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
        if sent or not self._backlog:
            self._stalled_since = now
        if self._backlog and (now - self._stalled_since > _STALL_S or len(self._backlog) > _BACKLOG_LIMIT):
            logging.warning("API client dropped: it does not read (%d bytes waiting)", len(self._backlog))
            self.close()
            return
        self._reactor.set_fd_wake(self._handle, True, bool(self._backlog))


def _plain(value: Any) -> Any:
    """A copy JSON can express: unknown types as text, numbers that are none as null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not -1e308 < value < 1e308:
        return None
    return value if isinstance(value, int | float | str | bool) or value is None else str(value)


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
        self._sock.listen(8)
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
        for client in list(self.clients.values()):
            client.close()
        self.reactor.unregister_fd(self._handle)
        self._sock.close()
        try:
            os.unlink(self._path)
        except OSError:
            pass


class WebHooks:
    """The object `webhooks`: endpoints by name. Other modules add theirs with `register_endpoint`."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self._endpoints: dict[str, Callable[[WebRequest], None]] = {}
        self._mux: dict[str, tuple[str, dict[str | None, Callable[[WebRequest], None]]]] = {}
        self._remote: dict[str, list[tuple[ClientConnection, dict[str, Any]]]] = {}
        self.register_endpoint("list_endpoints", self._list_endpoints)
        self.register_endpoint("info", self._info)
        self.register_endpoint("emergency_stop", self._emergency_stop)
        self.register_endpoint("register_remote_method", self._register_remote_method)
        GCodeEndpoints(printer, self)
        ObjectEndpoints(printer, self)
        args = printer.get_start_args()
        path = args.get("apiserver")
        if path and not args.get("debuginput"):
            ServerSocket(self, path)

    def register_endpoint(self, path: str, callback: Callable[[WebRequest], None]) -> None:
        """Serve requests of this method name."""
        if path in self._endpoints:
            raise WebRequestError(f"Path already registered to an endpoint: {path}")
        self._endpoints[path] = callback

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
        if value not in table:
            raise request.error(f"The value '{value}' is not valid for {key}")
        table[value](request)

    def get_connection(self) -> None:
        """No single connection is kept; here for callers that ask."""

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
        root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
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
        self._gcode = printer.lookup_object("gcode")
        self._subscribers: dict[ClientConnection, dict[str, Any]] = {}
        self._listening = False
        webhooks.register_endpoint("gcode/help", lambda request: request.send(self._gcode.get_command_help()))
        webhooks.register_endpoint(
            "gcode/script", lambda request: self._gcode.run_script(request.get_str("script"))
        )
        webhooks.register_endpoint("gcode/restart", lambda request: self._gcode.run_script("restart"))
        webhooks.register_endpoint(
            "gcode/firmware_restart", lambda request: self._gcode.run_script("firmware_restart")
        )
        webhooks.register_endpoint("gcode/subscribe_output", self._subscribe)

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


ObjectFields = dict[str, list[str] | None]


class ObjectEndpoints:
    """objects/list query subscribe: the status of printer objects (their `get_status`)."""

    def __init__(self, printer: Any, webhooks: WebHooks) -> None:
        self._printer = printer
        self._reactor = printer.get_reactor()
        self._subscriptions: dict[ClientConnection, tuple[ObjectFields, dict[str, Any]]] = {}
        self._previous: dict[str, dict[str, Any]] = {}
        self._timer: Any = None
        webhooks.register_endpoint("objects/list", self._list)
        webhooks.register_endpoint("objects/query", self._query)
        webhooks.register_endpoint("objects/subscribe", self._subscribe)

    def _list(self, request: WebRequest) -> None:
        request.send(
            {"objects": [name for name, obj in self._printer.lookup_objects() if hasattr(obj, "get_status")]}
        )

    def _wanted(self, request: WebRequest) -> ObjectFields:
        wanted = request.get_dict("objects")
        for name, fields in wanted.items():
            valid = fields is None or (
                isinstance(fields, list) and all(isinstance(item, str) for item in fields)
            )
            if not isinstance(name, str) or not valid:
                raise request.error("Invalid argument")
        return dict(wanted)

    def _status_of(self, name: str, eventtime: float, cache: dict[str, dict[str, Any]]) -> dict[str, Any]:
        if name not in cache:
            found = self._printer.lookup_object(name, None)
            report = getattr(found, "get_status", None)
            cache[name] = dict(report(eventtime)) if report is not None else {}
        return cache[name]

    def _collect(
        self, wanted: ObjectFields, eventtime: float, cache: dict[str, dict[str, Any]]
    ) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for name, fields in wanted.items():
            status = self._status_of(name, eventtime, cache)
            known = self._printer.lookup_object(name, None) is not None
            result[name] = (
                status if fields is None else {field: status.get(field) for field in fields if known}
            )
        return result

    def _query(self, request: WebRequest) -> None:
        wanted = self._wanted(request)
        eventtime = self._reactor.monotonic()
        request.send({"eventtime": eventtime, "status": self._collect(wanted, eventtime, {})})

    def _subscribe(self, request: WebRequest) -> None:
        wanted = self._wanted(request)
        template = request.get_dict("response_template", {})
        eventtime = self._reactor.monotonic()
        cache: dict[str, dict[str, Any]] = {}
        request.send({"eventtime": eventtime, "status": self._collect(wanted, eventtime, cache)})
        client = request.get_client_connection()
        if wanted:
            self._subscriptions[client] = (wanted, template)
        else:
            self._subscriptions.pop(client, None)
        # others compare with what they were sent last: only objects new to everybody take this reading
        for name, status in cache.items():
            self._previous.setdefault(name, status)
        if self._timer is None:
            self._timer = self._reactor.register_timer(self._publish, eventtime + _SUBSCRIPTION_PERIOD_S)

    def _publish(self, eventtime: float) -> float:
        cache: dict[str, dict[str, Any]] = {}
        for client in [client for client in self._subscriptions if client.is_closed()]:
            del self._subscriptions[client]
        for client, (wanted, template) in list(self._subscriptions.items()):
            changed: dict[str, Any] = {}
            for name, fields in wanted.items():
                status = self._status_of(name, eventtime, cache)
                before = self._previous.get(name, {})
                names = status if fields is None else fields
                delta = {
                    field: status[field]
                    for field in names
                    if field in status and status[field] != before.get(field, _MISSING)
                }
                if delta:
                    changed[name] = delta
            if changed:
                client.send({**template, "params": {"eventtime": eventtime, "status": changed}})
        self._previous = cache
        if not self._subscriptions:
            self._timer = None
            return float(self._reactor.NEVER)
        return eventtime + _SUBSCRIPTION_PERIOD_S
