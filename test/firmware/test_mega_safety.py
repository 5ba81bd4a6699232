"""What keeps a printer on an ATmega2560 safe when something goes wrong: watchdog, brown-out, memory, interrupts.

Outputs end with a reset: every pin of the chip becomes an input (datasheet 13.2.3), a heater's driver has its own
pull-down.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from chip_rig import make_build
from mega_rig import MEGA_HZ, STEP_PINS, Mega, run_steps, stepping

ROOT = Path(__file__).resolve().parents[2]
HEATER = 12  # PB4
TIMSK5 = 0x73
STACK_SHARE_MAX = 0.75


def heating() -> Mega:
    """A heater switched on, for as long as the host keeps talking or longer."""
    mega = Mega()
    heater = {"oid": 0, "pin": HEATER, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(1, ("config_digital_out", heater))
    mega.send("queue_digital_out", oid=0, clock=mega.clock_in(0.02), on_ticks=1)
    mega.run(0.05)
    assert mega.edges(HEATER)[-1][1] == 1
    return mega


def stands_there_as_new(mega: Mega) -> None:
    """After a reset: nothing configured, nothing driven, and it stays so."""
    writes = len(mega.pin_writes)
    mega.boot_again()
    assert mega.ask("get_config")["is_config"] == 0
    mega.run(2.0)
    assert mega.lib.sim_mcu_take_reset() == 0 and len(mega.pin_writes) == writes


# ---------------------------------------------------------------- watchdog and supply


def test_a_main_loop_that_is_not_woken_any_more_is_reset_within_its_half_second() -> None:
    mega = heating()
    begin = mega.now
    mega.send("debug_write", order=0, addr=TIMSK5, val=0)  # no timer is ever called again
    while not mega.chip.counters()["resets"] and mega.now < begin + MEGA_HZ:
        mega.run(0.01)
    # 64 K cycles of 128 kHz, from the last pass of the main loop on
    assert 0.4 * MEGA_HZ < mega.now - begin < 0.56 * MEGA_HZ
    assert mega.lib.sim_mcu_take_reset() == 1
    stands_there_as_new(mega)


def test_a_supply_that_dips_ends_in_a_chip_that_does_nothing() -> None:
    """The fuse's brown-out level (Arduino: 2.7 V); what was configured is forgotten though memory has survived."""
    mega = heating()
    mega.chip.mutate("brown_out")
    assert mega.lib.sim_mcu_take_reset() == 1
    stands_there_as_new(mega)


# ---------------------------------------------------------------- memory


def sample_values(mega: Mega, name: str) -> dict[str, int | bytes]:
    """Something for every parameter."""
    return {
        key: b"" if kind.endswith("s") else int(key != "oid")
        for key, kind in mega.dictionary.commands[name].params
    }


ALLOCATING = re.compile(
    r"config_\w+|allocate_oids|(spi|i2c)_set_(sw_)?bus|set_digital_out_pwm_cycle|buttons_add"
)


def test_nothing_is_allocated_after_finalize_config() -> None:
    names = [name for name in Mega().dictionary.commands if re.fullmatch(ALLOCATING, name)]
    assert len(names) > 14
    for name in names:
        mega = Mega()
        mega.configure(1, ("config_trsync", {"oid": 0}))
        mega.send(name, **sample_values(mega, name))
        mega.run(0.01)
        assert mega.shutdown_reason() in {
            "Can't assign oid",
            "oids already allocated",
            "Already finalized",
            "Invalid oid type",
        }, name


def test_memory_is_taken_in_one_place_only() -> None:
    """arena_take() has two callers: objects before finalize_config, the moves in it."""
    text = (ROOT / "src" / "basecmd.c").read_text()
    bodies = re.split(r"^(?=\w+\(.*\)$)", text, flags=re.M)
    callers = {body.split("(")[0] for body in bodies if re.search(r"[^\n]\barena_take\(", body)}
    assert callers == {"alloc_chunk", "moves_allocate"}
    elsewhere = [
        path.name
        for path in ROOT.glob("src/*.c")
        if re.search(r"\b[cm]alloc\(|board_arena\(", path.read_text())
    ]
    assert elsewhere == ["basecmd.c"]


def test_stack_keeps_a_quarter_free_with_all_that_is_deep_at_once() -> None:
    """The longest answer being made of an I2C transfer, steppers on top of it, a byte's interrupt on top of them."""
    mega = stepping(3)
    counters = mega.chip.counters()
    space = counters["stack_top"] - counters["stack_limit"]
    mega = Mega()
    steppers = [
        ("config_stepper", {"oid": oid, "step_pin": step, "dir_pin": direction, "invert_step": 0xFF,
                            "step_pulse_ticks": 0})
        for oid, (step, direction) in enumerate(STEP_PINS[:3])
    ]  # fmt: skip
    bus = {"oid": 3, "i2c_bus": 0, "rate": 400_000, "address": 0x48}
    mega.configure(4, *steppers, ("config_i2c", {"oid": 3}), ("i2c_set_bus", bus))
    run_steps(mega, 3, 60000, 1)
    clock = mega.clock_in(0.05)
    for oid in range(3):
        mega.send("reset_step_clock", oid=oid, clock=clock)
        mega.send("queue_step", oid=oid, interval=2400, count=3000, add=0)
    mega.run(0.06)
    for _ in range(10):
        answer = mega.ask("i2c_transfer", oid=3, write=bytes(40), read_len=54)
        assert len(answer["response"]) == 54
    assert [len(mega.edges(pin)) > 1000 for pin, _ in STEP_PINS[:3]] == [True] * 3
    counters = mega.chip.counters()
    used = counters["stack_top"] - counters["stack_low"]
    assert space / 2 < used < STACK_SHARE_MAX * space


# ---------------------------------------------------------------- interrupts


OPTIONAL_TIMERS = {
    "CONFIG_LOAD_CELLS": "load_cell_event",
    "CONFIG_EDDY_PROBES": "ldc1612_event",
    "CONFIG_ANGLE_SENSORS": "angle_event",
}


def image_with_all_options(folder: Path) -> Path:
    variables = [f"OUT={folder}", "KCONFIG_CONFIG=/dev/null", *(f"{name}=y" for name in OPTIONAL_TIMERS)]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    subprocess.run(["make", "-s", "PORT=atmega2560", *variables, "firmware"], cwd=ROOT, env=clean, check=True)
    return folder / "atmega2560" / "ferrite.elf"


@pytest.mark.parametrize("with_all_options", [False, True])
def test_no_division_and_no_allocation_is_in_the_interrupts(tmp_path: Path, with_all_options: bool) -> None:
    image = image_with_all_options(tmp_path) if with_all_options else make_build("atmega2560").image
    code = subprocess.run(
        ["avr-objdump", "-d", str(image)], capture_output=True, text=True, check=True
    ).stdout
    assert "<malloc>" not in code and "<free>" not in code
    called: dict[str, set[str]] = {}
    for name, body in re.findall(r"^\w+ <([^>]+)>:\n((?:.+\n)+)", code, re.M):
        called[name] = set(re.findall(r"(?:call|jmp)\s+\S+\s*;.*<([\w.]+)", body))
    # what interrupts run: their handlers, and the timers' functions, which are called through pointers
    timers = {
        match
        for path in ROOT.glob("src/*.c")
        for match in re.findall(r"^static uint8_t\n(\w+)\(struct timer \*t\)", path.read_text(), re.M)
    } - {"phase_timer"}  # the bridge's, which is not here
    if not with_all_options:
        timers -= set(OPTIONAL_TIMERS.values())
    roots = [name for name in called if name.startswith("__vector_") or name.split(".")[0] in timers]
    assert {name.split(".")[0] for name in roots} >= timers and len(timers) > 10
    reached: set[str] = set()
    while roots:
        name = roots.pop()
        if name not in reached and name != "main":
            reached.add(name)
            roots += called.get(name, ())
    # shutdown() is left by a jump, not by a return; nothing behind it is part of an interrupt
    assert not {name for name in reached if re.match(r"__u?(div|mod)", name)}
