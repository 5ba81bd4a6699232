"""Sections of boards on a CAN bus: what is refused, and the counters a board reports."""

from __future__ import annotations

from typing import Any

import pytest

from base_rig import Session
from doc_rig import load
from extras import canbus_stats

BASE = "[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n[mcu]\nserial: x\n"


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (
            "[mcu board]\ncanbus_uuid: 11aa22\n",
            "Option 'canbus_uuid' in section 'mcu board' is '11aa22': expected 12 digits 0-9 a-f, as "
            "scripts/canbus_query.py prints them (printer.cfg, line 8).",
        ),
        (
            "[mcu board]\ncanbus_uuid: 11aa22bb33cc\n[mcu other]\ncanbus_uuid: 11AA22BB33CC\n",
            "Option 'canbus_uuid' in section 'mcu other' is '11AA22BB33CC': another section has this canbus_uuid, too "
            "(printer.cfg, line 10).",
        ),
        (
            "[mcu board]\nserial: x\ncanbus_uuid: 11aa22bb33cc\n",
            "Section 'mcu board' has both serial (printer.cfg, line 8) and canbus_uuid (printer.cfg, line 9)",
        ),
    ],
)
def test_a_wrong_address_is_refused_with_its_line(tmp_path: Any, config: str, text: str) -> None:
    assert load(tmp_path, BASE + config).message.startswith(text)


def test_a_board_on_the_bus_has_its_pins_and_its_status(tmp_path: Any) -> None:
    loaded = load(
        tmp_path, BASE + "[mcu board]\ncanbus_uuid: 11aa22bb33cc\n[output_pin light]\npin: board:PA1\n"
    )
    assert loaded.message == "Printer is ready"
    assert loaded.status["canbus_stats board"] == dict.fromkeys(
        ("rx_error", "tx_error", "tx_retries", "bus_state")
    )


class Board:
    """Of a bus with errors."""

    class error(Exception):
        """Of the link."""

    def is_fileoutput(self) -> bool:
        return False

    def try_lookup_command(self, form: str) -> object:
        assert form == "get_canbus_status"
        return object()

    def lookup_query_command(self, form: str, answer: str) -> Any:
        return self

    def send(self) -> dict[str, int]:
        return {"rx_error": 3, "tx_error": 1, "tx_retries": 20, "canbus_bus_state": 2}


def test_the_counters_of_the_board_are_its_status(tmp_path: Any) -> None:
    def body(session: Session) -> None:
        session.printer.add_object("mcu board", Board())
        config = session.printer.lookup_object("configfile")
        section = config.read_main_config().getsection("canbus_stats board")
        stats = canbus_stats.load_config_prefix(section)
        stats._find_board()
        session.sleep(0.5)
        assert stats.get_status(0.0) == {
            "rx_error": 3,
            "tx_error": 1,
            "tx_retries": 20,
            "bus_state": "passive",
        }
        assert stats.stats(0.0)[1] == "canstat_board: bus_state=passive rx_error=3 tx_error=1 tx_retries=20"

    Session(tmp_path, "").run(body)
