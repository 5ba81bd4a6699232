#!/usr/bin/env python3
"""Load on the API server: many clients that subscribe to everything while the simulated printer prints in real time.

    scripts/bench/bench_api.py                         50 clients, 10 minutes (make bench-api; QUICK=1: one minute)

First how many queries a second are answered on an idle printer: to one client that asks again when it has its answer,
and with several requests on their way. Then a print without clients for a while: what processor time host and simulated
machine take by themselves. Then the clients come, and what the host takes more is the API's share. Exit status 1 if the
host shut down, a client was dropped, memory grew or a figure misses its limit.
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import json
import os
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

END = b"\x03"
START_TIMEOUT_S = 60.0
BASE_S = 60.0  # at most this long without clients
SETTLE_S = 10.0  # clients are there, nothing is counted yet
QUERY_S = 3.0
IN_FLIGHT = 8
SAMPLE_S = 5.0
QUERY_RATE_MIN = 5000.0  # a second
API_SHARE_MAX = 0.10  # of one core
GROWTH_MAX_KIB = 4096  # from the first to the last third: allocator noise is below 1 MiB


class BenchError(Exception):
    """The bench cannot go on; text for people."""


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
    memory_kib: list[int] = field(default_factory=list)
    growth_kib: int = 0
    lost_s: float = 0.0
    print_state: str = ""


class Client:
    """One connection."""

    def __init__(self, path: Path) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(10.0)
        self.sock.connect(str(path))
        self.rest = b""
        self.messages = self.bytes = 0

    def ask(self, method: str, **params: Any) -> Any:
        """Result of a request; messages that come in between are dropped."""
        self.sock.sendall(json.dumps({"id": 1, "method": method, "params": params}).encode() + END)
        while True:
            while END not in self.rest:
                data = self.sock.recv(262144)
                if not data:
                    raise BenchError(f"the host closed the connection during {method}")
                self.rest += data
            message, self.rest = self.rest.split(END, 1)
            answer = json.loads(message)
            if answer.get("id") == 1:
                if "error" in answer:
                    raise BenchError(f"{method}: {answer['error']['message']}")
                return answer["result"]

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


def cpu_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_kib(pid: int) -> int:
    """Resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def connect(path: Path) -> Client:
    """A client of a printer that is ready."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        try:
            client = Client(path)
            info = client.ask("info")
        except (OSError, BenchError):
            time.sleep(0.2)
            continue
        if info["state"] == "ready":
            return client
        if info["state"] != "startup":
            raise BenchError(f"the printer did not start: {info['state_message']}")
        client.sock.close()
        time.sleep(0.2)
    raise BenchError("the printer did not start in time")


def query_rate(client: Client, in_flight: int) -> float:
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


def watch(clients: list[Client], pid: int, seconds: float, figures: Figures) -> None:
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
            figures.memory_kib.append(memory_kib(pid))
        for key, _ in selector.select(min(0.5, end - now)):
            if not key.data.take():
                selector.unregister(key.fileobj)
                figures.dropped += 1
    selector.close()


def subscribe(path: Path, count: int) -> list[Client]:
    """Clients that want everything: status of all objects, and the console."""
    clients = []
    for _ in range(count):
        client = Client(path)
        names = client.ask("objects/list")["objects"]
        client.ask("gcode/subscribe_output", response_template={"method": "gcode"})
        client.ask(
            "objects/subscribe",
            objects=dict.fromkeys(names),
            response_template={"method": "process_status_update"},
        )
        clients.append(client)
    return clients


def wait_printing(client: Client) -> None:
    """Until filament moves."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        stats = client.ask("objects/query", objects={"print_stats": None})["status"]["print_stats"]
        if stats["state"] == "printing" and stats["filament_used"] > 1.0:
            return
        time.sleep(0.2)
    raise BenchError("the print did not start")


def run(folder: Path, options: argparse.Namespace) -> Figures:
    """All of it, with the data folder of a printer."""
    figures = Figures(options.clients, options.seconds)
    path = folder / "comms" / "klippy.sock"
    asker = connect(path)
    pid = int(asker.ask("info")["process_id"])
    figures.round_trips_per_s = query_rate(asker, 1)
    figures.queries_per_s = query_rate(asker, IN_FLIGHT)
    base_s = min(BASE_S, options.seconds)
    name = "load.gcode"
    (folder / "gcodes" / name).write_text(print_file((options.seconds + base_s + SETTLE_S) / 60.0 + 1.0))
    asker.ask("gcode/script", script=f"SDCARD_PRINT_FILE FILENAME={name}")
    wait_printing(asker)

    before = cpu_s(pid)
    time.sleep(base_s)
    figures.host_alone = (cpu_s(pid) - before) / base_s
    clients = subscribe(path, options.clients)
    watch(clients, pid, SETTLE_S, figures)
    figures.memory_kib.clear()
    for client in clients:
        client.messages = client.bytes = 0
    before = cpu_s(pid)
    watch(clients, pid, options.seconds, figures)
    figures.host_with_clients = (cpu_s(pid) - before) / options.seconds
    figures.api_share = figures.host_with_clients - figures.host_alone
    per_client_s = options.clients * options.seconds
    figures.messages_per_client_s = sum(client.messages for client in clients) / per_client_s
    figures.kib_per_client_s = sum(client.bytes for client in clients) / 1024 / per_client_s
    third = max(1, len(figures.memory_kib) // 3)
    figures.growth_kib = max(figures.memory_kib[-third:]) - max(figures.memory_kib[:third])
    figures.print_state = asker.ask("objects/query", objects={"print_stats": ["state"]})["status"][
        "print_stats"
    ]["state"]
    log = (folder / "logs" / "klippy.log").read_text(errors="replace")
    for line in log.splitlines():
        if "behind the wall clock" in line:
            figures.lost_s = float(line.partition("(")[2].split()[0])
    return figures


def verdict(figures: Figures, log: str) -> list[str]:
    """What does not hold, in words."""
    missed = []
    if figures.print_state != "printing":
        missed.append(f"the print is '{figures.print_state}'")
    missed += [f"the log says '{text}'" for text in ("imer too close", "Traceback", "dropped") if text in log]
    if figures.dropped:
        missed.append(f"{figures.dropped} clients were dropped")
    if figures.messages_per_client_s < 3.5:
        missed.append(f"a client got {figures.messages_per_client_s:.2f} messages a second only")
    if figures.queries_per_s < QUERY_RATE_MIN:
        missed.append(f"{figures.queries_per_s:.0f} queries a second < {QUERY_RATE_MIN:.0f}")
    if figures.api_share > API_SHARE_MAX:
        missed.append(f"the API takes {100 * figures.api_share:.1f} % of a core")
    if figures.growth_kib > GROWTH_MAX_KIB:
        missed.append(f"memory grew by {figures.growth_kib} KiB")
    return missed


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=600.0, help="with the clients there (default 600)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the figures for programs")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "data"
        command = [sys.executable, str(ROOT / "scripts" / "run_printer.py"), "--data", str(folder)]
        machine = subprocess.Popen([*command, "--no-moonraker"], stdout=subprocess.DEVNULL)
        try:
            figures = run(folder, options)
            log = (folder / "logs" / "klippy.log").read_text(errors="replace")
        except BenchError as e:
            print(f"bench_api: {e}", file=sys.stderr)
            return 2
        finally:
            machine.terminate()
            machine.wait()
    report(figures)
    missed = verdict(figures, log)
    for text in missed:
        print(f"MISSED: {text}")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(asdict(figures), indent=2) + "\n", encoding="utf-8")
    return 1 if missed else 0


def report(figures: Figures) -> None:
    """The figures for people."""
    print(f"objects/query, one after the other {figures.round_trips_per_s:8.0f} a second")
    print(f"objects/query, {IN_FLIGHT} in flight         {figures.queries_per_s:8.0f} a second")
    print(f"host and machine by themselves     {100 * figures.host_alone:8.1f} % of a core")
    print(
        f"with {figures.clients} clients for {figures.seconds:.0f} s {100 * figures.host_with_clients:16.1f} %"
    )
    print(f"the API's share                    {100 * figures.api_share:8.1f} %")
    print(
        f"each client gets                   {figures.messages_per_client_s:8.2f} messages, "
        f"{figures.kib_per_client_s:.1f} KiB a second; {figures.dropped} dropped"
    )
    print(
        f"memory                             {max(figures.memory_kib) / 1024:8.1f} MiB, grown {figures.growth_kib} KiB"
    )
    print(f"time given up by the simulation    {figures.lost_s:8.2f} s")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
