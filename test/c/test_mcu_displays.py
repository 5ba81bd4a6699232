"""Displays on the simulated MCU's pins: what the firmware puts on the lines, taken by models of the chips."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from mcu_harness import FREQ, Mcu
from simulation.panel.chips import Hd44780, St7920

CS, SCLK, SID = 50, 51, 52
RS, E, D4 = 50, 51, 52
US = FREQ // 1_000_000
ST7920 = {"oid": 0, "cs_pin": CS, "sclk_pin": SCLK, "sid_pin": SID}
HD44780 = {"oid": 0, "rs_pin": RS, "e_pin": E, **{f"d{4 + i}_pin": D4 + i for i in range(4)}}


def booted(name: str, values: dict[str, Any]) -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    mcu.configure(1, (name, values))
    return mcu


def st7920(sync_us: int = 72, byte_us: int = 72) -> Mcu:
    delays = {"sync_delay_ticks": sync_us * US, "cmd_delay_ticks": byte_us * US}
    return booted("config_st7920", ST7920 | delays)


def hd44780(delay_us: int = 53) -> Mcu:
    return booted("config_hd44780", HD44780 | {"delay_ticks": delay_us * US})


def take_serial(mcu: Mcu) -> tuple[St7920, list[int]]:
    """The chip, and the clock of each bit."""
    chip, levels, clocks, bits = St7920(), {CS: 0, SCLK: 0, SID: 0}, [], [0, 0]
    for clock, pin, level in mcu.pin_writes:
        rises = level and not levels.get(pin, 0)
        levels[pin] = level
        if pin == CS and rises:
            chip.select()
            bits = [0, 0]
        elif pin == SCLK and rises and levels[CS]:
            clocks.append(clock)
            bits = [bits[0] << 1 | levels[SID], bits[1] + 1]
            if bits[1] == 8:
                chip.serial_byte(bits[0])
                bits = [0, 0]
    return chip, clocks


def test_an_st7920_gets_its_serial_frames_with_the_data_sheet_s_times() -> None:
    mcu = st7920()
    mcu.send("st7920_send_cmds", oid=0, cmds=bytes([0x30, 0x0C, 0x01, 0x88]))
    mcu.run(0.001)  # the lines ran ahead by what the task had waited
    mcu.send("st7920_send_data", oid=0, data=b"Ferrite!")
    chip, clocks = take_serial(mcu)
    assert chip.is_on
    assert chip.letters[16:24] == b"Ferrite!"
    gaps = [(after - before) / US for before, after in pairwise(clocks)]
    assert min(gaps) >= 0.6, "a clock of 400 ns at 4.5 V, 600 ns at 2.7 V"
    assert all(gap >= 72 for gap in gaps[23:71:16]), "execution time after each byte"


def test_an_st7920_gets_pixels_where_they_are_addressed() -> None:
    mcu = st7920()
    mcu.send("st7920_send_cmds", oid=0, cmds=bytes([0x30, 0x0C, 0x36, 0x36, 0x80 | 5, 0x80 | 9]))
    mcu.send("st7920_send_data", oid=0, data=b"\xf0\x0f\x81")
    chip, _ = take_serial(mcu)
    assert chip.shows_pixels
    assert chip.pixels[(32 + 5) * 16 + 2 :][:3] == b"\xf0\x0f\x81"


def test_an_hd44780_gets_halves_of_bytes_on_four_lines() -> None:
    mcu = hd44780()
    for command in (0x33, 0x33, 0x32):
        mcu.send("hd44780_send_cmds", oid=0, cmds=bytes([command]))
        mcu.run(0.001)
    mcu.send("hd44780_send_cmds", oid=0, cmds=bytes([0x28, 0x0C, 0x06, 0x01]))
    mcu.run(0.001)
    mcu.send("hd44780_send_data", oid=0, data=b"Ferrite")
    chip, levels, falls = Hd44780(20), dict.fromkeys(range(RS, D4 + 4), 0), []
    for clock, pin, level in mcu.pin_writes:
        if pin == E and levels[E] and not level:
            falls.append(clock)
            chip.strobe(sum(levels[D4 + i] << i for i in range(4)), bool(levels[RS]))
        levels[pin] = level
    assert chip.is_on
    assert chip.text()[0] == "Ferrite".ljust(20)
    gaps = [(after - before) / US for before, after in pairwise(falls)]
    assert min(gaps) >= 53, "execution time after each half, which may be a command"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("config_st7920", ST7920 | {"sync_delay_ticks": 201 * US, "cmd_delay_ticks": 0}),
        ("config_st7920", ST7920 | {"sync_delay_ticks": 0, "cmd_delay_ticks": 201 * US}),
        ("config_hd44780", HD44780 | {"delay_ticks": 201 * US}),
    ],
)
def test_a_delay_that_would_hold_up_everything_is_refused(name: str, values: dict[str, Any]) -> None:
    mcu = Mcu()
    mcu.run(0.001)
    mcu.send("allocate_oids", count=1)
    mcu.send(name, **values)
    assert mcu.shutdown_reason() == "Invalid display delay"
