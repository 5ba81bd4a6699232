"""Digital potentiometers and DACs: the resistance or voltage that their data sheets make of the frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from bus_devices import Ad5206, Dac084S085, Mcp4018, Mcp4451, Mcp4728, frames, take
from bus_rig import BusSession, run, start_error


def test_ad5206_channels_have_their_share_of_the_resistance(tmp_path: Path) -> None:
    config = "[ad5206 d]\nenable_pin: PB1\nscale: 2.08\nchannel_1: 1.34\nchannel_6: 2.08\nchannel_4: 0\n"

    def body(s: BusSession) -> None:
        shares = take(s.chip, Ad5206()).shares
        # one of 256 positions; 2.08 is the last position, one step below the whole
        assert shares == pytest.approx({0: 1.34 / 2.08, 5: 1.0, 3: 0.0}, abs=1.0 / 256.0)
        assert "config_spi oid=0 pin=PB1 cs_active_high=0" in s.chip.config

    run(tmp_path, config, body)


def test_dac084s085_outputs_change_at_once_at_the_falling_edge(tmp_path: Path) -> None:
    config = "[dac084S085 d]\nenable_pin: PB1\nscale: 2.5\nchannel_A: 1.5\nchannel_B: 0\nchannel_D: 2.5\n"

    def body(s: BusSession) -> None:
        shares = take(s.chip, Dac084S085()).shares
        assert shares == pytest.approx({"A": 0.6, "B": 0.0, "D": 1.0}, abs=1.0 / 256.0)
        assert any(
            command.startswith("spi_set_bus oid=0") and " mode=1 " in command for command in s.chip.config
        )

    run(tmp_path, config, body)


def test_mcp4451_wipers_reach_from_end_to_end(tmp_path: Path) -> None:
    config = (
        "[mcp4451 d]\ni2c_address: 44\nscale: 2.25\nwiper_0: 0\nwiper_1: 1\nwiper_2: 2.25\nwiper_3: 0.5\n"
    )

    def body(s: BusSession) -> None:
        shares = take(s.chip, Mcp4451()).shares
        assert shares == pytest.approx({0: 0.0, 1: 1 / 2.25, 2: 1.0, 3: 0.5 / 2.25}, abs=0.5 / 256.0)
        assert "address=44" in s.chip.config[-1]

    run(tmp_path, config, body)


@pytest.mark.parametrize("names", [("scl_pin", "sda_pin"), ("i2c_software_scl_pin", "i2c_software_sda_pin")])
def test_mcp4018_is_reached_over_two_pins(tmp_path: Path, names: tuple[str, str]) -> None:
    scl, sda = names
    config = "".join(
        f"[mcp4018 {name}]\n{scl}: PB1\n{sda}: {pin}\nwiper: 0.5\nscale: 0.773\n"
        for name, pin in (("x", "PB2"), ("y", "PB3"))
    )

    def body(s: BusSession) -> None:
        assert take(s.chip, Mcp4018()).share == pytest.approx(0.5 / 0.773, abs=0.5 / 127.0)
        lines = [command for command in s.chip.config if command.startswith("i2c_set_sw_bus")]
        assert [line.split()[2:4] for line in lines] == [
            ["scl_pin=PB1", "sda_pin=PB2"],
            ["scl_pin=PB1", "sda_pin=PB3"],
        ]
        assert all(line.endswith("address=47") for line in lines)

    run(tmp_path, config, body)


def test_mcp4728_voltages_are_of_its_own_reference(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        dac = take(s.chip, Mcp4728())
        assert dac.volts == pytest.approx({0: 1.024, 3: 2.048}, abs=0.00051)  # a step
        assert not dac.is_eeprom_written

    run(tmp_path, "[mcp4728 d]\nchannel_a: 0.5\nchannel_d: 1\n", body)


def test_mcp4018_is_set_again_by_a_command(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.answers["i2c_transfer"] = lambda values: {"i2c_bus_status": "SUCCESS", "response": b""}
        s.gcode.run_script("SET_DIGIPOT DIGIPOT=x WIPER=1.5")
        assert take(s.chip, Mcp4018()).share == pytest.approx(0.75, abs=0.5 / 127.0)

    run(tmp_path, "[mcp4018 x]\nwiper: 0.5\nscale: 2\n", body)


def test_channels_without_a_value_are_left_alone(tmp_path: Path) -> None:
    run(tmp_path, "[mcp4728 d]\n", lambda s: frames(s.chip, 0) == [] or pytest.fail("a channel was set"))


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (
            "[ad5206 d]\nenable_pin: PB1\nscale: 2\nchannel_2: 2.1\n",
            ("channel_2", "ad5206 d", "line 4", "2.0"),
        ),
        ("[ad5206 d]\n", ("enable_pin", "ad5206 d")),
        ("[mcp4451 d]\nwiper_0: 1\n", ("i2c_address", "mcp4451 d")),
        ("[mcp4451 d]\ni2c_address: 200\n", ("i2c_address", "line 2", "127")),
        ("[mcp4728 d]\nscale: 0\n", ("scale", "line 2")),
        ("[mcp4018 d]\nscl_pin: PB1\nsda_pin: PB2\n", ("wiper", "mcp4018 d")),
        ("[dac084S085 d]\nenable_pin: PB1\nchannel_A: -1\n", ("channel_A", "line 3")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
