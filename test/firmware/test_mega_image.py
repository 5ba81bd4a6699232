"""The ATmega2560's image: how it is built, that it boots, answers, and keeps its line in order."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chip_rig import make_build
from mcu_harness import make_block
from mega_rig import MEGA_HZ, Mega, stepping
from simulation.runner import BAD_INPUT, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
IDENTIFY_0_40 = bytes.fromhex("08100100285e9f7e")
ACK_1 = bytes.fromhex("05118f087e")
FLASH_BUDGET = 40 * 1024  # of 256 KiB; the first 64 KiB hold all tables, which plain LPM reads
STATIC_RAM_BUDGET = 1024  # of 8 KiB: the rest is stack and what the host configures


@pytest.fixture
def mega() -> Mega:
    return Mega()


# ---------------------------------------------------------------- building


def sections() -> dict[str, int]:
    build = make_build("atmega2560")
    text = subprocess.run(
        ["avr-size", "-A", str(build.image)], capture_output=True, text=True, check=True
    ).stdout
    return {name: int(size) for name, size in re.findall(r"^(\.\w+)\s+(\d+)", text, re.M)}


def test_image_fits_its_budget_of_flash_and_ram() -> None:
    size = sections()
    assert size[".text"] + size[".data"] <= FLASH_BUDGET
    assert size[".data"] + size[".bss"] <= STATIC_RAM_BUDGET


# ---------------------------------------------------------------- what it can and cannot


def test_boots_and_says_what_it_is(mega: Mega) -> None:
    assert [(reply.name, reply.sequence) for reply in mega.replies()] == [("starting", 0)]
    dictionary = mega.identify()
    assert dictionary == json.loads(make_build("atmega2560").dictionary.read_text())
    assert dictionary["config"]["MCU"] == "atmega2560" and dictionary["config"]["CLOCK_FREQ"] == MEGA_HZ
    assert mega.chip.counters()["console_baud"] == dictionary["config"]["SERIAL_BAUD"] == 250000


def test_it_has_no_bridge_and_the_host_says_so(tmp_path: Path) -> None:
    commands = make_build("atmega2560").dictionary.read_text()
    assert "induction" not in json.dumps(list(json.loads(commands)["commands"]))
    part = tmp_path / "part.gcode"
    part.write_text("G28\n")
    outcome = Simulation(
        RunOptions(ROOT / "config" / "sim-induction.cfg", part, builds={"mcu": "atmega2560"})
    ).run()
    assert outcome.status == BAD_INPUT
    assert re.search(r"command '\w*induction\w*', which its firmware .* does not have", outcome.reason)


def test_it_has_no_temperature_of_its_own_and_the_host_says_so(tmp_path: Path) -> None:
    config, part = tmp_path / "printer.cfg", tmp_path / "part.gcode"
    base = ROOT / "config" / "sim-mega.cfg"
    config.write_text(f"[include {base}]\n[temperature_sensor board]\nsensor_type: temperature_mcu\n")
    part.write_text("G28\n")
    outcome = Simulation(RunOptions(config, part)).run()
    assert outcome.status == BAD_INPUT
    assert outcome.reason == (
        "Sensor 'board': the firmware of mcu 'mcu' does not offer its chip's own temperature"
        " (there is no pin ADC_TEMPERATURE)"
    )


def test_memory_left_makes_a_move_queue_of_some_hundred() -> None:
    # four steppers and nothing else: 6.9 KiB of 12-byte entries; a whole printer leaves 476
    assert stepping(4).ask("get_config")["move_count"] > 540


# ---------------------------------------------------------------- the wire


def test_identify_is_answered_and_acknowledged_byte_for_byte(mega: Mega) -> None:
    answer = mega.raw(IDENTIFY_0_40)
    assert answer.endswith(ACK_1) and answer[:5] == bytes.fromhex("3011000028") and len(answer) == 0x30 + 5


@pytest.mark.parametrize("bad", [IDENTIFY_0_40, make_block(5, b""), IDENTIFY_0_40[:-3] + b"\x5e\x9e\x7e"])
def test_wrong_turn_or_checksum_is_answered_by_a_nak(mega: Mega, bad: bytes) -> None:
    mega.raw(IDENTIFY_0_40)
    assert mega.raw(bad) == ACK_1


def test_one_error_burst_gets_one_nak(mega: Mega) -> None:
    assert mega.raw(b"\xff" * 200) == b""
    assert mega.raw(b"\x7e") == make_block(0, b"")
    assert mega.raw(IDENTIFY_0_40)[-5:] == ACK_1


def test_good_block_inside_the_bytes_of_a_bad_one_is_found(mega: Mega) -> None:
    answer = mega.raw(b"\x40\x10\x55\x7e" + IDENTIFY_0_40 + b"\x7e" * 60)
    assert answer.endswith(ACK_1) and len(mega.replies("identify_response")) == 1


@pytest.mark.parametrize("value", [0, 95, 96, -32 & 0xFFFFFFFF, 12287, 2**31 - 1, 2**31, 2**32 - 1])
def test_numbers_survive_the_way_there_and_back(mega: Mega, value: int) -> None:
    mega.send("allocate_oids", count=0)
    mega.send("finalize_config", crc=value)
    assert mega.ask("get_config")["crc"] == value


SHARED = Mega()
DAMAGE = st.sampled_from(["none", "flip", "cut", "twice", "insert"])


@given(plan=st.lists(st.tuples(DAMAGE, st.integers(0, 60), st.integers(1, 255)), min_size=1, max_size=8))
@settings(max_examples=25, deadline=None)
def test_damaged_blocks_are_executed_once_and_in_order(plan: list[tuple[str, int, int]]) -> None:
    mega = SHARED
    before = len(mega.replies("pong"))
    for index, (damage, place, value) in enumerate(plan):
        block = make_block(mega.sequence, mega.encode("debug_ping", data=bytes([index])))
        at = place % len(block)
        mangled = {
            "none": block,
            "flip": block[:at] + bytes([block[at] ^ value]) + block[at + 1 :],
            "cut": block[:at],
            "twice": block + block,
            "insert": block[:at] + bytes([value]) + block[at:],
        }[damage]
        mega.raw(mangled)
        for _ in range(
            8
        ):  # as a host does: again, with a sync byte first; a wrong length takes 64 bytes with it
            mega.raw(b"\x7e" + block)
        mega.sequence = (mega.sequence + 1) & 15
    pongs = [reply["data"] for reply in mega.replies("pong")[before:]]
    assert pongs == [bytes([index]) for index in range(len(plan))]
    assert mega.chip.counters()["console_overruns"] == 0


def test_byte_strings_and_many_commands_of_one_block_come_back_whole(mega: Mega) -> None:
    content = b"".join(mega.encode("debug_ping", data=bytes([i, 0x7E])) for i in range(8))
    assert [reply["data"] for reply in mega.send_content(content)] == [bytes([i, 0x7E]) for i in range(8)]


# ---------------------------------------------------------------- reset


def test_reset_goes_through_the_watchdog_and_the_chip_starts_afresh(mega: Mega) -> None:
    mega.configure(2)
    mega.raw(make_block(mega.sequence, mega.encode("reset")))
    mega.run(0.03)
    assert mega.lib.sim_mcu_take_reset() == 1 and mega.lib.sim_mcu_take_reset() == 0
    assert mega.chip.counters()["resets"] == 1
    mega.boot_again()
    assert mega.ask("get_config")["is_config"] == 0
    mega.run(2.0)  # and the watchdog, which the reset leaves on at 15 ms, has been tamed
    assert mega.lib.sim_mcu_take_reset() == 0 and mega.ask("get_uptime")["high"] == 0


def test_clock_goes_on_over_the_wraps_of_sixteen_and_thirty_two_bits(mega: Mega) -> None:
    for _ in range(3):
        mega.run(91.0)
        up = mega.ask("get_uptime")
        seen = (up["high"] << 32) + up["clock"]
        # asked some 2 ms ago, on a chip that began to count at once
        assert 0 < mega.now - 1000 - seen < 0.03 * MEGA_HZ
    assert up["high"] == 1
