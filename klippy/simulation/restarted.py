"""What a host that is started again after a stop makes of the print: the offer of [print_recovery], beside the machine.

stop (a fault) ─► the machine stands ─► a new host on it, until it is ready ─► offered or refused; how far off
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import Any

from reactor import Reactor

STARTS_MAX = 3  # a board with a session of the host before is reset first
POLL_S, START_S = 0.1, 15.0  # a shutdown of the board meanwhile is followed by its reset

NEVER = {"state": "none", "reason": "it never stopped", "offered": 0, "off_steps": 0.0, "bytes_per_minute": 0}


def start_again(new_printer: Callable[[], Any], reactors: Callable[[], Reactor]) -> Any:
    """Start hosts on the machine as it is, until one is ready or fails; returns its printer."""
    reason, printer = "startup", None
    for _ in range(STARTS_MAX):
        reactor = reactors()
        printer = new_printer()
        printer.start_args["start_reason"] = reason
        reactor.register_callback(functools.partial(_wait, printer, reactor))
        reason = printer.run()
        if reason == "exit":
            break
    return printer


def _wait(printer: Any, reactor: Reactor, eventtime: float) -> None:
    until = eventtime + START_S
    while printer.get_state_message()[1] != "ready" and reactor.monotonic() < until:
        reactor.pause(reactor.monotonic() + POLL_S)
    recovery = printer.lookup_object("print_recovery")
    if recovery.get_status(0.0)["state"] == "home_first":
        printer.lookup_object("gcode").run_script("G28 X Y")
        reactor.pause(reactor.monotonic() + 2.0 * recovery.settings.interval_s)
    printer.request_exit("exit")


def judge(printer: Any, place_mm: dict[str, float]) -> dict[str, Any]:
    """The offer of a printer with [print_recovery]. `place_mm`: where each axis of the machine is. `off_steps`: how far
    the offered place is from there at most, in full steps; a refusal is off by nothing."""
    recovery = printer.lookup_object("print_recovery")
    offer = recovery.get_status(0.0)
    if os.path.exists(recovery.journal.path):
        os.unlink(recovery.journal.path)
    if printer.get_state_message()[1] != "ready":
        return {"state": "no host", "reason": printer.get_state_message()[0], "offered": 0, "off_steps": 0.0}
    off_steps = 0.0
    if offer["state"] == "offered":
        steps_mm = recovery.full_steps_mm()
        for number, name in enumerate(("x", "y", "z", "extruder")):
            full_mm = steps_mm["extruder" if name == "extruder" else f"stepper_{name}"]
            off_steps = max(off_steps, abs(offer["position"][number] - place_mm[name]) / full_mm)
    return {
        "state": offer["state"],
        "reason": offer["reason"],
        "offered": int(offer["state"] == "offered"),
        "off_steps": round(off_steps, 4),
    }
