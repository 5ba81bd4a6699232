"""A printer without MCU and motion on virtual time, for tests of the host's base modules."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from printer import Printer
from reactor import FdPoll, Reactor


class VirtualTime:
    """Time that jumps to the next timer; it only looks at descriptors, it never waits for them."""

    runs_by_itself = False

    def __init__(self, start_s: float = 100.0) -> None:
        self.now = start_s

    def monotonic(self) -> float:
        return self.now

    def wait(self, until: float, poll: FdPoll) -> None:
        if not poll.poll(0.0) and until < Reactor.NEVER:
            self.now = max(self.now, until)


class BarePrinter(Printer):
    """Gcode, webhooks, pins and whatever the config names; no MCU, no toolhead."""

    CORE_FIRST = ("pins",)
    CORE_LAST = ()


class Session:
    """One run of a printer; `lines` collects the messages to the user."""

    def __init__(self, tmp_path: Path, config: str, time_source: Any = None, **start_args: Any) -> None:
        self.config_path = tmp_path / "printer.cfg"
        self.config_path.write_text(config)
        self.reactor = Reactor(time_source or VirtualTime())
        self.printer = BarePrinter(self.reactor, {"config_file": str(self.config_path), **start_args})
        self.gcode = self.printer.lookup_object("gcode")
        self.lines: list[str] = []
        self.gcode.register_output_handler(self.lines.append)
        self.result = ""

    def run(self, body: Callable[[Session], None]) -> Session:
        """Start the printer, run `body` in a greenlet of its reactor once started, then end."""
        failure: list[BaseException] = []

        def drive(eventtime: float) -> None:
            while self.printer.get_state_message()[1] == "startup":
                self.reactor.pause(self.reactor.monotonic() + 0.01)
            try:
                body(self)
            except BaseException as e:
                failure.append(e)
            self.printer.request_exit("exit")

        self.reactor.register_callback(drive)
        self.result = self.printer.run()
        self.reactor.finalize()
        if failure:
            raise failure[0]
        return self

    def sleep(self, duration_s: float) -> None:
        self.reactor.pause(self.reactor.monotonic() + duration_s)

    def status(self, name: str) -> dict[str, Any]:
        status: dict[str, Any] = self.printer.lookup_object(name).get_status(self.reactor.monotonic())
        return status

    @property
    def state(self) -> tuple[str, str]:
        return self.printer.get_state_message()


def start_error(tmp_path: Path, config: str) -> str:
    """The reason why a printer with this config does not start."""
    texts: list[str] = []

    def body(session: Session) -> None:
        message, state = session.state
        assert state == "error", f"the config was accepted ({state})"
        texts.append(message)

    Session(tmp_path, config).run(body)
    return texts[0]
