"""A host with nothing but pins and MCUs, connected to real (simulated) firmware in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import greenlet

from mcu_harness import make
from printer import Printer
from reactor import Reactor
from simulation.builds import make_build
from simulation.simport import SimPort
from simulation.simtime import SimTime
from simulation.world import World


class LinkPrinter(Printer):
    """Pins and MCUs only. `prepare` is called when the config has been read, as a module's load_config would be."""

    CORE_FIRST = ("pins", "mcu")
    CORE_LAST = ()
    prepare: Callable[[Any], None] = staticmethod(lambda printer: None)

    def _load_config(self) -> None:
        super()._load_config()
        self.prepare(self)


class LinkSession:
    """A world whose MCUs keep running while hosts come and go: `host` is one run of a host.

    BUILD: which build of the firmware its MCUs run.
    """

    BUILD = "simulator"

    def __init__(self, tmp_path: Path, mcus: int = 1, seed: int = 1, **line: float) -> None:
        make("firmware-sim")
        self.tmp_path = tmp_path
        self.world = World(seed)
        # each MCU drifts differently
        build = make_build(self.BUILD)
        self.clock_hz = build.clock_hz
        self.mcus = [self.world.add_mcu(clock_ppm=80.0 - 130.0 * n, build=build, **line) for n in range(mcus)]
        self.time = SimTime(self.world)
        self.reactor = Reactor(self.time)
        self.printer: Any = None
        self.exit = ""

    def open_port(self, reactor: Reactor, path: str, baud: int) -> SimPort:
        return SimPort(self.world, self.time, self.mcus[int(path.removeprefix("sim"))])

    def config(self) -> str:
        sections = ["[mcu]\nserial: sim0\n"]
        sections += [f"[mcu board{n}]\nserial: sim{n}\n" for n in range(1, len(self.mcus))]
        return "\n".join(sections)

    def host(
        self,
        body: Callable[[Any], None],
        prepare: Callable[[Any], None] = lambda printer: None,
        config: str | None = None,
        even_failed: bool = False,
        **start_args: Any,
    ) -> tuple[str, str]:
        """Start a host, run `body(printer)` once it is ready (or failed, if `even_failed`). Returns state, message."""
        path = self.tmp_path / "printer.cfg"
        path.write_text(self.config() if config is None else config)
        args = {
            "config_file": str(path),
            "open_port": self.open_port,
            "start_reason": "startup",
            **start_args,
        }
        reactor = self.reactor = Reactor(self.time)
        printer = self.printer = LinkPrinter(reactor, args)
        printer.prepare = prepare
        failures: list[BaseException] = []
        outcome: list[tuple[str, str]] = []

        def drive(eventtime: float) -> None:
            try:
                while printer.get_state_message()[1] == "startup":
                    reactor.pause(reactor.monotonic() + 0.05)
                if even_failed or printer.get_state_message()[1] == "ready":
                    body(printer)
            except greenlet.GreenletExit:
                return  # the host ended while still starting up
            except BaseException as e:
                failures.append(e)
            outcome.append(printer.get_state_message()[::-1])
            printer.request_exit("exit")

        reactor.register_callback(drive)
        self.exit = printer.run()
        reactor.finalize()
        self.world.check()
        if failures:
            raise failures[0]
        return outcome[0] if outcome else printer.get_state_message()[::-1]
