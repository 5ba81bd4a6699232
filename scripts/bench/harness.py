"""What all benches share: options, measured processes, the printer beside the bench, tables, limits, figures as JSON.

Imported first: it puts the product, the programs and the rigs on the path, then enters .venv. A bench is a function of
its options and a Report; `main` runs it. Exit status: 0, 1 if a limit is missed, 2 if the bench could not go on.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
for _folder in ("klippy", "scripts", "scripts/bench", "scripts/bench/rigs"):
    if str(ROOT / _folder) not in sys.path:
        sys.path.append(str(ROOT / _folder))

import in_venv  # noqa: E402

SAMPLE_CONFIG = ROOT / "config" / "sim-induction.cfg"
START_TIMEOUT_S = 60.0
END = b"\x03"  # of a message of the API


class BenchError(Exception):
    """The bench cannot go on; text for people."""


class Report:
    """Tables for people, figures for programs, and the limits that were missed."""

    def __init__(self) -> None:
        self.figures: dict[str, Any] = {}
        self.missed: list[str] = []

    def table(
        self, title: str, heads: Sequence[str], rows: Iterable[Sequence[object]], left: int = 1
    ) -> None:
        """The first `left` columns are names. Without heads: name, value, note."""
        from rich.console import Console
        from rich.table import Table

        table = Table(box=None, padding=(0, 1), show_header=any(heads))
        for number, head in enumerate(heads):
            is_text = number < left or (number == 2 and not any(heads))
            table.add_column(head, justify="left" if is_text else "right", no_wrap=True)
        for row in rows:
            table.add_row(*map(str, row))
        if title:
            print(title)
        Console(width=150, highlight=False, markup=False).print(table, "")

    def require(self, holds: bool, text: str) -> None:
        """`text`: what is wrong if it does not hold."""
        if not holds:
            self.missed.append(text)

    def at_most(self, name: str, value: float, limit: float, digits: int = 2) -> None:
        self.require(value <= limit, f"{name} {value:.{digits}f}, at most {limit:.{digits}f}")

    def at_least(self, name: str, value: float, limit: float, digits: int = 2) -> None:
        self.require(value >= limit, f"{name} {value:.{digits}f}, at least {limit:.{digits}f}")


def options(text: str | None, quick: str = "") -> argparse.ArgumentParser:
    """A parser with what all benches know. `text`: the bench's docstring; `quick`: what is left out with --quick."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    return parser


def main(bench: Callable[[argparse.Namespace, Report], None], parser: argparse.ArgumentParser) -> int:
    """Run a bench to its end, say what it missed and write its figures."""
    given, report = parser.parse_args(), Report()
    try:
        bench(given, report)
    except BenchError as e:
        print(f"{Path(sys.argv[0]).stem}: {e}", file=sys.stderr)
        return 2
    for text in report.missed:
        print(f"MISSED: {text}")
    if given.json:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({**report.figures, "missed": report.missed}, default=asdict, indent=1)
        given.json.write_text(text + "\n", encoding="utf-8")
    return 1 if report.missed else 0


# --- processes ---


@dataclass(frozen=True, slots=True)
class Run:
    """A process that has ended well. Memory is its peak resident set in MB (1e6 bytes)."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    output: str
    errors: str


def run(*command: object) -> Run:
    """Run a process to its end and measure it."""
    words = [str(word) for word in command]
    begin_s = time.monotonic()
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True) as child,
    ):
        assert child.stdout is not None
        output = child.stdout.read()
        _, status, used = os.wait4(child.pid, 0)  # not Popen.wait: this also returns what the child used
        child.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.monotonic() - begin_s
        errors.seek(0)
        text = errors.read()
    if child.returncode:
        raise BenchError(f"{shlex.join(words)} ended with status {child.returncode}:\n{text[-2000:]}")
    return Run(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6, output, text)


def program(path: str, *words: object) -> Run:
    """One of the project's own programs."""
    return run(sys.executable, ROOT / path, *words)


def cpu_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int | str = "self") -> float:
    """Memory of a process now."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


# --- a printer in real time ---


class Client:
    """A connection to the API of a host."""

    def __init__(self, path: Path, timeout_s: float = 60.0) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(timeout_s)
        self.sock.connect(str(path))
        self._rest = b""

    def send(self, method: str, **params: Any) -> None:
        self.sock.sendall(json.dumps({"id": 1, "method": method, "params": params}).encode() + END)

    def receive(self) -> dict[str, Any]:
        """The next message."""
        while END not in self._rest:
            data = self.sock.recv(262144)
            if not data:
                raise BenchError("the host closed the connection")
            self._rest += data
        message, _, self._rest = self._rest.partition(END)
        return dict(json.loads(message))

    def ask(self, method: str, **params: Any) -> Any:
        """Result of a request; messages that come in between are dropped."""
        self.send(method, **params)
        while (answer := self.receive()).get("id") != 1:
            pass
        if "error" in answer:
            raise BenchError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def status(self, **objects: Sequence[str] | None) -> dict[str, Any]:
        """Fields of objects."""
        return dict(self.ask("objects/query", objects=objects)["status"])


def connect(path: Path) -> Client:
    """A client of a printer that is ready."""
    deadline = time.monotonic() + START_TIMEOUT_S
    state, text = "startup", "no answer"
    while state == "startup" and time.monotonic() < deadline:
        with contextlib.suppress(OSError, BenchError):
            client = Client(path)
            info = client.ask("info")
            if info["state"] == "ready":
                return client
            state, text = info["state"], info["state_message"]
            client.sock.close()
        time.sleep(0.2)
    raise BenchError(f"the printer did not start: {text}")


@contextlib.contextmanager
def printer(folder: Path, config: str) -> Iterator[tuple[Client, int]]:
    """(client, process id) of a host that is ready; its machine is another process, both in real time."""
    path = folder / "printer.cfg"
    path.write_text(f"{config}\n[mcu]\nserial: {folder}/mcu\n", encoding="utf-8")
    machine = (ROOT / "scripts" / "run_simulator.py", path, "--pty", folder / "mcu")
    host = (
        ROOT / "klippy" / "klippy.py",
        path,
        "-a",
        folder / "sock",
        "-I",
        folder / "tty",
        "-l",
        folder / "log",
    )
    running = []
    try:
        for words in (machine, host):
            command = [sys.executable, *map(str, words)]
            running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
        yield connect(folder / "sock"), running[1].pid
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait()
