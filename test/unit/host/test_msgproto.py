"""The wire protocol's pure functions, against documented vectors and themselves."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import chelper
import msgproto
import parsedump
from msgproto import MessageParser

# number and its encoding, from a stock host
VLQ = [
    (0, "00"), (95, "5f"), (96, "8060"), (-32, "60"), (-33, "ff5f"), (-1, "7f"), (127, "807f"), (12287, "df7f"),
    (12288, "80e000"), (-4096, "e000"), (-4097, "ffdf7f"), (1572864, "80e08000"), (201326591, "dfffff7f"),
    (201326592, "80e0808000"), (2147483647, "87ffffff7f"), (4294967295, "8fffffff7f"), (-2147483648, "f880808000"),
]  # fmt: skip

TABLES: dict[str, Any] = {
    "app": "Test",
    "version": "v1",
    "build_versions": "gcc",
    "commands": {
        "identify offset=%u count=%c": 1,
        "get_config": -5,
        "queue_step oid=%c interval=%u count=%hu add=%hi": -32,
        "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u": 96,
        "spi_send oid=%c data=%*s": 130,
        "set_offset oid=%c value=%i": 14,
    },
    "responses": {
        "identify_response offset=%u data=%.*s": 0,
        "shutdown clock=%u static_string_id=%hu": 70,
        "pos oid=%c pos=%i": -1,
    },
    "output": {"debug %u is %*s of 100%%": 99},
    "enumerations": {
        "pin": {"PA0": [0, 16], "PB8": [24, 8], "ADC_TEMPERATURE": 254},
        "static_string_id": {"Timer too close": 3},
    },
    "config": {"CLOCK_FREQ": 72000000, "MCU": "test", "RECEIVE_WINDOW": "192"},
}


def make_parser(**changes: Any) -> MessageParser:
    parser = MessageParser()
    parser.process_identify(zlib.compress(json.dumps({**TABLES, **changes}).encode()))
    return parser


PARSER = make_parser()


# --- numbers, checksum, blocks ---


@pytest.mark.parametrize(("value", "encoded"), VLQ)
def test_numbers_are_encoded_as_documented(value: int, encoded: str) -> None:
    assert msgproto.encode_vlq(value).hex() == encoded
    assert msgproto.decode_vlq(bytes.fromhex(encoded), 0) == (value, len(encoded) // 2)


@given(st.integers(-(2**31), 2**32 - 1))
def test_numbers_survive_the_wire_in_python_and_c_alike(value: int) -> None:
    encoded = msgproto.encode_vlq(value)
    assert msgproto.decode_vlq(encoded, 0) == (value, len(encoded))
    ffi, lib = chelper.get_ffi()
    buffer = ffi.new("uint8_t[8]")
    end = lib.vlq_encode(buffer, value)
    assert bytes(ffi.buffer(buffer, end - buffer)) == encoded


KINDS = {
    "%c": (-128, 255),
    "%hu": (0, 0xFFFF),
    "%hi": (-0x8000, 0x7FFF),
    "%u": (0, 2**32 - 1),
    "%i": (-(2**31), 2**31),
}


@given(
    st.lists(st.tuples(st.sampled_from(list(KINDS)), st.integers(-(2**33), 2**33)), max_size=8),
    st.binary(max_size=9),
)
def test_a_message_is_its_numbers_one_after_the_other_or_is_refused(
    words: list[tuple[str, int]], data: bytes
) -> None:
    text = " ".join(["m", *(f"p{n}={code}" for n, (code, _) in enumerate(words)), "data=%*s", "last=%c"])
    message = msgproto.MessageFormat.build(5, text, {})
    values = [*(value for _, value in words), data, 7]
    narrow = [
        not KINDS[code][0] <= value <= KINDS[code][1] for code, value in words if code not in ("%u", "%i")
    ]
    if any(narrow):
        with pytest.raises(msgproto.error, match=r"command 'm': parameter 'p\d' is -?\d+; it must be from"):
            message.encode(values)
        return
    wrapped = [
        (value + 2**31) % 2**32 - 2**31 if code == "%i" else value % 2**32 if code == "%u" else value
        for code, value in words
    ]
    numbers = b"".join(msgproto.encode_vlq(value) for value in wrapped)
    assert message.encode(values) == b"\x05" + numbers + bytes((len(data),)) + data + b"\x07"


def test_checksum_has_the_published_check_value() -> None:
    assert msgproto.crc16(b"123456789") == 0x6F91
    assert chelper.get_ffi()[1].msgblock_crc(b"123456789", 9) == 0x6F91


def test_blocks_are_the_documented_bytes() -> None:
    assert msgproto.encode_block(0, bytes.fromhex("010028")).hex() == "08100100285e9f7e"
    assert msgproto.encode_block(1, b"").hex() == "05118f087e"
    assert msgproto.encode_block(2, b"").hex() == "0512bd937e"


@given(st.integers(0, 15), st.binary(max_size=59))
def test_blocks_survive_in_python_and_c_alike(seq: int, content: bytes) -> None:
    block = msgproto.encode_block(seq, content)
    assert msgproto.check_block(block) == len(block)
    ffi, lib = chelper.get_ffi()
    buffer = ffi.new("uint8_t[64]")
    length = lib.msgblock_build(buffer, seq, content, len(content))
    assert bytes(ffi.buffer(buffer, length)) == block


@settings(max_examples=300)
@given(st.binary(max_size=200))
def test_garbage_is_judged_alike_in_python_and_c(data: bytes) -> None:
    lib = chelper.get_ffi()[1]
    assert msgproto.check_block(data) == lib.msgblock_check(data, len(data))


@given(
    st.lists(st.binary(max_size=59), max_size=8),
    st.lists(st.integers(1, 40), min_size=1),
    st.binary(max_size=30),
)
def test_blocks_are_found_however_the_stream_is_cut(
    contents: list[bytes], cuts: list[int], garbage: bytes
) -> None:
    garbage = garbage.replace(b"\x7e", b"")
    stream = garbage + b"\x7e" + b"".join(msgproto.encode_block(n, c) for n, c in enumerate(contents))
    reader, found, pos = msgproto.BlockReader(), [], 0
    for n in range(len(stream)):
        if pos >= len(stream):
            break
        step = cuts[n % len(cuts)]
        found += [b for b in reader.feed(stream[pos : pos + step]) if b]
        pos += step
    found += [b for b in reader.feed(stream[pos:]) if b]
    found += [b for b in reader.feed(bytes(70)) if b]  # garbage that looks like a long block ends here
    if not garbage:
        assert [b.content for b in found] == contents
    else:
        # garbage may swallow what follows while it looks like the beginning of a block, never make a block up
        assert all(b.content in contents for b in found)


@pytest.mark.parametrize("position", range(8))
def test_any_flipped_bit_makes_a_block_invalid(position: int) -> None:
    block = bytearray.fromhex("08100100285e9f7e")
    for bit in range(8):
        damaged = bytearray(block)
        damaged[position] ^= 1 << bit
        assert msgproto.check_block(damaged) <= 0


def test_content_that_does_not_fit_is_refused() -> None:
    with pytest.raises(msgproto.error, match="60 bytes"):
        msgproto.encode_block(0, bytes(60))


# --- messages ---


@pytest.mark.parametrize(
    ("text", "encoded"),
    [
        ("get_config", "7b"),
        ("queue_step oid=3 interval=1000 count=2 add=-5", "60038768027b"),
        (
            "config_stepper oid=0 step_pin=PA3 dir_pin=PB9 invert_step=-1 step_pulse_ticks=144",
            "80600003197f8110",
        ),
        (
            "config_stepper oid=0 step_pin=5 dir_pin=PB9 invert_step=-1 step_pulse_ticks=144",
            "80600005197f8110",
        ),
        ("spi_send oid=1 data=00ff7e", "8102010300ff7e"),
        ("set_offset oid=0x10 value=-1", "0e107f"),
    ],
)
def test_commands_are_encoded_from_text(text: str, encoded: str) -> None:
    assert PARSER.create_command(text).hex() == encoded


def test_enumeration_of_the_parameters_own_name_comes_before_one_of_its_suffix() -> None:
    names = {**TABLES["enumerations"], "step_pin": {"special": 7}}
    parser = make_parser(enumerations=names)
    text = "config_stepper oid=0 step_pin={} dir_pin=PB9 invert_step=0 step_pulse_ticks=0"
    assert parser.create_command(text.format("special")).hex() == "80600007190000"
    with pytest.raises(msgproto.error, match="'PA3'"):
        parser.create_command(text.format("PA3"))


def test_negative_ids_are_found_when_decoding() -> None:
    assert PARSER.parse(bytes.fromhex("7f0380e000")) == {"oid": 3, "pos": 12288, "#name": "pos"}
    assert PARSER.parse_content(bytes.fromhex("7b60038768027b"))[1]["add"] == -5


def test_enumerated_values_are_decoded_to_their_text() -> None:
    assert PARSER.parse(bytes.fromhex("80460503"))["static_string_id"] == "Timer too close"
    assert PARSER.parse(bytes.fromhex("80460504"))["static_string_id"] == "?4"


def test_output_texts_do_not_hinder_a_dictionary() -> None:
    content = bytes.fromhex("806305026869")
    assert PARSER.parse(content) == {"value0": 5, "value1": b"hi", "#name": "#output"}


def test_unsigned_values_wrap_at_32_bits_and_signed_ones_keep_their_sign() -> None:
    step = PARSER.lookup_command("queue_step oid=%c interval=%u count=%hu add=%hi")
    assert step.encode([1, 2**32 + 5, 1, 0]) == step.encode([1, 5, 1, 0])
    offset = PARSER.lookup_command("set_offset oid=%c value=%i")
    assert PARSER.parse(offset.encode([1, 2**32 - 1]))["value"] == -1
    assert PARSER.parse(b"\x60" + bytes.fromhex("017f0100"))["interval"] == 2**32 - 1


PARAM_VALUES = {
    "%c": st.integers(0, 255), "%hu": st.integers(0, 65535), "%hi": st.integers(-32768, 32767),
    "%u": st.integers(0, 2**32 - 1), "%i": st.integers(-(2**31), 2**31 - 1), "%*s": st.binary(max_size=12),
}  # fmt: skip


@settings(max_examples=200)
@given(st.data(), st.lists(st.sampled_from(sorted(PARAM_VALUES)), max_size=5), st.integers(-32, 4000))
def test_any_message_survives_values_and_text(data: st.DataObject, kinds: list[str], msgid: int) -> None:
    text = " ".join(["fn", *(f"p{n}={kind}" for n, kind in enumerate(kinds))])
    parser = make_parser(commands={text: msgid}, responses={}, output={}, enumerations={})
    values = [data.draw(PARAM_VALUES[kind]) for kind in kinds]
    encoded = parser.lookup_command(text).encode(values)
    params = parser.parse(encoded)
    assert [params[f"p{n}"] for n in range(len(kinds))] == values
    assert parser.create_command(parser.format_params(params)) == encoded


@settings(max_examples=300)
@given(st.binary(max_size=24), st.text("uis", max_size=6))
def test_parameters_decoded_in_c_are_those_of_the_documented_form(content: bytes, kinds: str) -> None:
    ffi, lib = chelper.get_ffi()
    found = ffi.new("int64_t[]", 6)
    end = lib.message_decode(content, len(content), 0, kinds.encode(), found)
    pos = 0
    for n, kind in enumerate(kinds):
        if kind == "s":
            if pos >= len(content) or pos + 1 + content[pos] > len(content):
                assert end == -2 - n
                return
            assert (found[n] >> 8, found[n] & 0xFF) == (pos + 1, content[pos])
            pos += 1 + content[pos]
            continue
        try:
            value, pos = msgproto.decode_vlq(content, pos)
        except msgproto.error:
            assert end == -1
            return
        value &= 0xFFFFFFFF
        assert found[n] == (value - 2**32 if kind == "i" and value >= 2**31 else value)
    assert end == pos


@settings(max_examples=500)
@given(st.binary(max_size=64))
def test_fuzzed_contents_decode_or_raise_the_protocols_error(content: bytes) -> None:
    try:
        PARSER.parse_content(content)
        PARSER.parse(content)
    except msgproto.error as e:
        assert str(e)


@settings(max_examples=80, deadline=None)
@given(
    st.recursive(
        st.none() | st.integers() | st.text(max_size=8),
        lambda x: (
            st.lists(x)
            | st.dictionaries(
                st.sampled_from(
                    ["commands", "responses", "output", "enumerations", "config", "a=%c", "pin", "P0"]
                ),
                x,
            )
        ),
    )
)
def test_fuzzed_dictionaries_load_or_raise_the_protocols_error(tables: Any) -> None:  # fmt: skip
    try:
        MessageParser().process_identify(json.dumps(tables).encode(), decompress=False)
    except msgproto.error as e:
        assert str(e)


@given(st.binary(max_size=100))
def test_fuzzed_compressed_dictionaries_raise_the_protocols_error(data: bytes) -> None:
    with pytest.raises(msgproto.error):
        MessageParser().process_identify(data)


# --- errors for people ---


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fly", ["fly", "Unknown command"]),
        ("", ["Unknown command"]),
        ("get_config x=1", ["unknown parameter 'x'", "get_config"]),
        ("get_config x", ["name=value"]),
        ("queue_step oid=1 interval=1 count=1", ["lacks add", "queue_step"]),
        ("queue_step oid=300 interval=1 count=1 add=0", ["'oid' is 300", "255"]),
        ("queue_step oid=1 interval=1 count=70000 add=0", ["'count' is 70000"]),
        ("queue_step oid=one interval=1 count=1 add=0", ["'one'", "'oid'"]),
        ("spi_send oid=1 data=xyz", ["hexadecimal"]),
        ("spi_send oid=1 data=" + "00" * 58, ["bytes", "59"]),
        (
            "config_stepper oid=0 step_pin=PA1 dir_pin=PZ9 invert_step=0 step_pulse_ticks=0",
            ["'PZ9'", "'dir_pin'"],
        ),
    ],
)
def test_wrong_commands_are_refused_with_the_reason(text: str, words: list[str]) -> None:
    with pytest.raises(msgproto.error) as caught:
        PARSER.create_command(text)
    for word in words:
        assert word in str(caught.value)


def test_format_of_another_version_is_refused() -> None:
    with pytest.raises(msgproto.error, match=r"format mismatch.*add=%hi"):
        PARSER.lookup_command("queue_step oid=%c interval=%u count=%hu add=%hi add2=%hi")
    with pytest.raises(msgproto.error, match="takes 4 parameters, not 3"):
        PARSER.lookup_command("queue_step oid=%c interval=%u count=%hu add=%hi").encode([1, 2, 3])


def test_constants_are_converted_or_refused() -> None:
    assert PARSER.get_constant_float("CLOCK_FREQ") == 72e6
    assert PARSER.get_constant_int("RECEIVE_WINDOW") == 192
    assert PARSER.get_constant("NOTHING", None) is None
    with pytest.raises(msgproto.error, match="no constant 'NOTHING'"):
        PARSER.get_constant("NOTHING")
    with pytest.raises(msgproto.error, match="'MCU' is 'test'"):
        PARSER.get_constant_float("MCU")


def test_only_identify_is_known_before_the_dictionary() -> None:
    parser = MessageParser()
    assert parser.create_command("identify offset=0 count=40").hex() == "010028"
    with pytest.raises(msgproto.error, match="Unknown command"):
        parser.lookup_command("get_config")


# --- parsedump ---


def test_dump_decodes_blocks_and_reports_what_is_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dictionary, out = tmp_path / "test.dict", tmp_path / "out"
    dictionary.write_text(json.dumps(TABLES))
    commands = ["get_config", "queue_step oid=3 interval=1000 count=2 add=-5", "spi_send oid=1 data=00ff7e"]
    blocks = [msgproto.encode_block(n, PARSER.create_command(c)) for n, c in enumerate(commands)]
    out.write_bytes(blocks[0] + blocks[1] + b"\x00\x01\x7e" + blocks[2] + blocks[0][:4])
    assert parsedump.main([str(dictionary), str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith("#")] == commands
    assert any("no block" in line for line in lines) and "4 bytes" in lines[-1]


def test_dump_without_its_files_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert parsedump.main([str(tmp_path / "none.dict"), "out"]) == 2
    assert "none.dict" in capsys.readouterr().err
