"""Clients of the API server: requests as they come in, answers as they go out.

Clients have turns, and all of them together a slice of time; a client is not read from while requests of it wait.
What a slow client does not take is queued up to a limit in bytes and in age; then the client is dropped. A request that
is too long is skipped up to its end and answered with an error: parsing it would hold up the whole host, and a heater
that gets no command for 100 ms switches off.
"""

from __future__ import annotations

import collections
import errno
import json
import logging
import os
import socket
from typing import Any

import gcode

from .statusfeed import END, encode

_RECEIVE_SIZE = 65536
_REQUEST_LIMIT = 512 * 1024  # bytes; 16 ms of parsing at worst
_STALL_S = 5.0  # a client that reads nothing for this time is dropped
_BACKLOG_LIMIT = 32 * 1024 * 1024
_SLICE_S = 0.005  # requests are answered for so long, then the rest of the host has its turn for as long
_UNDER_WAY_MAX = 500  # long requests of one client; a script waits while another one runs
_URGENT = b'"emergency_stop"'  # not kept waiting behind other requests
_CLIENTS_MAX = 128
_SOCKET_MODE = 0o660  # who may write to it may move the printer
_FAREWELL_S = 3.0  # when the host ends, clients have this time to close their side


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
        self._waiting: collections.deque[bytes] = collections.deque()  # requests not started yet
        self._under_way = 0  # requests in a greenlet of their own
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
                if _URGENT in message:
                    self._start_request(message)
                else:
                    self._waiting.append(message)
            self._server.serve(self)
            self._choose_events()
        if self._skipping:
            self._received.clear()
        elif len(self._received) > _REQUEST_LIMIT:
            self._skipping = True
            self._received.clear()
            self._refuse(None, f"Request is longer than {_REQUEST_LIMIT} bytes")

    def start_next(self) -> bool:
        """Start the request that came first; whether more of them wait."""
        if self._waiting and not self.is_closed():
            self._start_request(self._waiting.popleft())
        if self.is_closed():
            self._waiting.clear()
        if not self._waiting:
            self._choose_events()
        return bool(self._waiting)

    def _choose_events(self) -> None:
        if not self.is_closed():
            self._reactor.set_fd_wake(self._handle, not self._waiting, bool(self._backlog))

    def _start_request(self, message: bytes) -> None:
        if len(message) > _REQUEST_LIMIT:
            self._refuse(None, f"Request is longer than {_REQUEST_LIMIT} bytes")
            return
        try:
            content = json.loads(message)
        except (ValueError, RecursionError) as e:
            logging.info("A request that is not JSON is ignored: %s", e)
            return
        if not isinstance(content, dict):
            self._refuse(None, "Request is not a JSON object")
            return
        request = WebRequest(self, content)
        if self._webhooks.is_quick(request.method):
            self._process(request)
        else:
            self._start_long(request)

    def _start_long(self, request: WebRequest) -> None:
        """In a greenlet of its own."""
        if self._under_way >= _UNDER_WAY_MAX and request.method != "emergency_stop":
            self._refuse(request.id, f"{_UNDER_WAY_MAX} requests of this client are under way already")
            return

        def process(eventtime: float) -> None:
            try:
                self._process(request)
            finally:
                self._under_way -= 1

        self._under_way += 1
        self._reactor.register_callback(process)

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
            self._choose_events()

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

    def __init__(self, webhooks: Any, path: str) -> None:
        self.webhooks = webhooks
        self.reactor = webhooks.printer.get_reactor()
        self.clients: dict[int, ClientConnection] = {}
        self._path = path
        if os.path.exists(path):
            os.unlink(path)
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._sock.setblocking(False)
        self._sock.bind(path)
        os.chmod(path, _SOCKET_MODE)
        self._sock.listen(64)
        self._turns: collections.deque[ClientConnection] = (
            collections.deque()
        )  # clients with requests that wait
        self._timer = self.reactor.register_timer(self._serve_waiting)
        self._is_busy = False  # a slice of time is over and requests wait
        self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)  # see _refuse_one
        self._handle = self.reactor.register_fd(self._sock.fileno(), self._accept)
        webhooks.printer.register_event_handler("klippy:disconnect", self._close)

    def _accept(self, eventtime: float) -> None:
        try:
            sock, _ = self._sock.accept()
        except OSError as e:
            if e.errno in (errno.EMFILE, errno.ENFILE):
                self._refuse_one()
            return
        if len(self.clients) >= _CLIENTS_MAX:
            logging.warning("API client refused: there are %d already", len(self.clients))
            sock.close()
            return
        client = ClientConnection(self, sock)
        self.clients[client.uid] = client

    def serve(self, client: ClientConnection) -> None:
        """Start the requests of a client: at once, or in its turn if there are too many."""
        if client not in self._turns:
            self._turns.append(client)
        if not self._is_busy:
            self.reactor.update_timer(self._timer, self._serve_waiting(self.reactor.monotonic()))

    def _serve_waiting(self, eventtime: float) -> float:
        slice_end = self.reactor.monotonic() + _SLICE_S
        while self._turns:
            if client_waits := self._turns[0].start_next():
                self._turns.rotate(-1)
            else:
                self._turns.popleft()
            if client_waits and self.reactor.monotonic() >= slice_end:
                break
        self._is_busy = bool(self._turns)
        return self.reactor.monotonic() + _SLICE_S if self._is_busy else float(self.reactor.NEVER)

    def _refuse_one(self) -> None:
        """No descriptor is left: a client that nobody accepts would wake the host again and again."""
        logging.warning("API client refused: this program has no file descriptor left")
        if self._spare >= 0:
            os.close(self._spare)
        try:
            self._sock.accept()[0].close()
        except OSError:
            pass
        try:
            self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            self._spare = -1

    def forget(self, client: ClientConnection) -> None:
        """A client is gone."""
        self.clients.pop(client.uid, None)

    def _close(self) -> None:
        """Remove the socket's path first, so that no client connects; then end the clients in good order."""
        self.reactor.unregister_fd(self._handle)
        self._sock.close()
        self.reactor.unregister_timer(self._timer)
        if self._spare >= 0:
            os.close(self._spare)
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
