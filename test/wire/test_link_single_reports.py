"""Firmware whose analog inputs speak as before 2025 (one value to a report), for old hosts; known by this one."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from link_rig import LinkSession
from simulation import builds


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LinkSession]:
    options = ["PORT=stm32f334", f"OUT={tmp_path / 'out'}", "CONFIG_SINGLE_ANALOG_REPORTS=y"]
    command = ["make", "-s", "KCONFIG_CONFIG=/dev/null", *options, "firmware"]
    subprocess.run(command, cwd=builds.ROOT, check=True, capture_output=True)
    monkeypatch.setattr(builds, "BUILDS", dict(builds.BUILDS))
    builds.use_image("stm32f334", tmp_path / "out" / "stm32f334")
    monkeypatch.setattr(LinkSession, "BUILD", "stm32f334")
    yield LinkSession(tmp_path)
    builds.make_build.cache_clear()


def test_the_host_reads_its_analog_inputs(session: LinkSession) -> None:
    reports: list[tuple[float, float]] = []
    formats: list[str] = []

    def prepare(printer: Any) -> None:
        adc = printer.lookup_object("pins").setup_pin("adc", "PC5")
        adc.setup_adc_sample(0.001, 8)
        adc.setup_adc_callback(0.1, lambda t, v: reports.append((t, v)))

    def body(printer: Any) -> None:
        mcu = printer.lookup_object("mcu")
        formats.extend(name for name in mcu._script.init_cmds if name.startswith("query_analog_in"))
        session.reactor.pause(session.reactor.monotonic() + 3.0)

    assert session.host(body, prepare)[0] == "ready"
    assert formats and "bytes_per_report" not in formats[0]
    assert len(reports) >= 10 and all(0.0 <= value <= 1.0 for _, value in reports)
