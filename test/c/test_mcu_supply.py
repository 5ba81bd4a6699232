"""src/supplycmds.c: the switch in a heater's supply is closed while the MCU is healthy, and then only."""

from __future__ import annotations

import itertools

import pytest

from mcu_harness import FREQ, Mcu

PIN = 9
INTERVAL = FREQ // 500


def configured(active: int, interval: int) -> Mcu:
    mcu = Mcu()
    command = {"oid": 0, "pin": PIN, "active": active, "interval": interval}
    mcu.configure(1, ("config_supply_switch", command))
    return mcu


def writes(mcu: Mcu) -> list[tuple[int, int]]:
    return [(clock, value) for clock, pin, value in mcu.pin_writes if pin == PIN]


@pytest.mark.parametrize("active", [0, 1])
def test_the_level_closes_the_switch_until_a_shutdown(active: int) -> None:
    mcu = configured(active, 0)
    mcu.run(0.5)
    assert [value for _, value in writes(mcu)] == [active]
    mcu.send("emergency_stop")
    mcu.run(0.001)
    assert writes(mcu)[-1][1] == 1 - active
    mcu.send("clear_shutdown")
    mcu.run(0.5)
    assert writes(mcu)[-1][1] == 1 - active, "closed again only by a new configuration"


@pytest.mark.parametrize("active", [0, 1])
def test_edges_come_each_interval_and_end_with_a_shutdown(active: int) -> None:
    mcu = configured(active, INTERVAL)
    mcu.run(0.1)
    first, *edges = writes(mcu)
    assert first[1] == 1 - active and len(edges) >= 47
    assert {after[0] - before[0] for before, after in itertools.pairwise(edges[2:])} == {INTERVAL}
    mcu.send("emergency_stop")
    mcu.run(0.001)
    count = len(writes(mcu))
    mcu.run(0.1)
    assert writes(mcu)[-1][1] == 1 - active and len(writes(mcu)) == count


def test_an_interval_below_a_millisecond_is_refused() -> None:
    mcu = Mcu()
    command = {"oid": 0, "pin": PIN, "active": 1, "interval": FREQ // 1000 - 1}
    mcu.send("allocate_oids", count=1)
    mcu.send("config_supply_switch", **command)
    mcu.run(0.01)
    assert mcu.dictionary.shutdown_texts[mcu.replies("shutdown")[-1]["static_string_id"]] == (
        "Invalid supply switch interval"
    )
