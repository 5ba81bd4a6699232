"""scripts/why.py names the cause of a stop, and every cause it can name is on the page."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import bench_why
import why

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = (
    "M112 in the file",
    "host stall, swapping",
    "host stall 1.2 s",
    "line damage 20 %",
    "line cut",
    "killed in the middle",
)


@pytest.fixture(scope="module")
def named() -> dict[str, str]:
    """The cause named for one log of each of SAMPLE."""
    numbers = [number for number, case in enumerate(bench_why.CASES) if case.name in SAMPLE]
    with bench_why.multiprocessing.get_context("fork").Pool(2, maxtasksperchild=1) as pool:
        found = pool.map(bench_why.one, [(number, 1001) for number in numbers])
    return {bench_why.CASES[number].name: key for number, key in found}


@pytest.mark.parametrize("name", SAMPLE)
def test_an_injected_cause_is_named(named: dict[str, str], name: str) -> None:
    assert named[name] == next(case.cause for case in bench_why.CASES if case.name == name)


def test_the_page_has_each_cause_with_what_to_check_and_no_other() -> None:
    keys = {key for key, _, _ in why.RULES} | {"Host ended"}
    assert set(why.causes()) == keys
    headings = re.findall(r"^## (.+)$", (ROOT / why.PAGE).read_text(), re.MULTILINE)
    assert set(headings) == keys and len(headings) == len(keys)


def test_at_least_thirty_causes_are_injected_and_the_page_shows_them() -> None:
    table = (ROOT / "docs/reference/Why_Matrix.md").read_text()
    rows = re.findall(r"^\| (.+) \| (.+) \| (\d+) of (\d+) \|", table, re.MULTILINE)
    assert {(name, cause) for name, cause, _, _ in rows} == {(c.name, c.cause) for c in bench_why.CASES}
    assert len(rows) >= 30
    right, total = (sum(int(row[i]) for row in rows) for i in (2, 3))
    assert right >= bench_why.RIGHT_MIN * total
    assert f"Of {total} logs {100 * right / total:.1f} % are named right" in table


def test_the_program_prints_cause_evidence_and_page(tmp_path: Path) -> None:
    log = tmp_path / "klippy.log"
    stats = "Stats {:.1f}: mcu: bytes_read={} bytes_invalid={} bytes_retransmit=9 sysload=1.0 late=0.001"
    log.write_text(
        "Starting Ferrite\nStarting SD card print (position 0)\n"
        + "".join(stats.format(t, 1000 * t, 0 if t < 20 else 200) + "\n" for t in range(1, 22))
        + "error: Transition to shutdown state: MCU 'mcu' shutdown: Timer too close\nhelp\n"
    )
    program = [sys.executable, str(ROOT / "scripts" / "why.py")]
    answer = subprocess.run([*program, str(log)], capture_output=True, text=True, timeout=30, check=False)
    lines = answer.stdout.splitlines()
    assert lines[0].startswith("Damaged line: Bytes on the line") and "200 of" in lines[1]
    assert lines[2] == "The printer said: MCU 'mcu' shutdown: Timer too close"
    assert lines[-1] == "More: docs/guides/Trouble.md#damaged-line" and answer.returncode == 0
    missing = subprocess.run([*program, "none"], capture_output=True, text=True, timeout=30, check=False)
    assert (missing.returncode, missing.stderr) == (2, "why: none: No such file or directory\n")
