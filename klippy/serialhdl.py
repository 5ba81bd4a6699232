"""One MCU link as the reactor sees it: connect, dictionary, sending, answers, handlers.

The bytes are moved by a port (serialport.py) and the protocol is kept by a serialqueue (C helper). Here both are
joined: what the queue has received is decoded and handed to whoever registered for it, in the reactor thread.

How a query knows its own answer: the command asks for a notice of its acknowledgement. The MCU acknowledges with the
sequence inside its answer, and the queue gives out the notice before the message; so the first matching message after
the notice was made by the command itself. Answers are never retransmitted by an MCU: one that does not come is asked
for again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import chelper
import msgproto
from link import serialport
from reactor import Reactor, ReactorCompletion

Params = msgproto.Params
ResponseHandler = Callable[[Params], None]
BatchHandler = Callable[[Any, int], None]

PULL_MAX = 64
BATCH_MAX = 32
UNDECODED_BYTES = 4096  # taken at once
IDENTIFY_CHUNK = 40  # bytes of dictionary asked for at once: the answer fits a block
IDENTIFY_CHUNK_MIN = 8  # on a line that damages bytes a short answer arrives more often than a long one
RENUMBER_AFTER = 3  # first questions without an answer, then the numbers of blocks are asked for again
IDENTIFY_PROGRESS_S = 5.0  # a device that has answered lately is waited for
CONNECT_TIMEOUT_S = 15.0  # an MCU behind a boot loader starts within a few seconds
REOPEN_PAUSE_S = 0.5
ACK_TIMEOUT_S = 5.0  # the longest retransmission time-out
# Waits for an answer after the acknowledgement. The first suits answers that a firmware task prepares (buses: tens
# of ms); the sum bounds how long a dead MCU can hold up its caller. Eight tries: a line that loses one answer in
# five fails one query in 400,000.
ANSWER_WAITS_S = (0.06, 0.1, 0.2, 0.4, 0.8, 1.0, 1.0, 1.0)


class error(Exception):
    """The link does not work; the text is for people."""


@dataclass(slots=True)
class _Waiter:
    """A query that has been sent. Only a message that arrives when `armed` is its answer."""

    answer: ReactorCompletion
    acked: ReactorCompletion
    armed: bool = False


@dataclass(slots=True)
class _Clock:
    """Relation of host time and MCU clock as last given by the clock synchronisation."""

    freq: float = 0.0
    time_s: float = 0.0
    clock: int = 0

    def seconds_until(self, clock: int, now: float) -> float:
        if not self.freq or not clock:
            return 0.0
        return max(0.0, self.time_s + (clock - self.clock) / self.freq - now)


@dataclass(slots=True)
class _Tables:
    handlers: dict[tuple[str, int | None], ResponseHandler] = field(default_factory=dict)
    waiters: dict[tuple[str, int | None], list[_Waiter]] = field(default_factory=dict)
    notices: dict[int, Callable[[Params], None]] = field(default_factory=dict)
    undecoded: dict[bytes, Callable[[bytes], None]] = field(default_factory=dict)  # by id and oid
    undecoded_len: int = 0


class SerialReader:
    """The link to one MCU. All methods: reactor thread; those that wait may only be called from a greenlet."""

    def __init__(
        self,
        reactor: Reactor,
        warn_prefix: str = "",
        open_port: serialport.OpenPort = serialport.open_port,
        advice: str = serialport.ADVICE,
    ) -> None:
        self.reactor = reactor
        self.warn_prefix = warn_prefix
        self.msgparser = msgproto.MessageParser(warn_prefix=warn_prefix)
        self._open_port = open_port
        self._advice = advice  # if the board does not answer
        self._ffi, self._lib = chelper.get_ffi()
        self._port: serialport.Port | None = None
        self._pulled = self._ffi.new("struct pull_message[]", PULL_MAX)
        self._batch = self._ffi.new("struct pull_message[]", BATCH_MAX)
        self._undecoded = self._ffi.new("uint8_t[]", UNDECODED_BYTES)
        self._on_batch: BatchHandler | None = None
        self._stats = self._ffi.new("struct serialqueue_stats *")
        self._tables = _Tables()
        self._notify_id = 0
        self.is_absent = False  # of a board that may vanish: its commands go nowhere
        self._clock = _Clock()
        self._is_file = False
        # freed with its last user: step writers may outlive the connection
        self._sq = self._ffi.gc(self._lib.serialqueue_alloc(0), self._lib.serialqueue_free)
        self._default_queue = self._lib.serialqueue_alloc_commandqueue(self._sq)

    def _start_over(self, file_mode: bool) -> None:
        self._is_file = file_mode
        self._lib.serialqueue_reset(self._sq, file_mode)
        self._tables.waiters.clear()
        self._tables.notices.clear()
        self._tables.undecoded.clear()
        self._tables.undecoded_len = 0
        self._on_batch = None
        self._clock = _Clock()

    # --- connecting ---

    def connect(self, path: str, baud: int, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Open the port and fetch the dictionary. Raises `error` after `timeout_s` seconds without success."""
        deadline = self.reactor.monotonic() + timeout_s
        is_announced = False
        while True:
            try:
                self._connect_once(path, baud, deadline)
                return
            except (serialport.PortError, msgproto.error, error) as e:
                self.disconnect()
                reason = str(e)
            now = self.reactor.monotonic()
            if now + REOPEN_PAUSE_S >= deadline:
                raise error(f"{self.warn_prefix}Unable to connect. {reason} {self._advice}")
            if not is_announced:
                is_announced = True
                logging.warning(
                    "%sWaiting %.0f s for the board at %s (Ctrl-C ends the program). %s",
                    self.warn_prefix, timeout_s, path, reason,
                )  # fmt: skip
            self.reactor.pause(now + REOPEN_PAUSE_S)

    def _connect_once(self, path: str, baud: int, deadline: float) -> None:
        self._start_over(False)
        self.msgparser = msgproto.MessageParser(warn_prefix=self.warn_prefix)
        self._port = self._open_port(self.reactor, path, baud)
        self._port.attach(self._sq, self._drain)
        data = self._fetch_dictionary(path, deadline)
        self.msgparser.process_identify(data)
        bits_per_second = self.msgparser.get_constant_float(
            "CANBUS_FREQUENCY", self.msgparser.get_constant_float("SERIAL_BAUD", 0.0)
        )
        window = self.msgparser.get_constant_int("RECEIVE_WINDOW", 0)
        self._lib.serialqueue_set_wire(self._sq, bits_per_second, window)

    def _fetch_dictionary(self, path: str, deadline: float) -> bytes:
        data = bytearray()
        chunk, failures = IDENTIFY_CHUNK, 0
        identify = self.msgparser.lookup_command(msgproto.IDENTIFY_COMMAND)
        while True:
            now = self.reactor.monotonic()
            if now >= deadline:
                raise error(f"The device at '{path}' is open but does not answer.")
            message = identify.encode((len(data), chunk))
            waits = ANSWER_WAITS_S[failures : failures + 1] or ANSWER_WAITS_S[-1:]
            try:
                params = self.query(
                    message, "identify_response", ack_timeout_s=min(1.0, deadline - now), waits_s=waits
                )
            except error:
                chunk, failures = max(IDENTIFY_CHUNK_MIN, chunk // 2), failures + 1
                if not data and not failures % RENUMBER_AFTER:
                    # a block that was on the way to an earlier host may have carried a wrong number
                    self._lib.serialqueue_reset(self._sq, False)
                continue
            if params["offset"] != len(data):
                continue
            if not params["data"]:
                return bytes(data)
            data += params["data"]
            chunk, failures = min(IDENTIFY_CHUNK, chunk + 4), 0
            deadline = max(deadline, self.reactor.monotonic() + IDENTIFY_PROGRESS_S)

    def connect_file(self, dictionary: bytes, output_path: str) -> None:
        """Batch mode: the dictionary comes from a file, blocks go to a file. Raises `error`."""
        self._start_over(True)
        self.msgparser = msgproto.MessageParser(warn_prefix=self.warn_prefix)
        try:
            self.msgparser.process_identify(dictionary, decompress=False)
            self._port = serialport.FilePort(output_path)
        except (serialport.PortError, msgproto.error) as e:
            raise error(str(e)) from None
        self._port.attach(self._sq, self._drain)

    def disconnect(self) -> None:
        """Close the port. Queries in flight fail by their time-outs; the queue itself lives on until unused."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    @property
    def port(self) -> serialport.Port | None:
        return self._port

    # --- receiving ---

    def register_batch(
        self, callback: BatchHandler, msgformat: str, seconds: float = 0.0, batch_max: int = 0
    ) -> None:
        """Hand messages of this format on undecoded, many at a time: `callback(messages, count)` in the reactor thread.

        `messages` are C's struct pull_message, up to BATCH_MAX. They wait until there are `batch_max` of them, or the
        oldest is `seconds` old. One format only; registering it again changes these limits.
        """
        message_id = self.msgparser.lookup_command(msgformat).id_bytes
        self._on_batch = callback
        self._lib.serialqueue_set_batch(self._sq, message_id, len(message_id), seconds, batch_max)

    def let_wait(self, msgformat: str, oid: int, callback: Callable[[bytes], None]) -> None:
        """Messages of this format and oid wake nobody: they come with the next of another, undecoded. One format only.

        `callback` gets what follows the oid.
        """
        message_id = self.msgparser.lookup_command(msgformat).id_bytes
        self._lib.serialqueue_set_patient(self._sq, message_id, len(message_id))
        start = message_id + msgproto.encode_vlq(oid)
        self._tables.undecoded[start] = callback
        self._tables.undecoded_len = len(start)

    def _drain(self) -> None:
        """Take what the queue has received. Called by the port in the reactor thread."""
        pulled = self._pulled
        while count := self._lib.serialqueue_pull(self._sq, pulled, PULL_MAX):
            # decode all before calling anybody: a handler may come back here
            received = [self._unpack(pulled[i]) for i in range(count)]
            if self._tables.undecoded_len:
                self._drain_undecoded()  # before the answers that came after them
            for notify_id, params in received:
                if notify_id:
                    notice = self._tables.notices.pop(notify_id, None)
                    if notice is not None:
                        notice(params)
                elif params:
                    self._dispatch(params)
            if count < PULL_MAX:
                break
        if self._on_batch is not None:
            self._drain_batch(self._on_batch)

    def _drain_batch(self, handler: BatchHandler) -> None:
        batch = self._batch
        while count := self._lib.serialqueue_pull_batch(self._sq, batch, BATCH_MAX, self.reactor.monotonic()):
            try:
                handler(batch, count)
            except Exception:
                logging.exception("%shandler of a batch of messages failed", self.warn_prefix)
            if count < BATCH_MAX:
                break

    def _drain_undecoded(self) -> None:
        start = self._tables.undecoded_len
        while used := self._lib.serialqueue_pull_patient(self._sq, self._undecoded, UNDECODED_BYTES):
            data, at = self._ffi.buffer(self._undecoded, used)[:], 0
            while at < used:
                begin, at = at + 1, at + 1 + data[at]
                handler = self._tables.undecoded.get(data[begin : begin + start])
                if handler is not None:
                    handler(data[begin + start : at])
                elif params := self._decode(data[begin:at]):
                    now = self.reactor.monotonic()
                    self._dispatch(params | {"#sent_time": now, "#receive_time": now})

    def _unpack(self, message: Any) -> tuple[int, Params]:
        params: Params = {}
        if message.len:
            params = self._decode(self._ffi.buffer(message.data, message.len)[:])
            if not params:
                return 0, {}
        params["#sent_time"] = message.sent_time
        params["#receive_time"] = message.receive_time
        return message.notify_id, params

    def _decode(self, content: bytes) -> Params:
        """{} where it is no message."""
        try:
            return self.msgparser.parse(content)
        except msgproto.error as e:
            # before the dictionary is there an MCU that has just booted may greet: nothing to worry about
            level = logging.WARNING if self.msgparser.version else logging.DEBUG
            logging.log(level, "%sundecodable message %s: %s", self.warn_prefix, content.hex(), e)
            return {}

    def _dispatch(self, params: Params) -> None:
        key = (params["#name"], params.get("oid"))
        waiters = self._tables.waiters.get(key)
        taken = False
        for waiter in tuple(waiters) if waiters else ():
            if waiter.armed and not waiter.answer.test():
                waiter.answer.complete(params)
                taken = True
        handler = self._tables.handlers.get(key) or self._tables.handlers.get((key[0], None))
        if handler is not None:
            try:
                handler(params)
            except Exception:
                logging.exception("%shandler of message '%s' failed", self.warn_prefix, params["#name"])
        elif not taken:
            logging.info("%sunexpected message: %s", self.warn_prefix, self.msgparser.format_params(params))

    def register_response(self, callback: ResponseHandler | None, name: str, oid: int | None = None) -> None:
        """Call `callback(params)` for each such message, in the reactor thread; it must not sleep. None removes it."""
        if callback is None:
            self._tables.handlers.pop((name, oid), None)
        else:
            self._tables.handlers[name, oid] = callback

    # --- sending ---

    def raw_send(self, cmd: bytes, minclock: int, reqclock: int, cmd_queue: Any, notify_id: int = 0) -> None:
        """Queue one encoded command: not sent before MCU clock `minclock`, needed by `reqclock` (0: at once)."""
        queue = self._default_queue if cmd_queue is None else cmd_queue
        if self._lib.serialqueue_send(self._sq, queue, cmd, len(cmd), minclock, reqclock, notify_id):
            raise error(f"{self.warn_prefix}a command of {len(cmd)} bytes can not be sent")
        if self._port is not None:
            self._port.notify()

    def _send_with_notice(
        self, cmd: bytes, minclock: int, reqclock: int, cmd_queue: Any, notice: Callable[[Params], None]
    ) -> int:
        self._notify_id += 1
        self._tables.notices[self._notify_id] = notice
        self.raw_send(cmd, minclock, reqclock, cmd_queue, self._notify_id)
        return self._notify_id

    def raw_send_wait_ack(self, cmd: bytes, minclock: int, reqclock: int, cmd_queue: Any) -> Params:
        """Send and wait until the MCU has acknowledged. Raises `error` when it does not."""
        if self._is_file:
            self.raw_send(cmd, minclock, reqclock, cmd_queue)
            return {"#sent_time": 0.0, "#receive_time": 0.0}
        acked = self.reactor.completion()
        notify_id = self._send_with_notice(cmd, minclock, reqclock, cmd_queue, acked.complete)
        now = self.reactor.monotonic()
        params = acked.wait(now + ACK_TIMEOUT_S + self._clock.seconds_until(minclock, now))
        if params is None:
            self._tables.notices.pop(notify_id, None)
            raise error(f"{self.warn_prefix}a command was not acknowledged")
        return params

    def query(
        self,
        cmd: bytes,
        response: str,
        oid: int | None = None,
        cmd_queue: Any = None,
        minclock: int = 0,
        reqclock: int = 0,
        retry: bool = True,
        ack_timeout_s: float = ACK_TIMEOUT_S,
        waits_s: Sequence[float] = ANSWER_WAITS_S,
    ) -> Params:
        """Send and wait for the answer `response` (of `oid`). Raises `error` if none comes, after retries.

        In batch mode the answer is made up: every field 0.
        """
        if self._is_file:
            self.raw_send(cmd, minclock, reqclock, cmd_queue)
            known = self.msgparser.lookup_response(response)
            return known.zeros() if known is not None else {"#name": response}
        waiters = self._tables.waiters.setdefault((response, oid), [])
        for wait_s in waits_s if retry else (sum(waits_s),):
            waiter = _Waiter(self.reactor.completion(), self.reactor.completion())
            waiters.append(waiter)
            try:
                params = self._ask(waiter, cmd, minclock, reqclock, cmd_queue, wait_s, ack_timeout_s)
            finally:
                waiters.remove(waiter)
            if params is not None:
                return params
        raise error(f"{self.warn_prefix}Unable to obtain '{response}' response")

    def _ask(
        self,
        waiter: _Waiter,
        cmd: bytes,
        minclock: int,
        reqclock: int,
        cmd_queue: Any,
        wait_s: float,
        ack_timeout_s: float,
    ) -> Params | None:
        def on_ack(params: Params) -> None:
            waiter.armed = True
            waiter.acked.complete(params)

        notify_id = self._send_with_notice(cmd, minclock, reqclock, cmd_queue, on_ack)
        now = self.reactor.monotonic()
        if waiter.acked.wait(now + ack_timeout_s + self._clock.seconds_until(minclock, now)) is None:
            self._tables.notices.pop(notify_id, None)
            raise error(f"{self.warn_prefix}the MCU does not acknowledge commands")
        return waiter.answer.wait(self.reactor.monotonic() + wait_s)

    def send(self, msg: str, minclock: int = 0, reqclock: int = 0) -> None:
        """Send a command given as text, on the default queue."""
        self.raw_send(self.msgparser.create_command(msg), minclock, reqclock, self._default_queue)

    def send_with_response(self, msg: str, response: str, oid: int | None = None) -> Params:
        """Send a command given as text and wait for its answer."""
        return self.query(self.msgparser.create_command(msg), response, oid)

    # --- facts ---

    def set_clock_est(self, freq: float, conv_time: float, conv_clock: int) -> None:
        """Host time `conv_time` (s) is MCU clock `conv_clock`; `freq` ticks a second of host time."""
        self._clock = _Clock(freq, conv_time, conv_clock)
        self._lib.serialqueue_set_clock_est(self._sq, freq, conv_time, max(0, conv_clock))
        if self._port is not None:
            self._port.notify()

    def alloc_command_queue(self) -> Any:
        """A queue of its own: commands keep their order within a queue only."""
        return self._lib.serialqueue_alloc_commandqueue(self._sq)

    def get_default_command_queue(self) -> Any:
        return self._default_queue

    def get_serialqueue(self) -> Any:
        return self._sq

    def get_msgparser(self) -> msgproto.MessageParser:
        return self.msgparser

    def get_stats(self) -> dict[str, float]:
        """Counters of the link by the names used in logs and in `last_stats`."""
        s = self._stats
        self._lib.serialqueue_get_stats(self._sq, s)
        return {
            "bytes_write": s.bytes_write,
            "bytes_read": s.bytes_read,
            "bytes_retransmit": s.bytes_retransmit,
            "bytes_invalid": s.bytes_invalid,
            "send_seq": s.send_seq,
            "receive_seq": s.receive_seq,
            "retransmit_seq": s.retransmit_seq,
            "srtt": round(s.srtt, 6),
            "rttvar": round(s.rttvar, 6),
            "rto": round(s.rto, 6),
            "ready_bytes": s.ready_bytes,
            "upcoming_bytes": s.upcoming_bytes,
        }

    def stats(self, eventtime: float) -> str:
        return " ".join(f"{name}={value}" for name, value in self.get_stats().items())


class CommandWrapper:
    """One command of the firmware, ready to be sent with values in the order of its format."""

    def __init__(self, serial: SerialReader, msgformat: str, cmd_queue: Any = None) -> None:
        self._serial = serial
        self._message = serial.get_msgparser().lookup_command(msgformat)
        self._queue = serial.get_default_command_queue() if cmd_queue is None else cmd_queue

    def get_command_tag(self) -> int:
        """The message id, for C code that encodes the command itself."""
        return self._message.msgid

    def encode(self, data: Sequence[Any] = ()) -> bytes:
        return self._message.encode(data)

    def send(self, data: Sequence[Any] = (), minclock: int = 0, reqclock: int = 0) -> None:
        """Queue it: not sent before MCU clock `minclock`, needed by `reqclock` (0: at once)."""
        if not self._serial.is_absent:
            self._serial.raw_send(self._message.encode(data), minclock, reqclock, self._queue)


class CommandQueryWrapper:
    """One command with an answer. `send` returns the answer as a dict of its parameters."""

    def __init__(
        self,
        serial: SerialReader,
        msgformat: str,
        response_format: str,
        oid: int | None = None,
        cmd_queue: Any = None,
        error_class: type[Exception] = error,
    ) -> None:
        parser = serial.get_msgparser()
        self._serial = serial
        self._message = parser.lookup_command(msgformat)
        self._response = parser.lookup_command(response_format).name
        self._oid = oid
        self._queue = serial.get_default_command_queue() if cmd_queue is None else cmd_queue
        self._error = error_class

    def _ask(self, data: Sequence[Any], minclock: int, reqclock: int, retry: bool) -> Params:
        if self._serial.is_absent:
            raise self._error(f"{self._serial.warn_prefix}the board is not connected")
        message = self._message.encode(data)
        try:
            return self._serial.query(
                message, self._response, self._oid, self._queue, minclock, reqclock, retry
            )
        except error as e:
            raise self._error(str(e)) from None

    def send(
        self, data: Sequence[Any] = (), minclock: int = 0, reqclock: int = 0, retry: bool = True
    ) -> Params:
        """Ask; raises the wrapper's error class if no answer comes."""
        return self._ask(data, minclock, reqclock, retry)

    def send_with_preface(
        self,
        preface_cmd: CommandWrapper,
        preface_data: Sequence[Any] = (),
        data: Sequence[Any] = (),
        minclock: int = 0,
        reqclock: int = 0,
        retry: bool = True,
    ) -> Params:
        """Ask, with another command right before it."""
        if not self._serial.is_absent:
            self._serial.raw_send(preface_cmd.encode(preface_data), minclock, reqclock, self._queue)
        return self._ask(data, minclock, reqclock, retry)
