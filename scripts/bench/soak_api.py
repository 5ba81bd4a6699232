#!/usr/bin/env python3
"""Does a client that misbehaves cost a print? One misdeed a simulated second (`make soak-api`; HOURS=24), or each of
them as often as it is answered for a simulated minute (EACH=60).

The print runs in scripts/simulate.py with --api, in a process of its own. Time stands while the host computes, so
this shows what is refused, what stays in memory and what stops a printer; how long the host is held up in real time is
measured by the tests of the API and of the macros.
"""

from __future__ import annotations

import harness

import argparse
import csv
import functools
import itertools
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from soak_print import part

SETTLED_S = 240.0  # bed and nozzle are at their targets
NEAR_C = 1.0
GROWTH_MAX_MB = 40.0  # after the first SETTLED_S and two rounds of everything
TARGET_C = 210.0
CONFIG = """[include {base}]
[save_variables]
filename: {folder}/variables.cfg
[respond]
[pause_resume]
[gcode_macro LOOP]
gcode:
    {{% for i in range(99999) %}}{{% for j in range(99999) %}}{{% endfor %}}{{% endfor %}}
[gcode_macro POWER]
gcode:
    M117 {{2**(2**30)}}
[gcode_macro VALUE]
variable_x: 0
gcode:
"""
SCRIPTS = (
    ("LOOP", "steps of loops"),
    ("POWER", "4096 bits"),
    ("SDCARD_PRINT_FILE FILENAME=missing.gcode", "SD busy"),
    ("M20", ""),
    ("SET_VELOCITY_LIMIT ACCEL=1e-300", "ACCEL must"),
    ("SET_PRESSURE_ADVANCE ADVANCE=1e9", "ADVANCE must"),
    ("SET_GCODE_VARIABLE MACRO=VALUE VARIABLE=x VALUE=1e999", "Unable to parse"),
    ("SAVE_VARIABLE VARIABLE=a VALUE=1e999", "cannot be saved"),
    ("SAVE_VARIABLE VARIABLE=a VALUE=1", ""),
    ("INDUCTION_DUMP FILE=../printer.cfg", "is not in"),
    ("INDUCTION_DUMP FILE=/dev/full", "is not in"),
    ("M220 S99999999", "S must"),
    ("G1 X99999", "ove out of range"),
    ("M104 Sabc", "S needs a number: 'M104 Sabc'"),
    ("NO_SUCH_COMMAND", ""),
)


class Client:
    """A connection of our own; what it is answered is checked."""

    def __init__(self, path: Path) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(60.0)
        self.sock.connect(str(path))
        self._buffer = b""

    def send(self, method: str, **params: Any) -> None:
        self.sock.sendall(json.dumps({"id": 1, "method": method, "params": params}).encode() + harness.END)

    def answer(self) -> dict[str, Any]:
        while True:
            while harness.END not in self._buffer:
                data = self.sock.recv(1 << 16)
                if not data:
                    raise ConnectionError("the host closed the connection")
                self._buffer += data
            message, _, self._buffer = self._buffer.partition(harness.END)
            content: dict[str, Any] = json.loads(message)
            if "id" in content:
                return content

    def request(self, method: str, **params: Any) -> dict[str, Any]:
        self.send(method, **params)
        return self.answer()

    def now_s(self) -> float:
        return float(self.request("objects/query", objects={})["result"]["eventtime"])


# Misdeeds. Each raises AssertionError if it was not answered as it should be.


def flood(path: Path) -> None:
    client = Client(path)
    for _ in range(100):
        client.send("objects/query", objects={"configfile": None})
    assert all("result" in client.answer() for _ in range(100))


def subscribe(path: Path) -> None:
    client = Client(path)
    for _ in range(200):
        client.send("induction/dump_samples", heater="nozzle", response_template={"m": 1})
        client.send("motion_report/dump_trapq", name="toolhead", response_template={"m": 1})
    assert all("result" in client.answer() for _ in range(400))


def long_request(path: Path) -> None:
    client = Client(path)
    client.sock.sendall(b'{"id": 1, "method": "' + b"x" * 1_000_000 + b'"}' + harness.END)
    assert "longer than" in client.answer()["error"]["message"]


def nested(path: Path) -> None:
    client = Client(path)
    client.sock.sendall(b"[" * 100_000 + harness.END)  # no JSON: ignored
    assert "result" in client.request("info")


def many_clients(path: Path) -> None:
    clients = []
    for _ in range(60):
        try:
            clients.append(Client(path))
        except BlockingIOError:  # the host has not yet taken those before
            time.sleep(0.01)
    for client in clients:
        client.sock.close()


def half_a_request(path: Path) -> None:
    Client(path).sock.sendall(b'{"id": 1, "meth')


def deaf(path: Path) -> None:
    client = Client(path)
    for _ in range(50):
        client.send("gcode/help")  # and never reads


def run_script(text: str, words: str, path: Path) -> None:
    answer = Client(path).request("gcode/script", script=text)
    message = answer.get("error", {}).get("message", "")
    assert (words in message) and bool(message) == bool(words), f"{text}: {answer}"


def misdeeds() -> list[Callable[[Path], None]]:
    scripts = [functools.partial(run_script, text, words) for text, words in SCRIPTS]
    return [flood, subscribe, long_request, nested, many_clients, half_a_request, deaf, *scripts]


# The run


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def misbehave(
    process: subprocess.Popen[bytes], path: Path, each_s: float = 0.0
) -> Iterator[tuple[float, float]]:
    """One misdeed a simulated second until the run ends, or each without a rest for each_s; yields simulated time and
    the memory of the run, MB."""
    end = time.monotonic() + harness.START_TIMEOUT_S
    watch = None
    while watch is None and process.poll() is None and time.monotonic() < end:
        try:
            watch = Client(path)
        except OSError:  # not yet there, or not yet listening
            time.sleep(0.05)
    if watch is None:
        raise ConnectionError("nobody listens")
    while "result" not in watch.request("objects/query", objects={"print_stats": None}):
        time.sleep(0.05)
    start_s = next_s = watch.now_s()
    if each_s:  # beside the print itself
        while watch.now_s() - start_s < SETTLED_S:
            time.sleep(0.002)
    for do in itertools.cycle(misdeeds()):
        while watch.now_s() < next_s:
            time.sleep(0.002)
        next_s = watch.now_s() + (each_s or 1.0)
        do(path)
        yield watch.now_s() - start_s, resident_mb(process.pid)
        while each_s and watch.now_s() < next_s:
            do(path)
            yield watch.now_s() - start_s, resident_mb(process.pid)


def soak(
    seconds: float, folder: Path, seed: int = 1, each_s: float = 0.0
) -> tuple[int, list[tuple[float, float]], str]:
    """(misdeeds, memory over time, what went wrong)."""
    gcodes, config, api, trace = (
        folder / "gcodes",
        folder / "printer.cfg",
        folder / "api",
        folder / "trace.csv",
    )
    gcodes.mkdir()
    (gcodes / "part.gcode").write_text(
        "".join(part((seconds + SETTLED_S) / 3600.0))
        .replace("M104 S211", "M104 S210")
        .replace("M104 S212", "M104 S210")
    )
    os.mkfifo(gcodes / "pipe.gcode")
    config.write_text(CONFIG.format(base=harness.SAMPLE_CONFIG, folder=folder))
    command = [
        sys.executable,
        str(harness.ROOT / "scripts/simulate.py"),
        str(config),
        str(gcodes / "part.gcode"),
    ]
    command += ["--api", str(api), "--until", str(seconds), "--quiet", "--trace", str(trace)]
    command += ["--log", str(folder / "host.log"), "--set", "simulator.trace_rate=1"]
    command += ["--seed", str(seed)]
    rows: list[tuple[float, float]] = []
    wrong = ""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        try:
            rows.extend(misbehave(process, api, each_s))
        except (ConnectionError, TimeoutError, OSError):
            if process.poll() is None and not rows:
                wrong = "the host does not answer"
                process.kill()
        except AssertionError as e:
            wrong = f"a misdeed was not answered with an error: {e}"
            process.kill()
        _, errors = process.communicate()
    if not wrong and process.returncode:
        wrong = f"exit status {process.returncode}: {errors.decode().strip()}"
    return len(rows), rows, wrong or off_target(trace)


def off_target(trace: Path) -> str:
    """Where the nozzle was away from its target once it had settled."""
    with trace.open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if float(row["t_s"]) > SETTLED_S]
    if not rows:
        return "the run ended before the nozzle had settled"
    worst = max(rows, key=lambda row: abs(float(row["true_c"]) - float(row["target_c"])))
    away_c = abs(float(worst["true_c"]) - float(worst["target_c"]))
    return "" if away_c < NEAR_C else f"{away_c:.1f} C off its target at {worst['t_s']} s"


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated (default %(default)g)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--each", type=float, default=0.0, metavar="SECONDS", help="one round, each for so long"
    )
    options = parser.parse_args(argv)
    if options.each:
        options.hours = (SETTLED_S + options.each * (len(misdeeds()) + 0.5)) / 3600.0
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        count, rows, wrong = soak(3600.0 * options.hours, Path(folder), options.seed, options.each)
    steady = [mb for now_s, mb in rows if now_s > SETTLED_S] or [mb for _, mb in rows] or [0.0]
    grown_mb = max(steady) - steady[0]
    print(f"{count} misdeeds in {options.hours:g} simulated hours ({time.monotonic() - begin:.0f} s)")
    print(f"memory {steady[0]:.0f} MB, grown by {grown_mb:.1f} MB (limit {GROWTH_MAX_MB:g})")
    print(f"failed: {wrong}" if wrong else "no trip, every misdeed answered")
    return int(bool(wrong) or grown_mb > GROWTH_MAX_MB)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
