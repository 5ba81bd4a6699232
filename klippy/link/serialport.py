"""Ports: what carries the bytes of one MCU link. Everything above sees only `Port` and an `OpenPort` function.

A port is handed a serialqueue (klippy/chelper/link/serialqueue.h) and moves its bytes; it knows no messages.

- `ThreadPort`: a file descriptor (serial device, pty, unix socket) served by a thread of the C helper
- `FilePort`: batch mode, everything goes to a file
- the simulated port lives with the simulated world and is handed in as an `OpenPort` of its own
- canport.py opens the port of a board on a CAN bus
"""

from __future__ import annotations

import logging
import os
import socket
import stat
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, BinaryIO, Protocol

import chelper
from reactor import Reactor


class PortError(Exception):
    """A port that cannot be opened or has failed; the text is for people."""


class Port(Protocol):
    """One open connection to an MCU."""

    def attach(self, sq_pointer: Any, on_receive: Callable[[], None]) -> None:
        """Start moving bytes. `on_receive` is called in the reactor thread when messages wait to be pulled."""
        ...

    def notify(self) -> None:
        """Something was queued: look at serialqueue_transmit again."""
        ...

    def reset(self) -> None:
        """Restart the MCU by the port's own means (DTR …) if it has any."""
        ...

    def close(self) -> None:
        """Stop moving bytes and release the port. The serialqueue may be freed afterwards."""
        ...


OpenPort = Callable[[Reactor, str, int], Port]
# What to look at if a board does not answer
ADVICE = (
    "Check that the board is powered and its cable is plugged in, that the option 'serial' names the right device"
    " (ls /dev/serial/by-id/), that the option 'baud' is the firmware's, that the board runs the printer's"
    " firmware, and that no other program uses the port."
)

_FILE_CHUNK = 1 << 16  # bytes


class ThreadPort:
    """A file descriptor served by a thread of the C helper. Owns `fd`; `release` closes it.

    can_id: of the frames to send, if it is a CAN socket.
    """

    def __init__(
        self,
        reactor: Reactor,
        name: str,
        fd: int,
        release: Callable[[], None],
        reset: Callable[[], None],
        can_id: int = 0,
    ) -> None:
        self._reactor = reactor
        self._name = name
        self._fd = fd
        self._release = release
        self._reset = reset
        self._can_id = can_id
        self._lib = chelper.get_ffi()[1]
        self._thread: Any = None
        self._pipe: tuple[int, int] = (-1, -1)
        self._handler: Any = None
        self._on_receive: Callable[[], None] = lambda: None
        self._failure_reported = False

    def attach(self, sq_pointer: Any, on_receive: Callable[[], None]) -> None:
        self._on_receive = on_receive
        os.set_blocking(self._fd, False)
        self._pipe = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._handler = self._reactor.register_fd(self._pipe[0], self._woken)
        self._thread = self._lib.portthread_start(sq_pointer, self._fd, self._pipe[1], self._can_id)
        if not self._thread:
            raise PortError(f"Unable to start a thread for port '{self._name}'.")

    def _woken(self, eventtime: float) -> None:
        try:
            os.read(self._pipe[0], 4096)
        except BlockingIOError:
            pass
        self._on_receive()
        if self._thread is not None and not self._failure_reported:
            code = self._lib.portthread_error(self._thread)
            if code:
                self._failure_reported = True
                reason = "the other end closed it" if code < 0 else os.strerror(code)
                logging.error("Port '%s' failed: %s", self._name, reason)

    def notify(self) -> None:
        if self._thread is not None:
            self._lib.portthread_kick(self._thread)

    def reset(self) -> None:
        self._reset()

    def close(self) -> None:
        if self._thread is not None:
            self._lib.portthread_stop(self._thread)
            self._thread = None
        if self._handler is not None:
            self._reactor.unregister_fd(self._handler)
            self._handler = None
            os.close(self._pipe[0])
            os.close(self._pipe[1])
        self._release()


class FilePort:
    """Batch mode: writes the blocks of a serialqueue in file mode to a file; nothing ever comes back."""

    def __init__(self, path: str) -> None:
        self._ffi, self._lib = chelper.get_ffi()
        try:
            self._file: BinaryIO = open(path, "wb")  # noqa: SIM115  (lives as long as the port)
        except OSError as e:
            raise PortError(f"Unable to write the output file '{path}': {e.strerror}.") from None
        self._buffer = self._ffi.new("uint8_t[]", _FILE_CHUNK)
        self._next_wake = self._ffi.new("double *")
        self._sq: Any = None

    def attach(self, sq_pointer: Any, on_receive: Callable[[], None]) -> None:
        self._sq = sq_pointer

    def notify(self) -> None:
        if self._lib.serialqueue_file_pending(self._sq, 0) >= _FILE_CHUNK:
            self._write_out()

    def _write_out(self) -> None:
        while count := self._lib.serialqueue_transmit(
            self._sq, self._buffer, _FILE_CHUNK, 0.0, self._next_wake
        ):
            self._file.write(self._ffi.buffer(self._buffer, count))

    def flush(self) -> None:
        """Write all that was queued so far, the unfinished last block included."""
        if self._sq is not None and not self._file.closed:
            self._lib.serialqueue_file_pending(self._sq, 1)
            self._write_out()
            self._file.flush()

    def reset(self) -> None:
        pass

    def close(self) -> None:
        self.flush()
        self._file.close()


# --- opening real ports -----------------------------------------------------------------------------------------


def _open_pty(reactor: Reactor, path: str) -> Port:
    """A pseudo terminal or another plain character device: raw bytes, no speed."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        tty.setraw(fd)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except termios.error:
        pass  # not a terminal: nothing to set
    return ThreadPort(reactor, path, fd, lambda: os.close(fd), lambda: None)


def _open_unix_socket(reactor: Reactor, path: str) -> Port:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.connect(path)
    except OSError:
        connection.close()
        raise
    return ThreadPort(reactor, path, connection.fileno(), connection.close, lambda: None)


def _pulse_dtr(device: Any) -> None:
    device.dtr = False
    time.sleep(
        0.1
    )  # the usual 100 nF on an Arduino's reset line needs some ms; the reactor has nothing to do
    device.dtr = True


def _pulse_dtr_twice(device: Any) -> None:
    """A Fysetc Cheetah boots by RTS from flash or into its bootloader; the first reset may still be the latter."""
    device.rts = False
    for _ in range(2):
        _pulse_dtr(device)
        time.sleep(0.1)


def _open_serial(reactor: Reactor, path: str, baud: int, is_cheetah: bool = False) -> Port:
    import serial  # here: batch and simulated runs do without it

    try:
        device = serial.serial_for_url(path, do_not_open=True)
        device.baudrate = baud
        device.timeout = 0
        if not path.startswith("socket://"):
            device.exclusive = True
        if is_cheetah:
            device.rts = False  # before it is opened: pyserial sets it
        device.open()
    except (serial.SerialException, ValueError) as e:
        raise PortError(f"Unable to open serial port '{path}' at {baud} baud: {e}") from None

    reset = _pulse_dtr_twice if is_cheetah else _pulse_dtr
    return ThreadPort(reactor, path, device.fileno(), device.close, lambda: reset(device))


def _is_pseudo_terminal(mode: os.stat_result) -> bool:
    # Linux device numbers: majors 136..143 are the Unix98 pseudo terminals
    return stat.S_ISCHR(mode.st_mode) and 136 <= os.major(mode.st_rdev) <= 143


def open_cheetah_port(reactor: Reactor, path: str, baud: int) -> Port:
    """Open a real port to a Fysetc Cheetah. Raises `PortError`."""
    return open_port(reactor, path, baud, is_cheetah=True)


def open_port(reactor: Reactor, path: str, baud: int, is_cheetah: bool = False) -> Port:
    """Open a real port: serial device, pty, unix socket, or a pyserial url. Raises `PortError`."""
    try:
        if "://" in path:
            return _open_serial(reactor, path, baud, is_cheetah)
        mode = os.stat(path)
        if stat.S_ISSOCK(mode.st_mode):
            return _open_unix_socket(reactor, path)
        if _is_pseudo_terminal(mode):
            return _open_pty(reactor, path)
        if stat.S_ISCHR(mode.st_mode):
            return _open_serial(reactor, path, baud, is_cheetah)
    except FileNotFoundError:
        raise PortError(f"Unable to open serial port '{path}': there is no such device.") from None
    except OSError as e:
        raise PortError(f"Unable to open serial port '{path}': {e.strerror}.") from None
    raise PortError(f"Unable to open serial port '{path}': it is neither a device nor a socket.")
