"""Small helpers around the operating system."""

from __future__ import annotations

import fcntl
import logging
import os
import pty
import subprocess
import termios


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
