#!/usr/bin/env python3
"""The host and its simulated printer in one process, the wall clock setting the speed (used by run_printer.py).

    wall clock ──► PacedTime.wait ──► world advances, never ahead of the wall clock × speed
                        │
                        └── API clients and terminals are served while there is nothing to advance

Host and machine share one clock. If the computer is too slow for a moment, both are late together and the print goes
on: nothing can come too late on the simulated wire. How much time was lost that way is in the log. The machine is
switched on with the process; RESTART and FIRMWARE_RESTART restart the host and reset the MCUs, nothing else: the nozzle
stays hot and the axes stay where they are.
"""

from __future__ import annotations

import in_venv

import argparse
import gc
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

import klippy  # noqa: E402
from link.serialport import PortError  # noqa: E402
from printer import Printer  # noqa: E402
from reactor import FdPoll, Reactor  # noqa: E402
from simulation import world as world_module  # noqa: E402
from simulation.faults import FaultError, Injector, Target, all_orders  # noqa: E402
from simulation.machine import Machine, assemble  # noqa: E402
from simulation.simport import SimPort  # noqa: E402
from simulation.simtime import SimTime  # noqa: E402
from simulation.world import World, WorldError  # noqa: E402

STEP_S = 0.002  # the world catches up with the wall clock in steps of at least this
SLIP_S = 0.5  # farther behind than this, the lost time is given up
RESTART_DELAY_S = 0.3  # lets clients see the socket vanish


class PacedTime:
    """A `TimeSource`: the world's time, held back to `speed` seconds a second of the wall clock."""

    runs_by_itself = True
    _NOBODY = FdPoll()  # watches nothing

    def __init__(
        self, inner: SimTime, speed: float = 1.0, wall: Callable[[], float] = time.monotonic
    ) -> None:
        self._inner = inner
        self._wall = wall
        self.speed = speed
        self.lost_s = 0.0
        self._offset_s = inner.monotonic() - wall() * speed
        self.monotonic = inner.monotonic

    def wait(self, until: float, poll: FdPoll) -> None:
        """Let the world go on, but not ahead of the wall clock; return when there may be something to do.

        Clients that never stop asking do not hold the world up: it moves as soon as a step is due.
        """
        now = self._inner.monotonic()
        if until <= now:
            self._pass_busy_time(now)
            poll.poll(0.0)
            return
        step = min(STEP_S * self.speed, until - now)
        while until > now:
            allowed = self._wall() * self.speed + self._offset_s
            if allowed - now > SLIP_S * max(1.0, self.speed):
                self._give_up(allowed - now)
            elif allowed - now >= step:
                self._inner.wait(min(until, allowed), self._NOBODY)
                poll.poll(0.0)
                return
            elif poll.poll((now + step - allowed) / self.speed):
                return

    def _pass_busy_time(self, now: float) -> None:
        """Time goes on while the host has things to do, as it does for a real one, but no more than a step a round.

        Otherwise a greenlet that waits without sleeping would stop time, and wait for ever.
        """
        step = STEP_S * self.speed
        if self._wall() * self.speed + self._offset_s - now >= step:
            self._inner.wait(now + step, self._NOBODY)

    def _give_up(self, behind_s: float) -> None:
        self._offset_s -= behind_s
        self.lost_s += behind_s
        logging.info("Simulated printer: %.2f s behind the wall clock (%.2f s in all)", behind_s, self.lost_s)


class PacedHost:
    """Runs printers one after the other on one machine, until asked to end."""

    def __init__(self, start_args: dict[str, Any], speed: float, seed: int) -> None:
        self._start_args = start_args
        start_args["open_port"] = self._open_port
        start_args["simulator_parameters"] = world_module.parameter_tables()
        start_args["inject_fault"] = self._inject
        start_args["panels"] = lambda: self._machine.panels if self._machine else {}
        self._injector: Injector | None = None
        self._world = World(seed)
        self._inner = SimTime(self._world)
        self._time = PacedTime(self._inner, speed)
        self._machine: Machine | None = None
        self._printer: Any = None

    def run(self) -> str:
        """Serve until the end; returns why it ended."""
        listener = self._start_args["log_listener"]
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        while True:
            if listener is not None:
                listener.clear_rollover_info()
            gc.collect()
            reactor = Reactor(self._time)
            self._printer = Printer(reactor, self._start_args)
            result = str(self._printer.run())
            if result not in ("restart", "firmware_restart"):
                return result
            time.sleep(RESTART_DELAY_S)
            reactor.finalize()
            logging.info("Restarting printer")
            self._start_args["start_reason"] = result

    def _inject(self, text: str) -> str:
        if self._injector is None:
            return "there is no machine yet"
        self._injector.target.printer = self._printer  # of this start
        return self._injector.now(text)

    def _on_signal(self, number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        printer = self._printer
        printer.get_reactor().register_async_callback(lambda eventtime: printer.request_exit("exit"))

    def _open_port(self, reactor: Reactor, path: str, baud: int) -> SimPort:
        """The OpenPort of this program: the simulated MCU whose section names this path."""
        if self._machine is None:
            self._machine = self._build_machine()
        if path not in self._machine.serials:
            raise PortError(f"No simulated MCU has the serial port {path}.")
        return SimPort(self._world, self._inner, self._machine.mcus[self._machine.serials[path]])

    def _build_machine(self) -> Machine:
        sections = [section.settings for _, section in self._printer.lookup_objects("simulator")]
        if not sections:
            raise self._printer.config_error(
                "The config has no simulator sections, so there is no machine to run."
            )
        config = self._printer.lookup_object("configfile").get_status(0.0)["config"]
        try:
            machine = assemble(self._world, sections, config)
            self._world.open_trace(None, machine.recording.trace_rate_hz)
            self._injector = Injector(Target(machine, self._inner, self._printer))
            self._injector.order(all_orders(machine, ()))
        except (FaultError, WorldError) as e:
            raise self._printer.config_error(str(e)) from None
        return machine


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Host and simulated printer in one process.")
    parser.add_argument("config", type=Path, help="printer.cfg with simulator sections")
    parser.add_argument("-a", "--api-server", required=True, metavar="SOCKET")
    parser.add_argument("-l", "--logfile", required=True, metavar="LOG")
    parser.add_argument("-I", "--input-tty", required=True, metavar="PTY")
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds a second (default 1)")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    arguments = ["-a", options.api_server, "-l", options.logfile, "-I", options.input_tty]
    host_options = klippy.parse_arguments([str(options.config), *arguments])
    try:
        world_module.build()
        listener = klippy.start_log(host_options)
        start_args = klippy.build_start_args(host_options)
    except (WorldError, OSError) as e:
        print(f"paced_host: {e}", file=sys.stderr)
        return 2
    start_args["log_listener"] = listener
    logging.info("Starting Ferrite on a simulated printer, %g times real time", options.speed)
    try:
        result = PacedHost(start_args, options.speed, options.seed).run()
    finally:
        if listener is not None:
            listener.stop()
        if os.path.islink(options.input_tty):
            os.unlink(options.input_tty)
    return 1 if result == "error_exit" else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
