"""Display sections: what each kind of chip is sent, taken by models of the chips written from their data sheets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import bus_rig
from bus_devices import attach, frames, on_i2c
from bus_rig import BusSession, run
from extras.display import font8x16
from simulation.panel.chips import Hd44780, PageChip, Picture, St7920
from simulation.panel.image import as_text
from simulation.panel.wires import BYTE, RELEASED, SELECTED, shift_register, words

SPI = "spi_software_sclk_pin: PC1\nspi_software_mosi_pin: PC2\nspi_software_miso_pin: PC3\n"
LCDS = {
    "st7920": "cs_pin: PA1\nsclk_pin: PA2\nsid_pin: PA3\n",
    "emulated_st7920": f"en_pin: PA1\n{SPI}",
    "hd44780": "".join(f"{name}_pin: PA{i}\n" for i, name in enumerate(("rs", "e", "d4", "d5", "d6", "d7"))),
    "hd44780_spi": f"latch_pin: PA1\n{SPI}",
    "aip31068_spi": f"latch_pin: PA1\n{SPI}",
    "uc1701": "cs_pin: PA1\na0_pin: PA2\nrst_pin: PA3\n",
    "ssd1306": "",
    "sh1106": "cs_pin: PA1\ndc_pin: PA2\nx_offset: 2\n",
}
GRAPHIC = ("st7920", "emulated_st7920", "uc1701", "ssd1306", "sh1106")
CHARACTER = ("hd44780", "hd44780_spi", "aip31068_spi")
SCREEN = """
[display_data mine first]
position: 0, 0
text: Hello
[display_data mine counter]
position: 1, 3
text: { printer['output_pin light'].value * 100 }~smile~x
[display_data other only]
position: 3, 0
text: other{ draw_progress_bar(2, 0, 4, 0.5) }
[display_glyph smile]
data:
  1000000000000000
  0100000000000000
  0010000000000000
  0001000000000000
  0000100000000000
  0000010000000000
  0000001000000000
  0000000100000000
  0000000010000000
  0000000001000000
  0000000000100000
  0000000000010000
  0000000000001000
  0000000000000100
  0000000000000010
  0000000000000001
hd44780_slot: 5
hd44780_data:
  .....
  .*.*.
  .....
  *...*
  .***.
  .....
  .....
  .....
[output_pin light]
pin: PB1
value: 0
"""


def config(lcd_type: str, more: str = "display_group: mine\n") -> str:
    return f"[display]\nlcd_type: {lcd_type}\n{LCDS[lcd_type]}{more}{SCREEN}"


def take_page_messages(session: BusSession, chip: PageChip, data_line: int, reset: int | None = None) -> None:
    """SPI with a data line, in order."""
    is_data = False
    for name, values, _, _ in session.chip.sent:
        if name == "update_digital_out":
            if values[0] == data_line:
                is_data = bool(values[1])
            elif values[0] == reset and not values[1]:
                chip.reset()
        elif name == "spi_send":
            for value in values[1]:
                (chip.data if is_data else chip.command)(value)


def seen_letters(session: BusSession, lcd_type: str) -> Hd44780:
    """A character display after all it has been sent."""
    chip = Hd44780(20, lcd_type != "aip31068_spi")
    wires = {"hd44780_spi": shift_register, "aip31068_spi": words}
    take = wires[lcd_type](chip) if lcd_type in wires else None
    for name, values, _, _ in session.chip.sent:
        if name.startswith("hd44780_send") and lcd_type == "hd44780":
            for value in values[1]:
                chip.strobe(value >> 4, name.endswith("data"))
                chip.strobe(value & 0x0F, name.endswith("data"))
        elif name == "spi_send" and take:
            take(SELECTED, 0, False)
            for value in values[1]:
                take(BYTE, value, False)
            take(RELEASED, 0, False)
    return chip


def seen_st7920(session: BusSession) -> St7920:
    chip = St7920()
    for name, values, _, _ in session.chip.sent:
        if name == "spi_send":
            chip.select()
            for value in values[1]:
                chip.serial_byte(value)
        elif name.startswith("st7920_send"):
            for value in values[1]:
                (chip.data if name.endswith("data") else chip.command)(value)
    return chip


def seen_pages(session: BusSession, lcd_type: str) -> PageChip:
    chip = PageChip(lcd_type, 2 if lcd_type == "sh1106" else 0)
    if lcd_type != "ssd1306":
        take_page_messages(session, chip, data_line=1, reset=2)
        return chip
    for frame in frames(session.chip, 0):
        assert frame[0] in (0x00, 0x40)
        for value in frame[1:]:
            (chip.data if frame[0] else chip.command)(value)
    return chip


def seen(session: BusSession, lcd_type: str) -> Any:
    """The chip after all it has been sent."""
    if lcd_type in CHARACTER:
        return seen_letters(session, lcd_type)
    return seen_st7920(session) if lcd_type.endswith("st7920") else seen_pages(session, lcd_type)


def pixels(glyph_at: tuple[int, int] | None, texts: dict[tuple[int, int], str]) -> Picture:
    """What a graphic display is to show: texts by row and column of cells, the diagonal of ~smile~."""
    rows = [[0] * 128 for _ in range(64)]
    for (row, column), text in texts.items():
        for number, letter in enumerate(text):
            for y, bits in enumerate(font8x16.bitmap(letter)):
                for x in range(8):
                    rows[16 * row + y][8 * (column + number) + x] |= bits >> 7 - x & 1
    if glyph_at:
        for i in range(16):
            rows[16 * glyph_at[0] + i][8 * glyph_at[1] + i] |= 1
    return rows


@pytest.fixture
def i2c_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    attach(monkeypatch, on_i2c(lambda data, count: b""))


@pytest.mark.usefixtures("i2c_answers")
@pytest.mark.parametrize("lcd_type", GRAPHIC)
def test_a_graphic_display_shows_texts_and_glyphs_and_follows_changes(tmp_path: Path, lcd_type: str) -> None:
    def body(s: BusSession) -> None:
        s.sleep(3.0)
        first = seen(s, lcd_type).picture()
        wanted = pixels((1, 6), {(0, 0): "Hello", (1, 3): "0.0", (1, 8): "x"})
        assert as_text(first) == as_text(wanted)
        s.gcode.run_script("SET_PIN PIN=light VALUE=1")
        s.sleep(2.0)
        wanted = pixels((1, 8), {(0, 0): "Hello", (1, 3): "100.0", (1, 10): "x"})
        assert as_text(seen(s, lcd_type).picture()) == as_text(wanted)

    run(tmp_path, config(lcd_type), body)


@pytest.mark.parametrize("lcd_type", CHARACTER)
def test_a_character_display_shows_texts_and_glyphs_and_follows_changes(
    tmp_path: Path, lcd_type: str
) -> None:
    def body(s: BusSession) -> None:
        s.sleep(3.0)
        chip = seen(s, lcd_type)
        assert chip.is_on
        assert chip.text() == ["Hello".ljust(20), "   0.05x".ljust(20), " " * 20, " " * 20]
        assert list(chip.glyphs[40:48]) == [0, 0b01010, 0, 0b10001, 0b01110, 0, 0, 0]
        s.gcode.run_script("SET_PIN PIN=light VALUE=1")
        s.sleep(2.0)
        assert seen(s, lcd_type).text()[1] == "   100.05x".ljust(20)

    run(tmp_path, config(lcd_type), body)


def test_a_picture_that_stays_the_same_sends_nothing(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.sleep(3.0)
        before = len(s.chip.sent)
        s.sleep(5.0)
        assert len(s.chip.sent) == before

    run(tmp_path, config("st7920"), body)


@pytest.mark.usefixtures("i2c_answers")
@pytest.mark.parametrize("lcd_type", [*GRAPHIC, *CHARACTER])
def test_the_line_to_the_board_is_never_filled_by_a_picture(tmp_path: Path, lcd_type: str) -> None:
    """A whole picture goes out in parts: at most 100 bytes of it at any moment."""
    moments: dict[float, int] = {}

    def body(s: BusSession) -> None:
        s.sleep(3.0)

    original = bus_rig.Sender.send

    def send(self: Any, data: Any = (), *args: Any, **kwargs: Any) -> Any:
        now = self.chip.printer.get_reactor().monotonic()
        sent = sum(len(value) for value in data if isinstance(value, bytes))
        moments[now] = moments.get(now, 0) + sent
        return original(self, data, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bus_rig.Sender, "send", send)
        run(tmp_path, config(lcd_type), body)
    assert max(moments.values()) <= 100


def test_the_group_is_chosen_by_command(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.sleep(3.0)
        s.gcode.run_script("SET_DISPLAY_GROUP GROUP=other")
        s.sleep(1.0)
        assert seen(s, "hd44780").text() == [" " * 20, " " * 20, "\xff\xff--".ljust(20), "other".ljust(20)]
        with pytest.raises(
            s.printer.command_error, match="Unknown display_data group 'none': there are _default"
        ):
            s.gcode.run_script("SET_DISPLAY_GROUP DISPLAY=display GROUP=none")

    run(tmp_path, config("hd44780"), body)


def test_a_further_display_has_its_own_group(tmp_path: Path) -> None:
    extra = f"[display second]\nlcd_type: emulated_st7920\ndisplay_group: mine\nen_pin: PD1\n{SPI}"

    def body(s: BusSession) -> None:
        s.gcode.run_script("SET_DISPLAY_GROUP DISPLAY=second GROUP=other")
        s.sleep(3.0)
        assert seen(s, "hd44780").text()[0].startswith("Hello")
        assert seen(s, "emulated_st7920").letters[48:53] == b"other"

    run(tmp_path, config("hd44780") + extra, body)


def test_a_template_that_fails_leaves_the_others(tmp_path: Path) -> None:
    broken = config("hd44780") + "[display_data mine broken]\nposition: 2, 0\ntext: { 1 / 0 }\n"

    def body(s: BusSession) -> None:
        s.sleep(3.0)
        assert seen(s, "hd44780").text()[0].startswith("Hello")

    run(tmp_path, broken, body)


def test_a_display_that_does_not_answer_does_not_stop_the_printer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_there = False
    attach(monkeypatch, on_i2c(lambda data, count: b"" if is_there else None))

    def body(s: BusSession) -> None:
        nonlocal is_there
        s.sleep(3.0)
        assert s.state[1] == "ready"
        s.chip.sent.clear()
        is_there = True
        s.sleep(12.0)
        assert as_text(seen(s, "ssd1306").picture()[:16]) == as_text(pixels(None, {(0, 0): "Hello"})[:16])

    run(tmp_path, config("ssd1306"), body)


PANEL = f"lcd_type: st7920\n{LCDS['st7920']}"
UC1701 = f"lcd_type: uc1701\n{LCDS['uc1701']}"
ITEM = f"{PANEL}[display_data mine x]\n"
GLYPH = f"{PANEL}[display_glyph a]\n"
WRONG = {
    "lcd_type: ssd1307": "Option 'lcd_type' in section 'display': 'ssd1307' is not one of the choices",
    "lcd_type: st7920\ncs_pin: PA1\nsclk_pin: PA2": "Option 'sid_pin' in section 'display' must be specified",
    f"{UC1701}contrast: 64": "Option 'contrast' in section 'display': must have maximum of 63",
    f"{PANEL}display_group: nix": "Option 'display_group' in section 'display': there is no group 'nix'",
    f"{PANEL}[display_data mine]\nposition: 1, 2\ntext: x": "Section 'display_data mine' must be named after",
    f"{ITEM}position: 1\ntext: x": "Option 'position' in section 'display_data mine x': must have 2 elements",
    f"{ITEM}position: 1, -1\ntext: x": "Option 'position' in section 'display_data mine x' must be a row and a",
    f"{ITEM}position: 1, 1\ntext: {{% x %}}": "Error loading template 'display_data mine x:text'",
    f"{GLYPH}data: **": "Option 'data' in section 'display_glyph a' must be 16 lines of 16 pixels",
    f"{GLYPH}hd44780_data:\n" + " .....\n" * 8: "Option 'hd44780_slot' in section 'display_glyph a' must be",
    f"lcd_type: hd44780\n{LCDS['hd44780']}line_length: 40": "Option 'line_length' in section 'display': '40' is not",
}


@pytest.mark.parametrize("text", WRONG)
def test_wrong_options_are_named_with_their_place(tmp_path: Path, text: str) -> None:
    reason = bus_rig.start_error(tmp_path, f"[display]\n{text}\n")
    (line,) = [line for line in reason.splitlines() if line.startswith(WRONG[text])]
    assert "(printer.cfg, line " in line


def test_a_further_display_needs_a_first_one(tmp_path: Path) -> None:
    reason = bus_rig.start_error(tmp_path, f"[display second]\nlcd_type: st7920\n{LCDS['st7920']}")
    assert (
        "Section 'display second' is a further display: [display] must be there, too (printer.cfg, line 1)."
        in reason
    )
