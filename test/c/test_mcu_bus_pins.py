"""Buttons, pulse counters, LED chains, thermocouple readers and the driver UART of the simulated MCU."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from mcu_harness import FREQ, Mcu

MS = FREQ // 1000


def booted(*commands: tuple[str, dict[str, Any]], oids: int = 4) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    mcu.configure(oids, *commands)
    return mcu


# ---------------------------------------------------------------- buttons


def buttons(count: int = 2, invert: int = 0, retransmit: int = 20) -> Mcu:
    """Pins 50, 51, ... looked at every ms from 1 ms from now on."""
    adds = [("buttons_add", {"oid": 0, "pos": i, "pin": 50 + i, "pull_up": 1}) for i in range(count)]
    mcu = booted(("config_buttons", {"oid": 0, "button_count": count}), *adds)
    query = {"rest_ticks": MS, "retransmit_count": retransmit, "invert": invert}
    mcu.send("buttons_query", oid=0, clock=mcu.now + MS, **query)
    return mcu


def states(mcu: Mcu) -> list[tuple[int, bytes]]:
    return [(reply["ack_count"], reply["state"]) for reply in mcu.replies("buttons_state")]


def test_a_button_counts_when_two_looks_agree() -> None:
    mcu = buttons()
    start = mcu.now
    mcu.input_level = lambda pin, clock: int(pin == 51 and clock >= start + 5 * MS)
    mcu.run(0.0045)
    assert states(mcu) == []
    mcu.run(0.003)
    assert states(mcu) == [(0, b"\x02")]
    assert mcu.replies("buttons_state")[0].clock == start + 6 * MS


def test_a_glitch_of_one_look_is_ignored() -> None:
    mcu = buttons()
    start = mcu.now
    mcu.input_level = lambda pin, clock: int(start + 4.5 * MS < clock < start + 5.5 * MS)
    mcu.run(0.02)
    assert states(mcu) == []


def test_states_are_repeated_until_acknowledged_and_numbered_on() -> None:
    mcu = buttons(retransmit=10)
    start = mcu.now
    mcu.input_level = lambda pin, clock: int(pin == 50 and (clock - start) // (4 * MS) % 2)
    mcu.run_to(start + 10 * MS)
    seen = states(mcu)
    assert seen[-1] == (0, b"\x01\x00"), "both changes wait, the older first"
    mcu.send("buttons_ack", oid=0, count=2)
    mcu.run_to(start + 14 * MS)
    assert states(mcu)[-1] == (2, b"\x01")
    mcu.send("buttons_ack", oid=0, count=200)
    mcu.input_level = lambda pin, clock: 1
    before = len(states(mcu))
    mcu.run(0.1)
    assert len(states(mcu)) - before == 10, "one new state, sent every 10 looks for 100 ms"


def test_the_invert_mask_makes_idle_zero() -> None:
    mcu = buttons(invert=0b11)
    mcu.input_level = lambda pin, clock: 1
    mcu.run(0.02)
    assert states(mcu) == []
    mcu.input_level = lambda pin, clock: int(pin != 50)
    mcu.run(0.005)
    assert states(mcu) == [(0, b"\x01")]


def test_an_absent_host_still_learns_the_last_state() -> None:
    mcu = buttons(retransmit=1)
    start = mcu.now
    mcu.input_level = lambda pin, clock: int(pin == 50 and (clock - start) // (4 * MS) % 2)
    mcu.run_to(start + 200 * MS)
    mcu.input_level = lambda pin, clock: int(pin == 51)
    mcu.run(0.01)
    assert len(states(mcu)[-1][1]) == 8 and states(mcu)[-1][1][-1] == 2


@pytest.mark.parametrize(
    ("name", "values", "reason"),
    [
        ("config_buttons", {"oid": 1, "button_count": 9}, "Max of 8 buttons"),
        ("buttons_add", {"oid": 0, "pos": 2, "pin": 1, "pull_up": 0}, "Set button past maximum button count"),
        (
            "buttons_query",
            {"oid": 0, "clock": 0, "rest_ticks": 5, "retransmit_count": 0, "invert": 0},
            "Invalid buttons retransmit count",
        ),
    ],
)
def test_impossible_buttons_shut_down(name: str, values: dict[str, int], reason: str) -> None:
    mcu = Mcu()
    mcu.send("allocate_oids", count=3)
    mcu.send("config_buttons", oid=0, button_count=2)
    mcu.send(name, **values)
    assert mcu.shutdown_reason() == reason


# ---------------------------------------------------------------- pulse counter


def test_every_edge_counts_and_carries_its_clock() -> None:
    mcu = booted(("config_counter", {"oid": 0, "pin": 60, "pull_up": 1}))
    start = mcu.now + MS
    mcu.input_level = lambda pin, clock: max(0, clock - start) // (3 * MS) % 2  # edges every 3 ms
    mcu.send("query_counter", oid=0, clock=start, poll_ticks=MS // 10, sample_ticks=100 * MS)
    mcu.run_to(start + 250 * MS)
    first, second = mcu.replies("counter_state")
    assert [r["count"] for r in (first, second)] == [33, 66]
    assert second["next_clock"] - first["next_clock"] == 100 * MS
    per_edge = (second["count_clock"] - first["count_clock"]) / (second["count"] - first["count"])
    assert per_edge == pytest.approx(3 * MS, abs=MS / 100)


def test_a_counter_stops_when_asked() -> None:
    mcu = booted(("config_counter", {"oid": 0, "pin": 60, "pull_up": 1}))
    mcu.send("query_counter", oid=0, clock=mcu.now + MS, poll_ticks=MS, sample_ticks=10 * MS)
    mcu.run(0.05)
    before = len(mcu.replies("counter_state"))
    mcu.send("query_counter", oid=0, clock=0, poll_ticks=0, sample_ticks=0)
    mcu.run(0.1)
    assert before > 2 and len(mcu.replies("counter_state")) == before


# ---------------------------------------------------------------- LED chain


def chain(size: int = 6, **changes: int) -> Mcu:
    values = {"oid": 0, "pin": 70, "data_size": size, "bit_max_ticks": 288, "reset_min_ticks": 3600}
    return booted(("config_neopixel", values | changes))


def test_an_led_chain_gets_its_bits_with_the_data_sheet_s_times() -> None:
    mcu = chain()
    mcu.send("neopixel_update", oid=0, pos=2, data=b"\xff\x00\xa5")
    mcu.send("neopixel_update", oid=0, pos=0, data=b"\x80\x01")
    assert mcu.ask("neopixel_send", oid=0)["success"] == 1
    edges = mcu.edges(70)[1:]
    highs = [b[0] - a[0] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    lows = [b[0] - a[0] for a, b in zip(edges[1::2], edges[2::2], strict=False)]
    ns = 1e9 / FREQ
    assert all(220 <= t * ns <= 380 or 580 <= t * ns <= 1000 for t in highs)  # WS2812B
    assert all(400 <= t * ns <= 4000 for t in lows)
    bits = "".join("1" if t * ns > 500 else "0" for t in highs)
    assert int(bits, 2).to_bytes(6, "big") == b"\x80\x01\xff\x00\xa5\x00"


def test_a_transmission_that_an_interrupt_would_spoil_is_given_up() -> None:
    mcu = chain(bit_max_ticks=10)  # less than the shortest low time
    assert mcu.ask("neopixel_send", oid=0)["success"] == 0


@pytest.mark.parametrize("pos", [5, 7, 65535])
def test_led_data_beyond_the_chain_is_refused(pos: int) -> None:
    mcu = chain()
    mcu.send("neopixel_update", oid=0, pos=pos, data=b"\x01\x02")
    assert mcu.shutdown_reason() == "Invalid neopixel update command"


# ---------------------------------------------------------------- thermocouples

CHIPS = {"MAX31855": 0, "MAX31856": 1, "MAX31865": 2, "MAX6675": 3}


def reader(chip: str, reply: bytes, **changes: int) -> Mcu:
    mcu = booted(
        ("config_spi", {"oid": 0, "pin": 5, "cs_active_high": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 0, "rate": 4_000_000}),
        ("config_thermocouple", {"oid": 1, "spi_oid": 0, "thermocouple_type": CHIPS[chip]}),
    )
    assert mcu.dictionary.plain["enumerations"]["thermocouple_type"] == CHIPS
    mcu.spi_reply = lambda bus, sent: reply
    limits = {"min_value": 0, "max_value": 0xFFFFFFFF, "max_invalid_count": 3}
    mcu.send(
        "query_thermocouple", **({"oid": 1, "clock": mcu.now + MS, "rest_ticks": 10 * MS} | limits | changes)
    )
    return mcu


@pytest.mark.parametrize(
    ("chip", "reply", "value", "fault"),
    [
        ("MAX31855", bytes.fromhex("064016c0"), 0x064016C0, 0),
        ("MAX31855", bytes.fromhex("00010001"), 0x00010001, 1),
        ("MAX31856", b"\x00\x06\x4f\xf0\x00", 0x064FF0, 0),
        ("MAX31856", b"\x00\x06\x4f\xf0\x01", 0x064FF0, 1),
        ("MAX31865", b"\x00\x40\x02\xff\xff\x00\x00\x00", 0x4002, 0),
        ("MAX31865", b"\x00\x40\x03\xff\xff\x00\x00\x80", 0x4003, 0x80),
        ("MAX6675", b"\x0c\x80", 0x0C80, 0),
        ("MAX6675", b"\x00\x04", 0x0004, 4),
    ],
)
def test_each_chip_is_read_in_its_own_way(chip: str, reply: bytes, value: int, fault: int) -> None:
    mcu = reader(chip, reply)
    mcu.run(0.012)
    first, second = mcu.replies("thermocouple_result")
    assert (first["value"], first["fault"]) == (value, fault)
    assert second["next_clock"] - first["next_clock"] == 10 * MS
    asked = {"MAX31856": b"\x0c", "MAX31865": b"\x01"}.get(chip, b"\x00")
    assert mcu.spi_transfers[0][3] == asked + bytes(len(reply) - 1)


@pytest.mark.parametrize(
    ("chip", "reply", "limits", "trips"),
    [
        ("MAX6675", b"\x0c\x80", {"min_value": 0xC80, "max_value": 0xC80}, False),
        ("MAX6675", b"\x0c\x80", {"min_value": 0xC81}, True),
        ("MAX6675", b"\x0c\x80", {"max_value": 0xC7F}, True),
        ("MAX6675", b"\x00\x04", {}, True),
        ("MAX31855", b"\xff\xf0\x00\x00", {"max_value": 0x1000}, False),  # below 0 degC counts as 0
        ("MAX31855", b"\xff\xf0\x00\x00", {"min_value": 0x1000}, True),
    ],
)
def test_three_bad_readings_in_a_row_shut_down_and_no_fewer(
    chip: str, reply: bytes, limits: dict[str, int], trips: bool
) -> None:
    mcu = reader(chip, reply, **limits)
    mcu.run(0.0215)  # readings at 1, 11 ms and then 21 ms
    assert (mcu.shutdown_reason() == "Thermocouple reader fault") == trips
    mcu = reader(chip, reply, **limits)
    mcu.run(0.0205)
    assert mcu.shutdown_reason() is None


def test_a_good_reading_forgives_the_bad_ones_before() -> None:
    mcu = reader("MAX6675", b"")
    replies = iter([b"\x00\x04", b"\x00\x04", b"\x0c\x80"] * 4)
    mcu.spi_reply = lambda bus, sent: next(replies)
    mcu.run(0.1)
    assert mcu.shutdown_reason() is None


# ---------------------------------------------------------------- driver UART

BIT = 1800  # 40 kBaud


def uart(shared: bool) -> Mcu:
    pins = {"rx_pin": 80, "tx_pin": 80 if shared else 81, "pull_up": 1}
    mcu = booted(("config_tmcuart", {"oid": 0, "bit_time": BIT, **pins}))
    mcu.input_level = lambda pin, clock: 1
    return mcu


def framed(data: bytes) -> list[int]:
    """Start bit, eight bits from the lowest on, stop bit, for each byte."""
    return [bit for byte in data for bit in (0, *(byte >> i & 1 for i in range(8)), 1)]


def packed(bits: list[int]) -> bytes:
    return bytes(sum(bit << i for i, bit in enumerate(bits[at : at + 8])) for at in range(0, len(bits), 8))


@pytest.mark.parametrize("shared", [True, False])
def test_a_driver_register_is_read_bit_by_bit(shared: bool) -> None:
    mcu = uart(shared)
    request, answer = framed(b"\x05\x00\x06\x6f"), framed(b"\x05\xff\x06\x21\x00\x00\x09\xbd")
    tx = 80 if shared else 81
    assert mcu.send("tmcuart_send", oid=0, write=packed(request), read=10) == []
    mcu.run(60 * BIT / FREQ)
    writes = [(clock, value) for clock, pin, value in mcu.pin_writes if pin == tx]
    first = next(i for i, (_, value) in enumerate(writes) if not value)
    assert [value for _, value in writes[first : first + 40]] == request
    assert {b[0] - a[0] for a, b in pairwise(writes[first : first + 40])} == {BIT}
    start = mcu.now + 11 * BIT // 3
    mcu.input_level = lambda pin, clock: (
        answer[(clock - start) // BIT] if 0 <= clock - start < 80 * BIT else 1
    )
    mcu.run(100 * BIT / FREQ)
    (reply,) = mcu.replies("tmcuart_response")
    assert reply["read"] == packed(answer)


def test_a_silent_driver_gives_an_empty_answer_and_the_next_one_is_asked() -> None:
    mcu = uart(True)
    for count in (1, 2):
        mcu.send("tmcuart_send", oid=0, write=packed(framed(b"\x05\x00\x06\x6f")), read=10)
        mcu.run(0.05)
        assert [r["read"] for r in mcu.replies("tmcuart_response")] == [b""] * count


def test_a_write_is_confirmed_after_the_pause_that_ends_it() -> None:
    mcu = uart(False)
    mcu.send("tmcuart_send", oid=0, write=packed(framed(b"\x05\x00\x86\x01\x02\x03\x04\x55")), read=0)
    mcu.run(0.01)
    (reply,) = mcu.replies("tmcuart_response")
    assert reply["read"] == b"" and reply.clock - mcu.edges(81)[-1][0] >= 10 * BIT


def test_driver_messages_that_do_not_fit_are_refused() -> None:
    mcu = uart(True)
    mcu.send("tmcuart_send", oid=0, write=bytes(11), read=0)
    assert mcu.shutdown_reason() == "tmcuart data too large"
