"""Switches the power of a Raspberry Pi's USB ports off and on, with the program uhubctl (Debian package uhubctl)."""

from __future__ import annotations

import logging
import subprocess
from pathlib import Path

MODEL = Path("/proc/device-tree/model")
# uhubctl's README: the hubs, and the ports if not all of them (port 1 of the older models' hub is the network)
HUBS = {
    "Raspberry Pi 5": (("-l", "1"), ("-l", "3")),
    "Raspberry Pi 4": (("-l", "1-1"),),
    "Raspberry Pi": (("-l", "1-1", "-p", "2"),),
}
OFF_S = 2
TIMEOUT_S = 15.0


def cycle() -> None:
    """All ports off for OFF_S, then on. A failure is logged: the boards are then not reset."""
    try:
        model = MODEL.read_text(encoding="utf-8", errors="replace")
        hubs = next((hubs for name, hubs in HUBS.items() if model.startswith(name)), None)
        if hubs is None:
            raise OSError(f"this computer is no Raspberry Pi but a '{model.strip()}'")
        for hub in hubs:
            command = ["uhubctl", "-a", "cycle", "-d", str(OFF_S), *hub]
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.CalledProcessError as e:
        logging.error("USB power: uhubctl failed: %s", (e.stderr or e.stdout).strip())
    except (OSError, subprocess.TimeoutExpired) as e:
        logging.error("USB power could not be switched: %s", e)
