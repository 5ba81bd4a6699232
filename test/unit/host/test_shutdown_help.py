"""What a user reads after the firmware stopped: every reason of the induction guard has words of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from link.mcu_session import RECOVERY, SHUTDOWN_HELP, shutdown_help

TABLE = Path(__file__).resolve().parents[3] / "src" / "shutdown_reasons.h"
REASONS = re.findall(r'X\(\w+, "([^"]+)"\)', TABLE.read_text(encoding="utf-8"))
GUARD = [reason for reason in REASONS if reason.startswith(("Induction coil", "Induction bridge"))]


def test_the_guard_has_a_reason_for_each_of_its_trips() -> None:
    trips = re.findall(r"GUARD_TRIP_(\w+) = [1-9]", (TABLE.parent / "guard.h").read_text(encoding="utf-8"))
    assert len(GUARD) == len(trips) == 8


@pytest.mark.parametrize("reason", GUARD)
def test_a_trip_of_the_guard_speaks_of_the_coil_and_not_of_ordinary_sensors_and_timers(reason: str) -> None:
    text = shutdown_help(reason)
    assert text.endswith(RECOVERY) and len(text) > len(RECOVERY) + 100
    assert "temperature sensor" not in text.lower() and "time already past" not in text
    assert ("host" if "bridge off" in reason else "coil") in text


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        ("ADC out of range", "temperature sensor"),
        ("Missed scheduling of next digital out event", "too busy"),
        ("Timer too close", "too busy"),
    ],
)
def test_reasons_of_ordinary_boards_keep_their_words(reason: str, words: str) -> None:
    assert reason in REASONS
    assert words in shutdown_help(reason)


def test_no_words_wait_for_an_induction_reason_that_is_gone() -> None:
    keys = [key for keys, _ in SHUTDOWN_HELP for key in keys if key.startswith("Induction")]
    assert keys and all(any(key in reason for reason in GUARD) for key in keys)
