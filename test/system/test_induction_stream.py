"""induction/dump_samples as a client sees it: raw blocks of a running printer, in batches."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from moonraker_rig import SimulatedPrinter
from system.api.test_api_run_printer import connect
from unit.host.test_webhooks import Client

HEADER = ["time", "phase", "count", "raw_mean", "raw_min", "raw_max", "temperature", "latency"]


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    with SimulatedPrinter(tmp_path / "data", "--speed", "5", moonraker=False) as machine:
        yield connect(machine)
        assert machine.stop() == 0
    assert "Traceback" not in machine.log("klippy.log")


def batches(client: Client, key: int) -> Iterator[list[dict[str, Any]]]:
    """Rows of each message of the stream `key`."""
    while True:
        message = client.receive()
        if message.get("key") == key:
            params = message["params"]
            assert params["header"] == HEADER
            yield [dict(zip(HEADER, row, strict=True)) for row in params["data"]]


def test_a_client_sees_every_block_of_the_coil_once(client: Client) -> None:
    client.result("gcode/script", script="M104 S180")
    answer = client.result("induction/dump_samples", heater="nozzle", response_template={"key": 7})
    assert answer == {"header": HEADER}
    rows = [row for batch in itertools.islice(batches(client, 7), 12) for row in batch]
    assert len(rows) > 500  # 1.2 s at 1.6 ms a block, less while the bridge rests
    times = [row["time"] for row in rows]
    assert all(a < b for a, b in itertools.pairwise(times))
    whole = [row for row in rows if row["count"] == 192]
    gaps = [b["time"] - a["time"] for a, b in itertools.pairwise(rows) if a["count"] == b["count"] == 192]
    # 192 periods of 8.33 us from centre to centre, settling of 20 more after a phase step: none is missing
    assert len(whole) > 0.7 * len(rows) and max(gaps) < 2 * 1.6e-3
    assert all(row["raw_min"] <= row["raw_mean"] <= row["raw_max"] for row in rows)
    assert max(row["temperature"] or 0.0 for row in rows) > 60.0  # it heats at up to 180 K/s
    assert client.result("info")["state"] == "ready"


def test_a_stream_of_no_heater_is_refused(client: Client) -> None:
    words = client.error("induction/dump_samples", heater="nozle", response_template={})
    assert "nozle" in words and "nozzle" in words.replace("nozle", "")  # what was wrong, what would be right
