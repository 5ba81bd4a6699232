"""LEDs on a bus: what the chips make of the frames, by their data sheets."""

from __future__ import annotations

from pathlib import Path

import pytest

from bus_devices import Apa102, Pca9533, Pca9632, attach, on_i2c, take
from bus_rig import FREQ, BusSession, run, start_error
from extras import pca9533

COUNT = 30


def colors(s: BusSession) -> list[tuple[int, int, int]]:
    chain: Apa102 = take(s.chip, Apa102(COUNT))
    return chain.colors()


def test_a_dotstar_chain_shows_its_colours(tmp_path: Path) -> None:
    config = f"[dotstar d]\ndata_pin: PB1\nclock_pin: PB2\nchain_count: {COUNT}\ninitial_RED: 0.2\n"

    def body(s: BusSession) -> None:
        assert colors(s) == [(51, 0, 0)] * COUNT
        s.gcode.run_script("SET_LED LED=d RED=1 GREEN=0.5 BLUE=0.2 INDEX=30")
        s.sleep(0.1)
        assert colors(s) == [(51, 0, 0)] * (COUNT - 1) + [(255, 128, 51)]
        assert s.chip.sent[-1][2] == 200 * FREQ, "in step with the moves"
        assert s.status("dotstar d")["color_data"][-1] == (1.0, 0.5, 0.2, 0.0)
        assert max(len(values[1]) for values in s.chip.messages("spi_send")) <= 50, "a message has 64 bytes"
        wires = [command for command in s.chip.config if command.startswith("spi_set_sw_bus")]
        assert "mosi_pin=PB1 sclk_pin=PB2 mode=0" in wires[0]

    run(tmp_path, config, body)


def test_the_pca9533_gets_the_registers_of_its_data_sheet_s_example() -> None:
    # table 11, but for the prescaler of LED2, which there blinks: E1h is on, off, PWM0, PWM1
    assert pca9533.registers((1.0, 0.0, 64 / 255, 128 / 255)) == bytes([0, 64, 0, 128, 0xE1])


@pytest.mark.parametrize(
    ("command", "duties"),
    [
        ("RED=1 BLUE=0.25", [1.0, 0.0, 0.25, 0.0]),
        ("RED=0.5 GREEN=0.25 BLUE=1", [0.5, 0.25, 1.0, 0.0]),
        # three levels in between: the middle one becomes its nearer neighbour
        ("RED=0.2 GREEN=0.7 BLUE=0.8 WHITE=1", [0.2, 0.8, 0.8, 1.0]),
        ("", [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_a_pca9533_shows_two_brightnesses_in_between(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, duties: list[float]
) -> None:
    attach(monkeypatch, on_i2c(lambda written, count: b""))

    def body(s: BusSession) -> None:
        assert take(s.chip, Pca9533()).duties() == [0.0, 1.0, 0.0, 0.0]
        s.gcode.run_script(f"SET_LED LED=d {command} SYNC=0")
        s.sleep(0.1)
        assert take(s.chip, Pca9533()).duties() == pytest.approx(duties, abs=1.0 / 255.0)
        assert "address=98" in s.chip.config[-1]

    run(tmp_path, "[pca9533 d]\ninitial_GREEN: 1\n", body)


def test_a_pca9632_shows_its_colours_in_the_order_of_its_leds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attach(monkeypatch, on_i2c(lambda written, count: b""))

    def body(s: BusSession) -> None:
        assert take(s.chip, Pca9632()).duties() == pytest.approx([0.0, 0.0, 0.5, 0.0], abs=1.0 / 255.0)
        s.gcode.run_script("SET_LED LED=d RED=0.25 WHITE=1")
        s.sleep(0.1)
        assert take(s.chip, Pca9632()).duties() == pytest.approx([0.0, 1.0, 0.25, 0.0], abs=1.0 / 255.0)
        assert any(c.startswith("i2c_set_sw_bus oid=0 scl_pin=PB1 sda_pin=PB2") for c in s.chip.config)

    run(tmp_path, "[pca9632 d]\nscl_pin: PB1\nsda_pin: PB2\ncolor_order: BWRG\ninitial_RED: 0.5\n", body)


def test_a_chip_that_does_not_answer_does_not_stop_the_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    attach(monkeypatch, on_i2c(lambda written, count: None))

    def body(s: BusSession) -> None:
        s.gcode.run_script("SET_LED LED=d RED=1")
        s.sleep(0.1)
        assert s.state[1] == "ready"
        assert "pca9533 d: the LEDs could not be set" in caplog.text

    run(tmp_path, "[pca9533 d]\n", body)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[dotstar d]\ndata_pin: PB1\n", ("clock_pin", "dotstar d")),
        ("[dotstar d]\ndata_pin: PB1\nclock_pin: PB2\nchain_count: 0\n", ("chain_count", "line 4")),
        ("[pca9632 d]\ncolor_order: RGB\n", ("color_order", "pca9632 d", "line 2", "RGBW")),
        ("[pca9533 d]\ninitial_RED: 2\n", ("initial_red", "line 2")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason.replace("initial_RED", "initial_red") for word in words), reason
