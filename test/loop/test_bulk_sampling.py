"""Bulk sampling at 3200 Hz on a board of its own loses nothing: messages have every number once, samples fill them.

BULK_SECONDS=3600 in the environment makes it an hour, in half an hour or so.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from extras.accelerometer import sensor
from probe_rig import CONFIG, Option, run
from simulation.runner import PRINTED

RESONANCE = CONFIG.with_name("sim-resonance.cfg")
SECONDS = float(os.environ.get("BULK_SECONDS", "0"))
BOARDS: dict[
    str, tuple[float, list[Option]]
] = {  # s, options: the firmware for the simulator; an image in its emulator
    "simulated": (60.0, []),
    "emulated": (
        20.0,
        [
            ("simulator mcu toolboard", "build", "stm32f334"),
            ("adxl345", "cs_pin", "toolboard:PA4"),
            ("adxl345", "spi_bus", "spi1"),
        ],
    ),
}


@pytest.mark.parametrize("board", BOARDS)
def test_sampling_at_3200_hz_has_no_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, board: str) -> None:
    usual_s, options = BOARDS[board]
    seconds = SECONDS or usual_s
    batches: list[dict[str, Any]] = []
    samples = 0

    def take(first: int, data: bytes) -> None:
        nonlocal samples
        assert first == samples and len(data) % 50 == 0
        samples += len(data) // 5

    def listen(self: sensor.Accelerometer) -> None:
        reactor = self.printer.get_reactor()
        end_s = reactor.monotonic() + seconds

        def client(batch: dict[str, Any]) -> bool:
            batches.append(batch)
            return reactor.monotonic() < end_s

        reactor.register_callback(lambda _: self.add_raw_client(take, client, 0.5))

    monkeypatch.setattr(sensor.Accelerometer, "_check_line", listen)
    result = run(tmp_path, f"G4 P{1000.0 * (seconds + 2.0):.0f}\n", *options, config=RESONANCE)
    assert result.status == PRINTED, result.reason
    # the simulated chip's own clock is 1 % fast
    assert samples == pytest.approx(1.01 * 3200.0 * seconds, rel=0.01)
    assert sum(batch["overflows"] + batch["errors"] for batch in batches) == 0
    assert all(batch["data"] == [] for batch in batches), "nobody asked for rows"
