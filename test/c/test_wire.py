"""src/wire.c: the checksum, numbers and blocks of the wire format, byte for byte."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcu_harness import crc16, make_block, vlq
from pure_harness import SRC, load

ffi, lib = load("wire", ("wire.c",), (SRC / "wire.h",))
EDGES = sorted({sign * (1 << bit) + step for bit in range(31) for sign in (1, -1) for step in range(-33, 97)})
EDGES = [value for value in EDGES if -(2**31) <= value < 2**31]


def put(value: int) -> bytes:
    out = ffi.new("uint8_t[6]", b"\xaa" * 6)
    end = lib.wire_put_vlq(out, value)
    assert out[end - out] == 0xAA, "wrote behind its end"
    return bytes(ffi.buffer(out, end - out))


def get(data: bytes) -> tuple[int, int] | None:
    """(value, bytes read), None if it is refused."""
    raw, value = ffi.from_buffer("uint8_t[]", data), ffi.new("int32_t *")
    end = lib.wire_get_vlq(raw, raw + len(data), value)
    return None if end == ffi.NULL else (value[0], end - raw)


def test_the_checksum_has_the_published_check_value() -> None:
    assert lib.wire_crc16(b"123456789", 9) == 0x6F91
    assert lib.wire_crc16(b"", 0) == 0xFFFF


@given(st.binary(max_size=64))
def test_the_checksum_equals_the_one_bit_by_bit(data: bytes) -> None:
    assert lib.wire_crc16(data, len(data)) == crc16(data)


def test_numbers_are_written_and_read_with_the_fewest_bytes_around_every_power_of_two() -> None:
    for value in EDGES:
        data = put(value)
        assert data == vlq(value)
        assert get(data + b"\x7f") == (value, len(data))


@given(st.integers(-(2**31), 2**31 - 1))
def test_every_number_comes_back(value: int) -> None:
    assert put(value) == vlq(value)
    assert get(put(value)) == (value, len(put(value)))


@pytest.mark.parametrize("data", [b"", b"\x80", b"\x81\x80\x80\x80"])
def test_a_number_that_runs_over_the_end_is_refused(data: bytes) -> None:
    assert get(data) is None


def test_a_number_longer_than_any_of_32_bits_is_refused() -> None:
    assert get(b"\x8f\xff\xff\xff\x7f") == (-1, 5)
    assert get(b"\x8f\xff\xff\xff\xff\x7f") is None


@pytest.mark.parametrize("length", [0, 1, 59])
@pytest.mark.parametrize("sequence", [0, 9, 15, 16 + 9])
def test_a_sealed_block_has_length_turn_checksum_and_sync(length: int, sequence: int) -> None:
    content = bytes(range(1, length + 1))
    block = ffi.new("uint8_t[65]", b"\0\0" + content)
    block[length + 5] = 0xAA
    assert lib.wire_seal_block(block, length, sequence) == length + 5
    assert bytes(ffi.buffer(block, length + 6)) == make_block(sequence & 15, content) + b"\xaa"
