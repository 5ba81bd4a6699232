"""Small helpers around the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import logging
import os
import pty
import resource
import stat
import subprocess
import termios
from typing import BinaryIO


def set_nonblock(fd: int) -> None:
    """Make reads and writes of a descriptor return at once."""
    fcntl.fcntl(fd, fcntl.F_SETFL, fcntl.fcntl(fd, fcntl.F_GETFL) | os.O_NONBLOCK)


def create_pty(link_path: str) -> int:
    """Open a pseudo terminal, reachable by others as `link_path`; returns our end, raw and non-blocking."""
    our_end, their_end = pty.openpty()
    if os.path.islink(link_path):
        os.unlink(link_path)
    os.symlink(os.ttyname(their_end), link_path)
    set_nonblock(our_end)
    attributes = termios.tcgetattr(our_end)
    attributes[3] &= ~termios.ECHO
    termios.tcsetattr(our_end, termios.TCSANOW, attributes)
    return our_end


def open_plain(path: str) -> BinaryIO:
    """Open a plain file for reading. A pipe without a writer would wait for ever, a device may have no end: OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    kind = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(kind):
        os.close(descriptor)
        number, text = (errno.EISDIR, None) if stat.S_ISDIR(kind) else (errno.EINVAL, "it is no plain file")
        raise OSError(number, text or os.strerror(number), path)
    return open(path, "rb", opener=lambda path, flags: descriptor)  # with its name; the caller closes it


def read_plain(path: str, size_max: int = 16_000_000) -> str:
    """The text of a plain file in UTF-8, line ends normalised. Raises OSError, UnicodeDecodeError."""
    with open_plain(path) as file:
        data = file.read(size_max + 1)
    if len(data) > size_max:
        raise OSError(errno.EFBIG, f"it is longer than {size_max} bytes", path)
    return data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def replace_file(path: str, text: str, backup: str | None = None) -> None:
    """Write a file in one step: at every moment, whatever is killed, `path` holds all of the old text or of the new.

    The old file's permissions stay, its owner where we may, and a symbolic link stays a link. `backup` becomes a copy
    of the old file first. Raises OSError; then the old file is untouched.
    """
    target = os.path.realpath(path)
    folder, name = os.path.split(target)
    # in the same folder: only a rename within one file system is atomic; hidden from `[include *.cfg]`
    temporary = os.path.join(folder, f".{name}.new")
    try:
        with open_plain(target) as file:
            before, old = os.fstat(file.fileno()), file.read()
    except FileNotFoundError:
        before = None
    else:
        if backup is not None:
            _install(backup, temporary, old, before)
    _install(target, temporary, text.encode("utf-8"), before)


def _install(path: str, temporary: str, content: bytes, like: os.stat_result | None) -> None:
    """Put a file into place, on disk when this returns, with the permissions of `like` (None: the usual ones)."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(temporary)  # of a write that was killed
    try:
        mode = 0o666 if like is None else stat.S_IRUSR | stat.S_IWUSR
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            if like is not None:
                with contextlib.suppress(OSError):  # only root may give files away
                    os.fchown(file.fileno(), like.st_uid, like.st_gid)
                os.fchmod(file.fileno(), stat.S_IMODE(like.st_mode))
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    with contextlib.suppress(OSError):  # some network file systems cannot; the file is in place already
        descriptor = os.open(os.path.dirname(temporary), os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def get_cpu_info() -> str:
    """`4 core ARMv7 Processor`."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            entries = [line.partition(":") for line in file]
    except OSError:
        return "?"
    cores = sum(1 for key, _, _ in entries if key.strip() == "processor")
    model = next((value.strip() for key, _, value in entries if key.strip() == "model name"), "?")
    return f"{cores} core {model}"


def get_software_version(root: str) -> str:
    """`0.2.0-a519a1d-dirty`: the file VERSION of the program's folder, and the commit if it is a checkout."""
    with open(os.path.join(root, "VERSION"), encoding="utf-8") as file:
        version = file.read().strip()
    try:
        answer = subprocess.run(
            ["git", "-C", root, "describe", "--always", "--exclude=*", "--dirty"],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        logging.debug("git is not available")
        return version
    return "-".join(filter(None, (version, answer.stdout.strip())))


REAL_TIME_PRIORITY = 1
_MCL_CURRENT_AND_FUTURE = 3


def take_priority() -> list[str]:
    """Real-time priority and locked memory where the system grants them by its limits; what came of it, for the log."""
    priority_max, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if priority_max < REAL_TIME_PRIORITY and priority_max != resource.RLIM_INFINITY:
        return ["Real-time priority: not granted (LimitRTPRIO of the service is 0)"]
    notes = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
        notes.append(f"Real-time priority: SCHED_FIFO {REAL_TIME_PRIORITY}")
    except OSError as e:
        notes.append(f"Real-time priority: refused ({e.strerror})")
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return [*notes, "Locked memory: not granted (LimitMEMLOCK of the service is not infinity)"]
    libc = ctypes.CDLL(None, use_errno=True)
    failed = libc.mlockall(_MCL_CURRENT_AND_FUTURE) and os.strerror(ctypes.get_errno())
    return [*notes, f"Locked memory: refused ({failed})" if failed else "Locked memory: all"]


def at_ordinary_priority(command: list[str]) -> list[str]:
    """The command of a program for long computations, which must not hold up the host: it inherits no priority."""
    return command if os.sched_getscheduler(0) == os.SCHED_OTHER else ["chrt", "--other", "0", *command]
