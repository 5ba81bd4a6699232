#!/usr/bin/env python3
"""Runs the tool that writes an image into a board, and says in plain words what is missing when it cannot.

Usage: flash_firmware.py [--device PATH] TOOL ARGUMENT...       (make PORT=NAME flash does it)

--device is the serial port the tool is going to use; it is looked at first. The exit status is 0 if the board has the
image.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ADVICE = {
    "openocd": "Is the board connected by its debugger's USB port, and may you use that (Debian: the group plugdev)? "
    'With "Error: open failed" openocd has found no debugger at all.',
    "avrdude": "Is it the board's own USB port, is nobody else using it (a running host must be stopped), and is it an "
    "Arduino Mega's boot loader that answers there?",
}
SERIAL = ("/dev/serial/by-id/*", "/dev/ttyACM*", "/dev/ttyUSB*")


def serial_ports(root: Path = Path("/")) -> list[str]:
    """Serial ports that are there, by their lasting names if they have such."""
    for pattern in SERIAL:
        found = sorted(str(path) for path in root.glob(pattern.lstrip("/")))
        if found:
            return found
    return []


def objection(tool: str, device: str | None) -> str | None:
    """Why it cannot even be tried, for people; None if it can."""
    if shutil.which(tool) is None:
        return f"{tool} writes the board and is not installed here (Debian: apt-get install {tool})."
    if device is None:
        return None
    if not os.path.exists(device):
        there = serial_ports()
        found = "Serial ports here: " + ", ".join(there) if there else "No serial port is here at all"
        return f"There is no {device}. {found}; name the board's with FLASH_DEVICE=/dev/..."
    if not os.access(device, os.R_OK | os.W_OK):
        return f"{device} may not be used by you (Debian: the group dialout)."
    return None


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", help="serial port of the board")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="the tool and its arguments")
    options = parser.parse_args(argv)
    if not options.command:
        parser.error("no tool is named")
    tool = options.command[0]
    problem = objection(tool, options.device)
    if problem is not None:
        print(f"flash: {problem}", file=sys.stderr)
        return 1
    status = subprocess.run(options.command, check=False).returncode
    if status:
        advice = ADVICE.get(Path(tool).name, "")
        print(f"flash: {tool} has not written the board (its words are above). {advice}", file=sys.stderr)
        return 1
    print("flash: written and compared")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
