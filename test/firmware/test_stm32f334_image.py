"""The STM32F334 image as a file: it builds, fits, is the same every time, and holds nothing it must not hold."""

from __future__ import annotations

import hashlib
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import check_registers
import chip_rig
import firmware_size
import seal_firmware
from chip_rig import Firmware
from simulation.builds import Build, make_build
from tiny_chip import Tiny

ROOT = Path(__file__).resolve().parents[2]
KIB = 1024


@pytest.fixture(scope="module")
def build() -> Build:
    return make_build("stm32f334")


@pytest.fixture(scope="module")
def image(build: Build) -> Path:
    assert build.image is not None
    return build.image


def tool(name: str, *args: str) -> str:
    run = subprocess.run([f"arm-none-eabi-{name}", *args], capture_output=True, text=True, check=True)
    return run.stdout


# ---------------------------------------------------------------- size


def test_flash_and_memory_are_within_what_was_promised(image: Path) -> None:
    sizes = firmware_size.measure(image, 0)
    assert 20 * KIB < sizes.flash <= 56 * KIB
    assert sizes.static > KIB and sizes.arena >= 6 * KIB and sizes.stack == 2 * KIB
    assert sizes.ram <= 11 * KIB


def test_the_size_report_names_what_is_over_budget(image: Path) -> None:
    sizes = firmware_size.measure(image, 0)
    record = {"budget": {"flash": sizes.flash - 1, "ram": sizes.ram}, "release": {"flash": sizes.flash - 100}}
    lines = firmware_size.report("stm32f334", sizes, record)
    assert any("+100" in line for line in lines)
    assert [line for line in lines if line.startswith("over")] == [
        f"over budget: flash is {sizes.flash} bytes, {sizes.flash - 1} are allowed"
    ]


def test_two_builds_in_two_places_are_one_image(tmp_path: Path) -> None:
    """Nothing of time or place gets into it."""
    hashes = set()
    for name in ("first", "second/deeper"):
        out = tmp_path / name
        command = ["make", "-s", "PORT=stm32f334", f"OUT={out}", "FERRITE_VERSION=test", "firmware"]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        for file in ("ferrite.elf", "ferrite.bin"):
            hashes.add((file, hashlib.sha256((out / "stm32f334" / file).read_bytes()).hexdigest()))
    assert len(hashes) == 2


# ---------------------------------------------------------------- what must not be in it


def test_no_division_helper_no_heap_no_floating_point(image: Path) -> None:
    """Not reachable from an interrupt because not there at all: 32-bit divisions are instructions of this chip."""
    symbols = set(re.findall(r"\w+$", tool("nm", str(image)), re.MULTILINE))
    assert {"samples_irq", "timer_irq", "sched_guarded"} <= symbols
    helpers = re.compile(
        r"__aeabi_\w*(div|mod|[df](add|mul|2))|__u?(div|mod)\w*[sd]i|malloc|free|_?sbrk|calloc|printf"
    )
    assert [name for name in symbols if helpers.match(name)] == []


def functions_of(image: Path) -> dict[str, list[str]]:
    """Instructions of each function."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in tool("objdump", "-d", "--no-show-raw-insn", str(image)).splitlines():
        head = re.match(r"[0-9a-f]+ <(\w[\w.]*)>:", line)
        if head:
            name = head[1]
            found[name] = []
        elif name and "\t" in line:
            found[name].append(line.split("\t", 1)[1])
    return found


def test_sums_are_made_with_dual_instructions(image: Path) -> None:
    everything = "\n".join(line for lines in functions_of(image).values() for line in lines)
    for instruction in ("smlad", "usub16", "sel"):
        assert re.search(rf"^{instruction}\b", everything, re.MULTILINE), instruction


def test_every_interrupt_that_nobody_serves_ends_in_the_stop_handler(image: Path) -> None:
    flash = seal_firmware.flash_image(image.read_bytes())
    _, symbols = firmware_size.read_elf(image.read_bytes())
    vectors = struct.unpack_from("<98I", flash)
    assert vectors[0] == symbols["stack_top"] == 0x10000800
    served = {
        11: "samples_irq",
        17: "console_sent_irq",
        18: "adc_irq",
        28: "timer_irq",
        38: "console_irq",
        73: "bridge_fault_irq",
    }
    for position, vector in enumerate(vectors[16:]):
        assert vector == symbols[served.get(position, "stop_handler")], position
    assert vectors[2] == symbols["nmi_handler"] and vectors[3] == symbols["stop_handler"]


# ---------------------------------------------------------------- the seal


def test_the_seal_is_the_checksum_of_all_before_it(image: Path) -> None:
    flash = seal_firmware.flash_image(image.read_bytes())
    magic, words, crc = struct.unpack("<3I", flash[-12:])
    assert magic == seal_firmware.MAGIC and words * 4 == len(flash) - 12
    assert crc == seal_firmware.crc_of_words(flash[:-12])


def test_the_checksum_is_that_of_the_chips_unit() -> None:
    """RM0364's unit: four bytes 0x00 give 0xc704dd7b, a published value of CRC-32/MPEG-2."""
    assert seal_firmware.crc_of_words(bytes(4)) == 0xC704DD7B


def test_an_image_with_one_wrong_bit_shuts_down_and_says_so(
    build: Build, image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elf = bytearray(image.read_bytes())
    _, symbols = firmware_size.read_elf(bytes(elf))
    segment = seal_firmware.load_segments(bytes(elf))[0]
    elf[segment.offset + symbols["identify_data"] - segment.address + 100] ^= 0x10
    damaged = tmp_path / "damaged.elf"
    damaged.write_bytes(elf)
    monkeypatch.setattr(chip_rig, "make_build", lambda name: replace(build, image=damaged))
    chip = Firmware()
    assert chip.shutdown_reason() == "Firmware image in flash is damaged"
    assert chip.ask("get_config")["is_shutdown"] == 1


# ---------------------------------------------------------------- what it does by itself


ROM = 0x1FFFD800  # AN2606: the STM32F334's boot loader; the model has two idle instructions there


def reset_and_boot(chip: Firmware) -> None:
    """What the chip asked for happens: the world's part of a reset."""
    chip.run(0.01)
    assert chip.lib.sim_mcu_take_reset()
    chip.lib.sim_mcu_boot(chip.board, chip.now)
    chip.sequence = 0
    chip.run(0.05)


def test_the_request_for_the_boot_loader_resets_and_jumps_into_it() -> None:
    chip = Firmware()
    chip.raw(b"~ \x1c Request Serial Bootloader! ~")  # not quite
    assert chip.ask("get_config")["is_config"] == 0
    assert chip.chip.counters()["resets"] == 0
    chip.raw(b"~ \x1c Request Serial Bootloader!! ~")
    assert chip.chip.peek("=boot_request") == int.from_bytes(b"boot", "big")
    reset_and_boot(chip)
    assert chip.chip.counters()["resets"] == 1
    assert ROM <= chip.chip.peek("cpu.pc") < ROM + 0x2000
    assert chip.chip.peek("cpu.sp") == 0x20000800  # the word at the ROM's beginning
    assert chip.chip.peek("cpu.primask") == 0  # as a reset leaves it: the loader may use interrupts
    assert chip.chip.peek("syscfg.remap") & 3 == 1  # system memory at address 0
    # It is asked for once: the next reset starts the firmware, and the watchdog has not bitten the loader meanwhile.
    chip.run(2.0)
    assert chip.chip.counters()["resets"] == 1
    chip.lib.sim_mcu_boot(chip.board, chip.now)
    chip.run(0.05)
    assert chip.ask("get_config")["is_config"] == 0


def test_a_restart_by_command_comes_back_as_firmware() -> None:
    """FIRMWARE_RESTART: the `reset` command, no boot loader, nothing configured any more."""
    chip = Firmware()
    chip.configure(0)
    assert chip.ask("get_config")["is_config"] == 1
    chip.send("reset")
    reset_and_boot(chip)
    assert chip.ask("get_config")["is_config"] == 0
    assert chip.chip.counters()["resets"] == 1


def test_an_output_on_a_pin_without_the_hardware_shuts_down_and_no_more() -> None:
    """The half-made object is put into its safe state like any other: nothing is written to address 0."""
    chip = Firmware()
    chip.send("allocate_oids", count=1)
    pwm = {"pin": 18, "cycle_ticks": 72000, "value": 0, "default_value": 0, "max_duration": 0}
    chip.send("config_pwm_out", oid=0, **pwm)
    assert chip.shutdown_reason() == "Not a valid PWM pin"
    assert chip.ask("get_config")["is_shutdown"] == 1


# ---------------------------------------------------------------- registers


@pytest.mark.parametrize(
    ("right", "wrong", "named"),
    [
        ("TIM_CCR1(tim) R(tim, 0x34)", "TIM_CCR1(tim) R(tim, 0x38)", "TIM_CCR1"),
        ("RCC_CR_PLLON BIT(24)", "RCC_CR_PLLON BIT(25)", "RCC_CR_PLLON"),
        ("FIELD(v, 16, 9)", "FIELD(v, 16, 8)", "HRTIM_TIM_DT_DTF"),
        ("SPI1_BASE 0x40013000u", "SPI1_BASE 0x40013400u", "SPI1"),
        ("IRQ_TIM2 = 28", "IRQ_TIM2 = 29", "IRQ_TIM2"),
    ],
)
def test_a_wrong_register_is_found(
    right: str, wrong: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_registers.main([]) == 0
    header = (ROOT / "src/stm32f334/regs.h").read_text()
    assert right in header
    changed = tmp_path / "regs.h"
    changed.write_text(header.replace(right, wrong))
    assert check_registers.main(["--header", str(changed)]) == 1
    assert named in capsys.readouterr().err


# ---------------------------------------------------------------- the kernel


KERNEL = """
struct reduction { uint32_t sum, low, high; };
#include "port_oversample.h"
static uint16_t data[96] __attribute__((aligned(4)));
static void check(unsigned from, unsigned count)
{
    uint16_t lowest = 0xffff, highest = 0;
    uint32_t plain = 0;
    struct reduction r;
    reduction_begin(&r);
    unsigned first = count / 3; /* in two runs */
    reduction_add(&r, data + from, first);
    reduction_add(&r, data + from + first, count - first);
    for (unsigned i = from; i < from + count; i++) {
        plain += data[i];
        lowest = data[i] < lowest ? data[i] : lowest;
        highest = data[i] > highest ? data[i] : highest;
    }
    result[1]++;
    if (r.sum != plain || reduction_min(&r) != lowest || reduction_max(&r) != highest)
        result[0]++;
}
"""


def test_the_chips_kernel_gives_what_a_plain_loop_gives(tmp_path: Path) -> None:
    """Every length to 80 from an even and an odd place; extremes at any place in their words."""
    shutil.copy(ROOT / "src/stm32f334/port_oversample.h", tmp_path)
    program = """
    uint32_t seed = 1;
    for (unsigned i = 0; i < 96; i++) {
        seed = seed * 1664525u + 1013904223u;
        data[i] = seed >> 20;
    }
    data[40] = 0;
    data[43] = 4095;
    for (unsigned count = 0; count <= 80; count++)
        for (unsigned from = 0; from < 4; from++)
            check(from, count);
    """
    chip = Tiny(tmp_path, program, KERNEL)
    chip.run(0.05)
    assert not chip.fault()
    assert chip.chip.peek("=result") == 0
    # The chip really ran them, and a wrong kernel is seen.
    broken = (
        (tmp_path / "port_oversample.h")
        .read_text()
        .replace("sel %[low], r5, %[low]", "sel %[low], %[low], r5")
    )
    (tmp_path / "port_oversample.h").write_text(broken)
    chip = Tiny(tmp_path, program, KERNEL)
    chip.run(0.05)
    assert chip.chip.peek("=result") > 100


# ---------------------------------------------------------------- options


def test_without_a_choice_the_options_are_those_of_kconfig(tmp_path: Path) -> None:
    """port.mk's defaults and Kconfig's are written twice: they must be the same."""
    import kconfiglib

    config = tmp_path / "config"
    run = subprocess.run(
        [sys.executable, "-m", "alldefconfig", "Kconfig"],
        env={"srctree": str(ROOT / "src"), "KCONFIG_CONFIG": str(config), "PATH": "/usr/bin:/bin"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0 and kconfiglib, run.stderr

    def commands(*args: str) -> list[str]:
        command = ["make", "-n", f"OUT={tmp_path / 'out'}", "FERRITE_VERSION=test", *args, "firmware"]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        return [line for line in run.stdout.splitlines() if "arm-none-eabi-gcc" in line]

    plain = commands("PORT=stm32f334", "KCONFIG_CONFIG=/dev/null")
    chosen = commands(f"KCONFIG_CONFIG={config}")
    assert len(plain) > 40 and plain == chosen
    config.write_text(config.read_text().replace("DEAD_TIME_NS=200", "DEAD_TIME_NS=350"))
    assert any("CONFIG_DEAD_TIME_NS=350" in line for line in commands(f"KCONFIG_CONFIG={config}"))


def test_flashing_is_openocds_with_the_boards_own_settings() -> None:
    run = subprocess.run(
        ["make", "-n", "PORT=stm32f334", "flash"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "openocd -f board/st_nucleo_f3.cfg" in run.stdout and "ferrite.elf verify reset" in run.stdout
