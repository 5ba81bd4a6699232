#!/usr/bin/env python3
"""Load on the API server: many clients that subscribe to everything while the simulated printer prints in real time.

    scripts/bench/bench_api.py                         50 clients, 10 minutes (make bench-api; QUICK=1: one minute)

First how many queries a second are answered on an idle printer: to one client that asks again when it has its answer,
and with several requests on their way. Then a print without clients for a while: what processor time host and simulated
machine take by themselves. Then the clients come, and what the host takes more is the API's share. Exit status 1 if the
host shut down, a client was dropped, memory grew or a figure misses its limit.
"""

from __future__ import annotations

import harness
from harness import END, ROOT, BenchError

import argparse
import json
import selectors
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

BASE_S = 60.0  # at most this long without clients
SETTLE_S = 10.0  # clients are there, nothing is counted yet
QUERY_S = 3.0
IN_FLIGHT = 8
SAMPLE_S = 5.0
QUICK_S = 60.0
QUERY_RATE_MIN = 5000.0  # a second
API_SHARE_MAX = 0.10  # of one core
GROWTH_MAX_MB = 4.0  # from the first to the last third: allocator noise is below 1 MB
MESSAGES_MIN = 3.5  # a second, of each client


@dataclass(slots=True)
class Figures:
    """What came out."""

    clients: int
    seconds: float
    round_trips_per_s: float = 0.0  # of one client that asks when it has its answer
    queries_per_s: float = 0.0  # with IN_FLIGHT requests on their way
    host_alone: float = 0.0  # processor time a second, host and simulated machine
    host_with_clients: float = 0.0
    api_share: float = 0.0
    messages_per_client_s: float = 0.0
    kib_per_client_s: float = 0.0
    dropped: int = 0
    memory_mb: list[float] = field(default_factory=list)
    growth_mb: float = 0.0
    lost_s: float = 0.0
    print_state: str = ""


class Subscriber(harness.Client):
    """A client that counts what it is sent."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.messages = self.bytes = 0

    def take(self) -> bool:
        """Read what is there; False when the host has closed."""
        data = self.sock.recv(262144)
        self.bytes += len(data)
        self.messages += data.count(END)
        return bool(data)


def print_file(minutes: float) -> str:
    """G-code of a print that long: lines of 0.8 mm at 60 mm/s, 75 moves a second, 4.8 mm3/s."""
    lines = ["M104 S220", "G28", "G90", "M83", "G1 X60 Y60 Z0.3 F6000", "M109 S220", "M117 printing"]
    steps = [(0.8, 0.0)] * 50 + [(0.0, 0.8)] * 50 + [(-0.8, 0.0)] * 50 + [(0.0, -0.8)] * 50
    x, y = 60.0, 60.0
    for number in range(int(minutes * 60 * 75)):
        dx, dy = steps[number % len(steps)]
        x, y = x + dx, y + dy
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E0.0266 F3600")
    return "\n".join(lines) + "\n"


def query_rate(client: harness.Client, in_flight: int) -> float:
    """Answers to objects/query a second, with so many requests on their way at any time."""
    request = {"objects": {"toolhead": None, "extruder": ["temperature", "target"]}}
    message = json.dumps({"id": 2, "method": "objects/query", "params": request}).encode() + END
    begin = time.monotonic()
    count = 0
    client.sock.sendall(message * in_flight)
    while time.monotonic() - begin < QUERY_S:
        data = client.sock.recv(262144)
        if not data:
            raise BenchError("the host closed the connection during objects/query")
        answers = data.count(END)
        count += answers
        client.sock.sendall(message * answers)
    elapsed_s = time.monotonic() - begin
    client.ask("info")  # takes in the answers still on their way
    return count / elapsed_s


def watch(clients: list[Subscriber], pid: int, seconds: float, figures: Figures) -> None:
    """Read for so long whatever the clients get; memory samples go to the figures."""
    selector = selectors.DefaultSelector()
    for client in clients:
        client.sock.setblocking(False)
        selector.register(client.sock, selectors.EVENT_READ, client)
    end = time.monotonic() + seconds
    next_sample = 0.0
    while (now := time.monotonic()) < end:
        if now >= next_sample:
            next_sample = now + SAMPLE_S
            figures.memory_mb.append(harness.resident_mb(pid))
        for key, _ in selector.select(min(0.5, end - now)):
            if not key.data.take():
                selector.unregister(key.fileobj)
                figures.dropped += 1
    selector.close()


def subscribe(path: Path, count: int) -> list[Subscriber]:
    """Clients that want everything: status of all objects, and the console."""
    clients = []
    for _ in range(count):
        client = Subscriber(path)
        names = client.ask("objects/list")["objects"]
        client.ask("gcode/subscribe_output", response_template={"method": "gcode"})
        client.ask(
            "objects/subscribe",
            objects=dict.fromkeys(names),
            response_template={"method": "process_status_update"},
        )
        clients.append(client)
    return clients


def wait_printing(client: harness.Client) -> None:
    """Until filament moves."""
    deadline = time.monotonic() + harness.START_TIMEOUT_S
    while time.monotonic() < deadline:
        stats = client.status(print_stats=None)["print_stats"]
        if stats["state"] == "printing" and stats["filament_used"] > 1.0:
            return
        time.sleep(0.2)
    raise BenchError("the print did not start")


def run(folder: Path, options: argparse.Namespace) -> Figures:
    """All of it, with the data folder of a printer."""
    figures = Figures(options.clients, options.seconds)
    path = folder / "comms" / "klippy.sock"
    asker = harness.connect(path)
    pid = int(asker.ask("info")["process_id"])
    figures.round_trips_per_s = query_rate(asker, 1)
    figures.queries_per_s = query_rate(asker, IN_FLIGHT)
    base_s = min(BASE_S, options.seconds)
    name = "load.gcode"
    (folder / "gcodes" / name).write_text(print_file((options.seconds + base_s + SETTLE_S) / 60.0 + 1.0))
    asker.ask("gcode/script", script=f"SDCARD_PRINT_FILE FILENAME={name}")
    wait_printing(asker)

    before = harness.cpu_s(pid)
    time.sleep(base_s)
    figures.host_alone = (harness.cpu_s(pid) - before) / base_s
    clients = subscribe(path, options.clients)
    watch(clients, pid, SETTLE_S, figures)
    figures.memory_mb.clear()
    for client in clients:
        client.messages = client.bytes = 0
    before = harness.cpu_s(pid)
    watch(clients, pid, options.seconds, figures)
    figures.host_with_clients = (harness.cpu_s(pid) - before) / options.seconds
    figures.api_share = figures.host_with_clients - figures.host_alone
    per_client_s = options.clients * options.seconds
    figures.messages_per_client_s = sum(client.messages for client in clients) / per_client_s
    figures.kib_per_client_s = sum(client.bytes for client in clients) / 1024 / per_client_s
    third = max(1, len(figures.memory_mb) // 3)
    figures.growth_mb = max(figures.memory_mb[-third:]) - max(figures.memory_mb[:third])
    figures.print_state = asker.status(print_stats=["state"])["print_stats"]["state"]
    log = (folder / "logs" / "klippy.log").read_text(errors="replace")
    for line in log.splitlines():
        if "behind the wall clock" in line:
            figures.lost_s = float(line.partition("(")[2].split()[0])
    return figures


def judge(figures: Figures, log: str, report: harness.Report) -> None:
    """The limits."""
    report.require(figures.print_state == "printing", f"the print is '{figures.print_state}'")
    for text in ("imer too close", "Traceback", "dropped"):
        report.require(text not in log, f"the log says '{text}'")
    report.require(not figures.dropped, f"{figures.dropped} clients were dropped")
    report.at_least("messages a second to a client", figures.messages_per_client_s, MESSAGES_MIN)
    report.at_least("queries a second", figures.queries_per_s, QUERY_RATE_MIN, 0)
    report.at_most("share of a core of the API", figures.api_share, API_SHARE_MAX, 3)
    report.at_most("growth of memory, MB,", figures.growth_mb, GROWTH_MAX_MB)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    if options.quick:
        options.seconds = min(options.seconds, QUICK_S)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "data"
        command = [sys.executable, str(ROOT / "scripts" / "run_printer.py"), "--data", str(folder)]
        machine = subprocess.Popen([*command, "--no-moonraker"], stdout=subprocess.DEVNULL)
        try:
            figures = run(folder, options)
            log = (folder / "logs" / "klippy.log").read_text(errors="replace")
        finally:
            machine.terminate()
            machine.wait()
    judge(figures, log, report)
    report.figures["api"] = figures
    rows = (
        ("objects/query, one after the other", f"{figures.round_trips_per_s:.0f}", "a second"),
        (f"objects/query, {IN_FLIGHT} in flight", f"{figures.queries_per_s:.0f}", "a second"),
        ("host and machine by themselves", f"{100 * figures.host_alone:.1f}", "% of a core"),
        (
            f"with {figures.clients} clients for {figures.seconds:.0f} s",
            f"{100 * figures.host_with_clients:.1f}",
            "% of a core",
        ),
        ("share of the API", f"{100 * figures.api_share:.1f}", "% of a core"),
        ("sent to each client", f"{figures.messages_per_client_s:.2f}", "messages a second"),
        ("", f"{figures.kib_per_client_s:.1f}", "KiB a second"),
        ("clients dropped", figures.dropped, ""),
        ("memory", f"{max(figures.memory_mb):.1f}", "MB"),
        ("growth of memory", f"{figures.growth_mb:.2f}", "MB"),
        ("time given up by the simulation", f"{figures.lost_s:.2f}", "s"),
    )
    report.table("", ("", "", ""), rows)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "one minute")
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=600.0, help="with the clients there (default 600)")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
