"""What the STM32F334's model refuses: each line is a mistake a port can make, and what the emulator must say.

The sentences quote RM0364 where it gives the rule. What the model accepts is shown by the firmware that runs on it.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from simulation import world as world_module
from simulation.builds import SIMULATOR, Build
from simulation.world import World, WorldError
from tiny_chip import Tiny, make_emulator

READY = "clock_72(); clocks_on();"
SENSOR_ON = "adc_regulator(); R(ADC + 0x308) |= 1 << 23; adc_start(); wait(2000);"
INJECT_SENSOR = "R(ADC + 0x4c) = 16 << 8; R(ADC + 8) |= 8; wait(500);"

MISTAKES = {
    # --- nothing there, or not clocked ---
    "memory": ("R(0x60000000) = 1;", "a write to 0x60000000"),
    "null": ("result[0] = R(4 + (uint32_t)result[0]);", "a read at 0x00000004"),
    "flash": ("R(0x08000100) = 1;", "a write to 0x08000100"),
    "unknown_block": ("R(0x40009000) = 1;", "no peripheral is modelled"),
    "unknown_register": (READY + "R(TIM2 + 0x60) = 1;", "TIM2 + 0x60"),
    "clock_off": ("R(TIM2) = 1;", "TIM2 (0x40000000) while its clock is off"),
    "reserved_clock": ("R(RCC + 0x14) |= 1 << 21;", "reserved or not modelled"),
    "vector": ("R(NVIC) = 1 << 28; R(NVIC + 0x100) = 1 << 28;", "no handler"),
    "no_such_interrupt": ("R(NVIC + 4) = 1 << 12;", "does not have"),
    "undefined_instruction": ('__asm__ volatile("udf #0");', "Invalid instruction"),
    "stack": (
        '__asm__ volatile("mov sp, %0" :: "r"(0x20002c10)); R(NVIC) = 1 << 28; R(NVIC + 0x100) = 1 << 28;',
        "run over its end",
    ),
    # --- clock tree ---
    "wait_states": (
        "R(RCC) |= 1 << 18; R(RCC) |= 1 << 16; while (!(R(RCC) & 1 << 17)); R(RCC + 4) = 7 << 18 | 1 << 16 | 4 << 8;"
        "R(RCC) |= 1 << 24; while (!(R(RCC) & 1 << 25)); R(RCC + 4) |= 2;",
        "wait states",
    ),
    "pll_unlocked": ("R(RCC + 4) = 7 << 18; R(RCC) |= 1 << 24; R(RCC + 4) |= 2;", "before it has locked"),
    "apb1_too_fast": (
        "R(FLASH_ACR) = 0x12; R(RCC) |= 1 << 18; R(RCC) |= 1 << 16; while (!(R(RCC) & 1 << 17));"
        "R(RCC + 4) = 7 << 18 | 1 << 16; R(RCC) |= 1 << 24; while (!(R(RCC) & 1 << 25)); R(RCC + 4) |= 2;",
        "APB1 runs at 72000000",
    ),
    # --- USART ---
    "usart_pins": (
        READY + "R(USART2 + 12) = 144; R(USART2) = 9; R(USART2 + 0x28) = 1;",
        "none of its TX pins",
    ),
    "usart_off": (READY + "R(USART2 + 0x28) = 1;", "while it is off"),
    "usart_full": (
        READY + "R(GPIOA + 0x20) = 0x7700; R(GPIOA) |= 0xa0; R(USART2 + 12) = 144; R(USART2) = 9;"
        "for (int i = 0; i < 3; i++) R(USART2 + 0x28) = 1;",
        "the byte before is lost",
    ),
    # --- DMA ---
    "dma_ccm": (
        READY
        + "R(DMA + 0x0c) = 4; R(DMA + 0x10) = ADC + 0x40; R(DMA + 0x14) = 0x10000000; R(DMA + 8) = 0x581;",
        "CCM",
    ),
    "dma_changed": (
        READY
        + "R(DMA + 0x0c) = 4; R(DMA + 0x14) = 0x20000100; R(DMA + 8) = 0x581; R(DMA + 0x14) = 0x20000200;",
        "while the channel is on",
    ),
    # --- ADC ---
    "adc_regulator": (READY + "R(ADC + 8) = 0; R(ADC + 8) = 1 << 28; R(ADC + 8) |= 1u << 31;", "regulator"),
    "adc_uncalibrated": (READY + "adc_regulator(); R(ADC + 8) |= 1;", "without having been calibrated"),
    "adc_not_ready": (READY + "adc_on(); R(ADC + 8) |= 2; R(ADC + 8) |= 4;", "before ADRDY"),
    "adc_pin": (
        READY + "adc_on(); R(ADC + 0x30) = 1 << 6; R(ADC + 8) |= 4; wait(500);",
        "not in analog mode",
    ),
    "adc_running": (
        READY + "R(GPIOA) |= 3; adc_on(); R(ADC + 0x30) = 1 << 6; R(ADC + 8) |= 4; R(ADC + 0x30) = 2 << 6;",
        "while conversions run",
    ),
    "sensor_off": (READY + "adc_on(); R(ADC + 0x18) = 6 << 18;" + INJECT_SENSOR, "has not been on for 10 us"),
    "sensor_sampling": (READY + SENSOR_ON + "R(ADC + 0x18) = 5 << 18;" + INJECT_SENSOR, "less than 2.2 us"),
    "sensor_late": (READY + "adc_on(); R(ADC + 0x308) |= 1 << 23;", "is changed while a converter is on"),
    "injected_off": (READY + "R(ADC + 0x4c) = 16 << 8;", "while the converter is off"),
    "injected_nothing": (READY + "adc_on(); R(ADC + 8) |= 8;", "without anything in JSQR"),
    "injected_sequence": (READY + "adc_on(); R(ADC + 0x4c) = 16 << 8 | 1;", "reserved or not modelled"),
    "injected_meets_sample": (
        READY + "dll_on(); legs(9600); R(GPIOA) |= 15; adc_on(); R(ADC + 0x14) = 1 << 3 | 7 << 6;"
        "R(ADC + 0x30) = 1 << 6; R(HRTIM_COMMON + 0x3c) = 1 << 4; R(ADC + 0xc) = 7 << 6 | 1 << 10 | 1 << 12;"
        "R(ADC + 0x4c) = 2 << 8; R(ADC + 8) |= 4; R(ADC + 8) |= 8;",  # 614 cycles in a period of 600
        "meets one in step with the bridge",
    ),
    # --- HRTIM ---
    "dll_before_start": (READY + "R(HRTIM) = 8 | 1 << 16;", "before the delay line is calibrated"),
    "dll_before_outputs": (READY + "R(HRTIM_COMMON + 0x14) = 15;", "before the delay line is calibrated"),
    "hrtim_pins": (
        READY + "dll_on(); legs(9600); R(GPIOA) &= ~0xff0000u; R(HRTIM_COMMON + 0x14) = 15;",
        "not in alternate function 13",
    ),
    "dead_time": (
        READY + "dll_on(); legs(9600); R(HRTIM + 0x80 + 0x64) = 0; R(HRTIM_COMMON + 0x14) = 15;",
        "shoot-through",
    ),
    "no_dead_time": (
        READY + "dll_on(); legs(9600); R(HRTIM + 0x80 + 0x38) = 0; wait(2000); R(HRTIM_COMMON + 0x14) = 15;",
        "dead time of leg A is zero",
    ),
    "duty": (
        READY
        + "dll_on(); legs(9600); R(HRTIM + 0x80 + 0x1c) = 9000; wait(2000); R(HRTIM_COMMON + 0x14) = 15;",
        "direct current through the coil",
    ),
    "short_compare": (
        READY
        + "dll_on(); legs(9600); R(HRTIM + 0x80 + 0x1c) = 0x40; wait(2000); R(HRTIM_COMMON + 0x14) = 15;",
        "at least 0x60",
    ),
    "idle_active": (
        READY
        + "dll_on(); legs(9600); R(HRTIM + 0x80 + 0x64) = 1 << 8 | 1 << 3; R(HRTIM_COMMON + 0x14) = 15;",
        "idle level",
    ),
    # --- the rest ---
    "watchdog_key": ("R(IWDG + 8) = 99;", "without the key"),
    "spi_off": (READY + "R8(SPI1 + 0xc) = 1;", "while the SPI is off"),
    "spi_threshold": (READY + "R(SPI1) = 0x344; R8(SPI1 + 0xc) = 1;", "FRXTH"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(tmp_path: Path, name: str) -> None:
    program, sentence = MISTAKES[name]
    tiny = Tiny(tmp_path, program)
    tiny.run(0.01)
    assert sentence in tiny.fault(), tiny.fault() or "the model had nothing to say"
    # a faulted chip stands still
    before = tiny.chip.counters()["instructions"]
    tiny.run(0.01)
    assert tiny.chip.counters()["instructions"] == before


def test_a_fault_says_where(tmp_path: Path) -> None:
    tiny = Tiny(
        tmp_path, "culprit();", "__attribute__((noinline)) static void culprit(void) { R(TIM2) = 1; }"
    )
    tiny.run(0.001)
    assert "(in culprit at 0x0800" in tiny.fault()


def test_the_lag_of_the_legs_is_the_phase(tmp_path: Path) -> None:
    """9600 of 19200 steps are 90 degrees; a change is reported at a period edge, 600 ticks apart."""
    tiny = Tiny(
        tmp_path,
        READY + "dll_on(); legs(9600); R(HRTIM_COMMON + 0x14) = 15; wait(5000); R(HRTIM + 0x1c) = 4800;"
        "wait(5000); R(HRTIM + 0x1c) = 19200; wait(5000); R(HRTIM_COMMON + 0x18) = 15;",
    )
    tiny.run(0.01)
    assert not tiny.fault(), tiny.fault()
    assert [phase for _, phase in tiny.bridge_sets if phase] == [22500, 11250, 45000]
    assert tiny.bridge_sets[-1][1] == 0
    edges = [clock for clock, phase in tiny.bridge_sets if phase in (11250, 45000)]
    assert (edges[1] - edges[0]) % 600 == 0


def test_the_fault_line_takes_the_outputs_off_in_hardware(tmp_path: Path) -> None:
    """FLT1 on PA12, low active; no instruction of the firmware is needed."""
    tiny = Tiny(
        tmp_path,
        READY + "dll_on(); legs(9600); R(GPIOA + 0x24) |= 0xd << 16; R(GPIOA) |= 2 << 24;"
        "R(HRTIM + 0x80 + 0x64) |= 2 << 4 | 2 << 20; R(HRTIM + 0x100 + 0x64) |= 2 << 4 | 2 << 20;"
        "R(HRTIM + 0x80 + 0x68) = 1; R(HRTIM + 0x100 + 0x68) = 1; R(HRTIM_COMMON + 0x50) = 1;"
        "R(HRTIM_COMMON + 0x14) = 15; for (;;) ;",
    )
    tiny.run(0.01)
    assert not tiny.fault(), tiny.fault()
    assert tiny.bridge_sets[-1][1] == 22500
    tiny.chip.mutate("fault_line")
    assert tiny.bridge_sets[-1][1] == 0
    assert tiny.chip.peek("hrtim.outputs") == 0
    assert tiny.chip.peek("hrtim.faulted") == 15


def test_samples_arrive_by_dma_exactly_as_given(tmp_path: Path) -> None:
    """One conversion a period into a circular buffer of 64: the halves' sums are those of what the board gave."""
    tiny = Tiny(
        tmp_path,
        READY
        + "dll_on(); legs(9600); R(GPIOA) |= 3; adc_on(); R(ADC + 0x14) = 1 << 3; R(ADC + 0x30) = 1 << 6;"
        "R(HRTIM_COMMON + 0x3c) = 1 << 4; R(ADC + 0xc) = 3 | 7 << 6 | 1 << 10 | 1 << 12; R(DMA + 0x10) = ADC + 0x40;"
        "R(DMA + 0x14) = (uint32_t)buffer; R(DMA + 0x0c) = 64; R(DMA + 8) = 0x5a7; R(ADC + 8) |= 4; R(NVIC) = 1 << 11;",
        "static volatile uint16_t buffer[64];"
        "void on_dma1(void) { uint32_t f = R(DMA); R(DMA + 4) = 15; volatile uint16_t *p = buffer + (f & 2 ? 32 : 0);"
        "for (int i = 0; i < 32; i++) result[0] += p[i]; result[1]++; }",
    )
    given: list[int] = []

    def sample(clock: int) -> int:
        given.append((clock // 600 * 7919) & 0xFFF)
        return given[-1]

    tiny.sample_code = sample
    tiny.run(0.05)
    assert not tiny.fault(), tiny.fault()
    halves = tiny.chip.counters()["count"][16 + 11]
    assert halves > 150
    assert tiny.result() == sum(given[: 32 * halves])
    assert tiny.chip.counters()["samples_lost"] == 0


def test_an_objection_ends_the_world_with_its_sentence(tmp_path: Path) -> None:
    tiny = Tiny(tmp_path, "R(TIM2) = 1;")
    world_module.build()
    world = World()
    world.add_mcu(
        build=Build("tiny", tiny.build.library, SIMULATOR.dictionary, tiny.image),
        clock_ppm=50.0,
        latency_s=0.0,
    )
    with pytest.raises(WorldError, match=r"TIM2 .* while its clock is off"):
        world.advance(world.now + 0.01)


def test_an_image_that_is_none_is_refused(tmp_path: Path) -> None:
    image = tmp_path / "not.elf"
    image.write_bytes(b"nothing")
    world_module.build()
    with pytest.raises(WorldError, match="no 32-bit ARM ELF image"):
        World().add_mcu(build=Build("none", make_emulator().library, SIMULATOR.dictionary, image))
