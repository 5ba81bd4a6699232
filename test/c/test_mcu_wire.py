"""The wire format as the simulated MCU speaks it, against byte vectors of a stock board."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcu_harness import SIM_DIR, Mcu, crc16, make_block, take_vlq, vlq

IDENTIFY_0_40 = bytes.fromhex("08100100285e9f7e")
ACK_1 = bytes.fromhex("05118f087e")

# number (as the unsigned or signed value sent) and its encoding, from a stock host
VLQ_VECTORS = [
    (0, "00"), (95, "5f"), (96, "8060"), (-32, "60"), (-33, "ff5f"), (-1, "7f"), (127, "807f"),
    (12287, "df7f"), (12288, "80e000"), (-4096, "e000"), (-4097, "ffdf7f"), (1572864, "80e08000"),
    (201326591, "dfffff7f"), (201326592, "80e0808000"), (2147483647, "87ffffff7f"),
    (4294967295, "8fffffff7f"), (-2147483648, "f880808000"),
]  # fmt: skip


@pytest.fixture
def mcu() -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    return mcu


def test_checksum_has_the_published_check_value() -> None:
    assert crc16(b"123456789") == 0x6F91


def test_boot_announces_itself_with_starting(mcu: Mcu) -> None:
    assert [(reply.name, reply.sequence) for reply in mcu.replies()] == [("starting", 0)]


def test_identify_is_answered_and_acknowledged_byte_for_byte(mcu: Mcu) -> None:
    answer = mcu.raw(IDENTIFY_0_40)
    block, ack = answer[:-5], answer[-5:]
    assert ack == ACK_1
    assert block[:5] == bytes.fromhex("3011000028") and len(block) == 0x30 and block[-1] == 0x7E
    mcu.sequence = 1
    assert block[5:45] == mcu.ask("identify", offset=0, count=40)["data"]


@pytest.mark.parametrize("bad", [IDENTIFY_0_40, make_block(5, b""), IDENTIFY_0_40[:-3] + b"\x5e\x9e\x7e"])
def test_wrong_turn_or_checksum_is_answered_by_a_nak(mcu: Mcu, bad: bytes) -> None:
    mcu.raw(IDENTIFY_0_40)
    assert mcu.raw(bad) == ACK_1


def test_leading_sync_byte_is_allowed_and_empty_block_is_acknowledged(mcu: Mcu) -> None:
    mcu.raw(IDENTIFY_0_40)
    assert mcu.raw(b"\x7e" + make_block(1, b"")) == bytes.fromhex("0512bd937e")


def test_fetched_dictionary_is_the_built_one(mcu: Mcu) -> None:
    assert mcu.identify() == json.loads((SIM_DIR / "ferrite.dict").read_text())


@pytest.mark.parametrize(("value", "encoded"), VLQ_VECTORS)
def test_numbers_are_read_and_written_as_by_a_stock_host(mcu: Mcu, value: int, encoded: str) -> None:
    assert vlq(value).hex() == encoded
    mcu.send("allocate_oids", count=0)
    mcu.send_content(vlq(mcu.dictionary.commands["finalize_config"].number) + bytes.fromhex(encoded))
    mcu.ask("get_config")
    content = mcu.sent[-2][1][2:-3]
    crc_bytes = content[2:-3]  # id 1, is_config 1 | crc | is_shutdown 1, move_count 2
    assert take_vlq(crc_bytes, 0) == ((value + 2**31) % 2**32 - 2**31, len(crc_bytes))
    assert mcu.ask("get_config")["crc"] == value & 0xFFFFFFFF


@given(data=st.binary(max_size=50))
@settings(max_examples=30, deadline=None)
def test_byte_strings_come_back_whole(data: bytes) -> None:
    assert SHARED.ask("debug_ping", data=data)["data"] == data


SHARED = Mcu()
SHARED.run(0.001)


def test_commands_of_one_block_run_in_order(mcu: Mcu) -> None:
    content = b"".join(mcu.encode("debug_ping", data=bytes([i])) for i in range(10))
    assert [reply["data"] for reply in mcu.send_content(content)] == [bytes([i]) for i in range(10)]


def test_every_response_acknowledges_the_block_it_answers(mcu: Mcu) -> None:
    reply = mcu.ask("get_clock")
    assert (reply.sequence, mcu.replies()[-1].sequence) == (1, 1)


@pytest.mark.parametrize(
    "content",
    [vlq(1) + b"\x00", vlq(1) + b"\x80" * 6, vlq(11) + b"\x05abc", b"\x80"],
    ids=["parameter missing", "number too long", "byte string cut", "id cut"],
)
def test_content_that_cannot_be_parsed_shuts_down(mcu: Mcu, content: bytes) -> None:
    mcu.send_content(content)
    assert mcu.shutdown_reason() == "Command parser error"


@pytest.mark.parametrize("number", [0, -1, -33, 5000])
def test_unknown_command_shuts_down(mcu: Mcu, number: int) -> None:
    mcu.send_content(vlq(number))
    assert mcu.shutdown_reason() == "Invalid command"


@pytest.mark.parametrize("behind", [1, 2, 128])
def test_number_behind_the_last_command_shuts_down(mcu: Mcu, behind: int) -> None:
    last = max(command.number for command in mcu.dictionary.commands.values())
    mcu.send_content(vlq(last + behind))
    assert mcu.shutdown_reason() == "Invalid command"


def test_commands_whose_number_has_two_bytes_are_obeyed(mcu: Mcu) -> None:
    query = mcu.dictionary.commands["trigger_analog_query_state"]
    assert query.number > 95 and len(vlq(query.number)) == 2
    mcu.configure(
        2,
        ("config_sos_filter", {"oid": 0, "max_sections": 1}),
        ("config_trigger_analog", {"oid": 1, "sos_filter_oid": 0}),
    )
    state = mcu.ask("trigger_analog_query_state", oid=1)
    assert (state.name, state["oid"], state["homing"]) == ("trigger_analog_state", 1, 0)


def test_one_error_burst_gets_one_nak(mcu: Mcu) -> None:
    assert mcu.raw(b"\xff" * 200) == b""
    assert mcu.raw(b"\x7e") == make_block(0, b"")
    assert mcu.raw(IDENTIFY_0_40)[-5:] == ACK_1


def test_good_block_inside_the_bytes_of_a_bad_one_is_found(mcu: Mcu) -> None:
    # a length byte of 64 claims bytes that are really the next block
    swallowed = b"\x40\x10\x55\x7e" + IDENTIFY_0_40
    answer = mcu.raw(swallowed + b"\x7e" * 60)
    assert answer.endswith(ACK_1) and len(mcu.replies("identify_response")) == 1


# ---------------------------------------------------------------- nothing executes twice


class Link:
    """Delivers blocks of counted pings to an MCU after mangling the bytes, and resends as a host does."""

    def __init__(self, mcu: Mcu) -> None:
        self.mcu = mcu
        self.first = mcu.sequence
        self.payloads: list[bytes] = []

    def block(self, index: int) -> bytes:
        payload = index.to_bytes(2, "big") + b"\x7e" * (index % 3)
        while len(self.payloads) <= index:
            self.payloads.append(payload)
        content = self.mcu.encode("debug_ping", data=payload)
        return make_block(self.first + index, content)


DAMAGE = st.sampled_from(["none", "flip", "cut", "drop", "twice", "swap", "insert"])


@given(plan=st.lists(st.tuples(DAMAGE, st.integers(0, 60), st.integers(1, 255)), min_size=1, max_size=24))
@settings(max_examples=120, deadline=None)
def test_damaged_blocks_are_executed_once_and_in_order(plan: list[tuple[str, int, int]]) -> None:
    mcu = SHARED
    before = len(mcu.sent)
    mcu.raw(b"\x7e" * 64)  # nothing of the example before is left in the receiver
    if len(mcu.sent) > before:
        mcu.sequence = mcu.decode(*mcu.sent[-1]).sequence
        del mcu.sent[before:]
    link = Link(mcu)
    stream: list[bytes] = []
    for index, (damage, place, value) in enumerate(plan[:12]):  # at most 12 blocks are outstanding
        block = bytearray(link.block(index))
        where = place % len(block)
        if damage == "flip":
            block[where] ^= value
        elif damage == "cut":
            del block[where:]
        elif damage == "insert":
            block.insert(where, value)
        copies = {"drop": 0, "twice": 2}.get(damage, 1)
        stream += [bytes(block)] * copies
        if damage == "swap" and len(stream) > 1:
            stream[-1], stream[-2] = stream[-2], stream[-1]
    for piece in stream:
        mcu.raw(piece)
    count = min(len(plan), 12)
    # What a host does on time-out: a sync byte, then all that is not acknowledged. A damaged length byte can claim
    # 64 bytes, which eight resends of the shortest block supply.
    for _ in range(8):
        done = (mcu.decode(*mcu.sent[-1]).sequence - link.first) & 15 if len(mcu.sent) > before else 0
        mcu.raw(b"\x7e" + b"".join(link.block(index) for index in range(done, count)))
    mcu.sequence = (link.first + count) & 15
    pongs = [
        reply["data"] for reply in (mcu.decode(*sent) for sent in mcu.sent[before:]) if reply.name == "pong"
    ]
    assert pongs == link.payloads[:count]
    assert not mcu.replies("shutdown")
    del mcu.sent[:]
