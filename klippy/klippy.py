#!/usr/bin/env python3
"""The host program: command line, log, and the loop over restarts."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import sys
import time
from typing import Any

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
_BAD_USE = 2

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules are loaded: no traceback
try:
    import queuelogger
    import util
    from link import serialport
    from printer import Printer
    from reactor import Reactor
except ModuleNotFoundError as e:
    if __name__ != "__main__":
        raise
    print(
        f"klippy.py: this Python lacks the package '{e.name}'; run `make setup` in {ROOT} once, then start with "
        f"{ROOT}/.venv/bin/python {os.path.abspath(__file__)}",
        file=sys.stderr,
    )
    sys.exit(_BAD_USE)

__all__ = ["APP_NAME", "Printer", "main"]

APP_NAME = "Ferrite"  # plugins know the host by it

_RESTART_DELAY_S = 0.5  # lets clients see the socket vanish
_EXIT_ERROR = 255
_INTERRUPTED = "interrupted"  # batch mode, before the end of its file
_EXIT_STATUS = {"error_exit": _EXIT_ERROR, _INTERRUPTED: 130}


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """The command line; wrong use ends the program with a message."""
    parser = argparse.ArgumentParser(
        prog="klippy.py",
        description="Host of a 3D printer. Serves a pseudo terminal, or with -i runs a file and ends.",
    )
    parser.add_argument("config", metavar="PRINTER.cfg", help="config file of the printer")
    parser.add_argument(
        "-i", "--debuginput", metavar="FILE", help="batch mode: run the G-code of this file, then end"
    )
    parser.add_argument(
        "-I",
        "--input-tty",
        metavar="PTY",
        default="/tmp/printer",
        help="pseudo terminal to make (%(default)s)",
    )
    parser.add_argument("-a", "--api-server", metavar="SOCKET", help="unix socket of the API server")
    parser.add_argument("-l", "--logfile", metavar="LOG", help="write the log to this file")
    parser.add_argument("-v", action="store_true", dest="verbose", help="log more")
    parser.add_argument(
        "-o", "--debugoutput", metavar="OUT", help="write the MCU's messages to a file, not to a port"
    )
    parser.add_argument(
        "-d",
        "--dictionary",
        metavar="DICT|NAME=DICT",
        action="append",
        default=[],
        help="data dictionary of an MCU for -o; NAME= for MCUs other than 'mcu' (repeatable)",
    )
    parser.add_argument("--import-test", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def build_start_args(options: argparse.Namespace) -> dict[str, Any]:
    """How the printer was started, as plugins read it from get_start_args()."""
    start_args: dict[str, Any] = {
        "config_file": os.path.abspath(options.config),
        "apiserver": options.api_server,
        "start_reason": "startup",
        "open_port": serialport.open_port,
        "config_overrides": [],
        "log_file": os.path.abspath(options.logfile) if options.logfile else None,
        "software_version": util.get_software_version(ROOT),
        "cpu_info": util.get_cpu_info(),
        "klipper_path": ROOT,
    }
    if options.debuginput:
        start_args["debuginput"] = options.debuginput
        start_args["gcode_fd"] = os.open(options.debuginput, os.O_RDONLY)
    else:
        start_args["gcode_fd"] = util.create_pty(options.input_tty)
    if options.debugoutput:
        start_args["debugoutput"] = options.debugoutput
        for entry in options.dictionary:
            name, _, path = entry.rpartition("=")
            start_args["dictionary" + (f"_{name}" if name and name != "mcu" else "")] = path
    return start_args


def start_log(options: argparse.Namespace) -> queuelogger.QueueListener | None:
    """Everything goes to the log file, problems also to stderr."""
    root = logging.getLogger()
    root.setLevel(logging.DEBUG if options.verbose else logging.INFO)
    console = logging.StreamHandler()
    console.setFormatter(queuelogger.LineFormatter("%(message)s"))
    console.setLevel(logging.DEBUG if options.verbose and not options.logfile else logging.WARNING)
    root.addHandler(console)
    return queuelogger.setup_bg_logging(options.logfile) if options.logfile else None


def serve(start_args: dict[str, Any], listener: queuelogger.QueueListener | None) -> str:
    """Run printers one after the other until one ends for good; returns why."""
    while True:
        if listener is not None:
            listener.clear_rollover_info()
            listener.set_rollover_info("versions", _versions(start_args))
        gc.collect()
        reactor = Reactor()
        printer = Printer(reactor, start_args)
        _exit_on_signal(printer)
        result = printer.run()
        if result not in ("restart", "firmware_restart"):
            return result
        time.sleep(_RESTART_DELAY_S)
        reactor.finalize()
        logging.info("Restarting printer")
        start_args["start_reason"] = result


def _exit_on_signal(printer: Printer) -> None:
    """The first SIGTERM or SIGINT ends the run in good order, the second at once."""
    result = _INTERRUPTED if "debuginput" in printer.get_start_args() else "exit"

    def handler(number: int, frame: object) -> None:
        signal.signal(number, signal.default_int_handler)
        printer.get_reactor().register_async_callback(lambda eventtime: printer.request_exit(result))

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, handler)


def _versions(start_args: dict[str, Any]) -> str:
    return "\n".join(
        [
            f"Args: {sys.argv}",
            f"Host version: {start_args['software_version']!r}",
            f"Python: {sys.version!r}",
            f"CPU: {start_args['cpu_info']}",
        ]
    )


def main(argv: list[str] | None = None) -> int:
    """Run the host; returns the exit status."""
    options = parse_arguments(sys.argv[1:] if argv is None else argv)
    try:
        listener = start_log(options)
        start_args = build_start_args(options)
    except OSError as e:
        reason = f"{e.strerror}: {e.filename}" if e.filename else str(e)
        print(f"klippy.py: unable to start: {reason}", file=sys.stderr)
        return _EXIT_ERROR
    start_args["log_listener"] = listener
    logging.info("Starting Ferrite\n%s", _versions(start_args))
    if not options.debuginput:
        for note in util.take_priority():
            logging.info(note)
    try:
        result = serve(start_args, listener)
    except KeyboardInterrupt:
        result = _INTERRUPTED if options.debuginput else "exit"
    finally:
        if listener is not None:
            listener.stop()
    if result == _INTERRUPTED:
        print(f"klippy.py: interrupted before the end of {options.debuginput}", file=sys.stderr)
    return _EXIT_STATUS.get(result, 0)


if __name__ == "__main__":
    sys.exit(main())
