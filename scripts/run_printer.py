#!/usr/bin/env python3
"""A simulated printer in real time with its host and Moonraker: one command, and any web front end can connect.

    scripts/run_printer.py                                 (make printer)
    scripts/run_printer.py --config config/sim-two-mcu.cfg --data ~/two --port 7126 --speed 4

The data folder has the layout Moonraker expects and is kept from run to run:

    DATA/config/printer.cfg   made from --config the first time, afterwards yours (SAVE_CONFIG writes here)
    DATA/gcodes/              uploads          DATA/logs/     klippy.log, moonraker.log
    DATA/comms/klippy.sock    API server       DATA/comms/klippy.serial   terminal for G-code

The programs run as processes of their own and are started again if they die. Usually the host and the machine are one
process (scripts/paced_host.py), late only together. With --separate the machine is a process behind pseudo terminals
and the host is klippy/klippy.py itself, as with real boards: it needs a computer that is never busy for long.
"""

from __future__ import annotations

import in_venv

import argparse
import contextlib
import ctypes
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))
sys.path.insert(0, str(ROOT / "scripts"))

from simulation import printer_data  # noqa: E402

MOONRAKER = ROOT / "out" / "moonraker-venv" / "bin" / "moonraker"
POLL_S = 0.2
RESTART_DELAY_S = 1.0
QUICK_DEATH_S = 5.0  # a program that lives shorter than this ...
QUICK_DEATHS_MAX = 3  # ... so many times in a row is not started again
STOP_S = 5.0  # from SIGTERM to SIGKILL


def say(text: str) -> None:
    """One line to whoever started this."""
    print(text, flush=True)


@dataclass(slots=True)
class Program:
    """One program that is to run all the time."""

    name: str
    command: list[str]
    log: Path  # for what it says on stderr
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    quick_deaths: int = 0
    restart_at: float = 0.0
    given_up: bool = field(default=False)

    def start(self, now: float) -> None:
        """Start it in a session of its own: Ctrl-C reaches this program only."""
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # what they log goes to their own log files
                stderr=output,
                start_new_session=True,
                preexec_fn=_end_with_parent,  # noqa: PLW1509  (this program has one thread)
            )
        self.started = now

    def watch(self, now: float) -> None:
        """Start it again if it died."""
        if self.given_up:
            return
        if self.process is None:
            if now >= self.restart_at:
                self.start(now)
            return
        status = self.process.poll()
        if status is None:
            return
        self.process = None
        self.quick_deaths = self.quick_deaths + 1 if now - self.started < QUICK_DEATH_S else 0
        self.restart_at = now + RESTART_DELAY_S
        self.given_up = self.quick_deaths >= QUICK_DEATHS_MAX
        then = "giving up" if self.given_up else "starting it again"
        say(f"run_printer: {self.name} ended with status {status} (see {self.log}); {then}")

    def stop(self) -> None:
        """End it in good order, or else."""
        process, self.process = self.process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _end_with_parent() -> None:
    """In the child: SIGTERM should this program be killed (prctl PR_SET_PDEATHSIG)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)


def find_moonraker() -> Path | None:
    """Moonraker's start script: $MOONRAKER, the one of `scripts/setup.sh moonraker`, or on PATH."""
    named = os.environ.get("MOONRAKER")
    if named:
        return Path(named)
    if MOONRAKER.exists():
        return MOONRAKER
    found = shutil.which("moonraker")
    return Path(found) if found else None


def ask_host(sock_path: Path, timeout_s: float = 1.0) -> dict[str, Any] | None:
    """Answer of the API server to `info`; None if nobody answers."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.settimeout(timeout_s)
            sock.connect(str(sock_path))
            sock.sendall(b'{"id":1,"method":"info","params":{}}\x03')
            data = b""
            while not data.endswith(b"\x03"):
                part = sock.recv(65536)
                if not part:
                    return None
                data += part
        result = json.loads(data[:-1]).get("result")
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) else None


def moonraker_is_up(port: int) -> bool:
    """Whether Moonraker answers and has found the host."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/server/info", timeout=1.0) as answer:
            return bool(json.load(answer)["result"]["klippy_connected"])
    except (OSError, ValueError, KeyError, urllib.error.URLError):
        return False


class Supervisor:
    """Starts the programs, says when the printer is ready, watches them, stops them."""

    def __init__(self, folder: printer_data.PrinterData, programs: list[Program], port: int | None) -> None:
        self._folder = folder
        self._programs = programs
        self._port = port
        self._reported = ""
        self._moonraker_announced = port is None
        self._ending = False

    def end(self, number: int, frame: object) -> None:
        """Signal handler."""
        self._ending = True

    def run(self) -> int:
        """Until a signal, or until a program cannot be kept running."""
        try:
            while not self._ending and not any(program.given_up for program in self._programs):
                for program in self._programs:
                    program.watch(time.monotonic())
                self._report()
                time.sleep(POLL_S)
        finally:
            for program in reversed(self._programs):
                program.stop()
            self._folder.socket.unlink(missing_ok=True)
        if self._ending:
            say("run_printer: stopped")
        return 0 if self._ending else 1

    def _report(self) -> None:
        """A line at each change of the printer's state."""
        info = ask_host(self._folder.socket) if self._folder.socket.exists() else None
        state = str(info["state"]) if info else "starting"
        if state not in (self._reported, "startup"):
            self._reported = state
            if state == "ready":
                say(f"ready: the printer is ready; API server at {self._folder.socket}")
            elif info:
                say(f"{state}: {info['state_message']}")
        if not self._moonraker_announced and self._port is not None and moonraker_is_up(self._port):
            self._moonraker_announced = True
            say(f"moonraker: http://127.0.0.1:{self._port}/  (printer address for a web front end)")


def host_programs(options: argparse.Namespace, folder: printer_data.PrinterData) -> list[Program]:
    """The machine and the host: one process, or two."""
    arguments = [
        str(folder.config),
        "-a",
        str(folder.socket),
        "-l",
        str(folder.log),
        "-I",
        str(folder.terminal),
    ]
    output = folder.logs / "run_printer.log"
    scripts = ROOT / "scripts"
    if options.separate:
        machine = [sys.executable, str(scripts / "run_simulator.py"), str(folder.config)]
        host = [sys.executable, str(ROOT / "klippy" / "klippy.py"), *arguments]
        return [Program("machine", machine, output), Program("host", host, output)]
    host = [sys.executable, str(scripts / "paced_host.py"), *arguments, "--speed", str(options.speed)]
    return [Program("host", [*host, "--seed", str(options.seed)], output)]


def front_end_program(options: argparse.Namespace, folder: printer_data.PrinterData) -> Program:
    """The server of the pages, and of Moonraker behind them."""
    server = ROOT / "klippy" / "webhooks" / "front_end.py"
    command = [sys.executable, str(server), str(options.front_end), "--port", str(options.front_end_port)]
    command += ["--host", "127.0.0.1", "--moonraker", str(options.port)]
    return Program("front end", command, folder.logs / "front_end.log")


def moonraker_program(options: argparse.Namespace, folder: printer_data.PrinterData) -> Program | None:
    """Moonraker, if it is wanted and there."""
    if options.no_moonraker:
        return None
    start = find_moonraker()
    if start is None:
        say("run_printer: Moonraker is not installed (scripts/setup.sh moonraker); going on without it")
        return None
    conf = folder.write_moonraker_conf(options.port)
    command = [str(start), "-d", str(folder.root), "-c", str(conf), "-l", str(folder.logs / "moonraker.log")]
    return Program("moonraker", command, folder.logs / "moonraker-output.log")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="A simulated printer in real time, its host and Moonraker. Ctrl-C ends them."
    )
    parser.add_argument(
        "--config",
        type=Path,
        default=ROOT / "config" / "sim-induction.cfg",
        help="what DATA/config/printer.cfg is made from if there is none (default config/sim-induction.cfg)",
    )
    parser.add_argument(
        "--data",
        type=Path,
        default=Path.home() / "ferrite_data",
        metavar="DIR",
        help="folder with config, gcodes, logs, comms (default ~/ferrite_data)",
    )
    parser.add_argument("--no-moonraker", action="store_true", help="host and machine only")
    parser.add_argument("--port", type=int, default=7125, help="Moonraker's port on 127.0.0.1 (default 7125)")
    parser.add_argument(
        "--front-end", type=Path, metavar="FOLDER", help="serve an unpacked release of Mainsail, Fluidd, ..."
    )
    parser.add_argument(
        "--front-end-port", type=int, default=8080, help="its port on 127.0.0.1 (default 8080)"
    )
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds a second (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="fixes noise and line damage (default 1)")
    parser.add_argument(
        "--separate", action="store_true", help="machine and host as two processes, as with real boards"
    )
    options = parser.parse_args(argv)
    if not 0.05 <= options.speed <= 100.0:
        parser.error("--speed must be between 0.05 and 100")
    if options.front_end and not (options.front_end / "index.html").is_file():
        parser.error(f"--front-end: {options.front_end} has no index.html, it is no unpacked front end")
    if options.separate and options.speed != 1.0:
        parser.error("--separate runs in real time only: leave --speed out")
    return options


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    try:
        folder = printer_data.PrinterData(options.data, ROOT)
        note = folder.prepare(options.config)
        if ask_host(folder.socket) is not None:
            raise printer_data.DataError(f"another host serves {folder.socket}; use another --data folder.")
        moonraker = moonraker_program(options, folder)
    except (printer_data.DataError, OSError) as e:
        print(f"run_printer: {e}", file=sys.stderr)
        return 2
    say(f"run_printer: data in {folder.root}; {note}")
    programs = host_programs(options, folder)
    if options.front_end and moonraker:
        programs.append(front_end_program(options, folder))
        say(f"front end: http://127.0.0.1:{options.front_end_port}/")
    supervisor = Supervisor(
        folder, programs + ([moonraker] if moonraker else []), options.port if moonraker else None
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, supervisor.end)
    return supervisor.run()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
