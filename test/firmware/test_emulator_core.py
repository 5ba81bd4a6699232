"""The emulated processor: time, instruction counts, exceptions, sleep; shown with images of a few lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from chip_rig import FREQ
from tiny_chip import Tiny


def run(tmp_path: Path, program: str, before: str = "", seconds: float = 0.01) -> Tiny:
    tiny = Tiny(tmp_path, program, before)
    tiny.run(seconds)
    assert not tiny.fault(), tiny.fault()
    return tiny


def test_a_loop_costs_its_instructions_at_the_stated_cycles(tmp_path: Path) -> None:
    """1000 rounds of two instructions at 72 MHz, timed by the cycle counter: 2 cycles an instruction."""
    loop = '__asm__ volatile("movw r0, #1000\\n1: subs r0, #1\\nbne 1b" ::: "r0", "cc");'
    tiny = run(
        tmp_path,
        f"clock_72(); R(0xe000edfc) = 1 << 24; R(0xe0001000) |= 1; uint32_t t = R(0xe0001004); {loop}"
        "result[0] = R(0xe0001004) - t;",
    )
    assert tiny.result() == pytest.approx(4000, abs=30)  # + the blocks in which the counter is read


def test_the_processor_is_slower_before_the_pll_runs(tmp_path: Path) -> None:
    timed = (
        "R(0xe000edfc) = 1 << 24; R(0xe0001000) |= 1; {clock} uint32_t t = R(0xe0001004); wait(1000);"
        "result[0] = R(0xe0001004) - t;"
    )
    slow = run(tmp_path, timed.format(clock="")).result()
    fast = run(tmp_path, timed.format(clock="clock_72();")).result()
    assert slow == pytest.approx(9 * fast, rel=0.01)  # in ticks of 72 MHz: 8 against 72 MHz


def test_32_bit_instructions_count_as_one(tmp_path: Path) -> None:
    """The same thousand instructions as 16-bit and as 32-bit ones."""
    counts = []
    for nop in ("nop", "nop.w"):
        tiny = run(tmp_path, f'__asm__ volatile(".rept 1000\\n{nop}\\n.endr");')
        counts.append(tiny.chip.counters()["instructions"])
    assert counts[0] == counts[1] > 1000


def test_sleep_costs_no_instructions_and_ends_with_an_interrupt(tmp_path: Path) -> None:
    """TIM2 wakes it every millisecond, a hundred times in 100 ms; the rest is sleep."""
    tiny = run(
        tmp_path,
        "clock_72(); clocks_on(); R(TIM2 + 0x34) = 72000; R(TIM2 + 0xc) = 2; R(TIM2) = 1; R(NVIC) = 1 << 28;",
        "void on_tim2(void) { R(TIM2 + 0x10) = ~2u; R(TIM2 + 0x34) += 72000; result[0]++; }",
        seconds=0.1,
    )
    counters = tiny.chip.counters()
    assert 97 <= tiny.result() <= 99  # the clock takes more than 1 ms to start
    assert counters["idle_ticks"] / counters["ticks"] > 0.9
    assert counters["count"][16 + 28] == tiny.result()


@pytest.mark.parametrize(("low", "high", "depth"), [(0x80, 0x40, 2), (0x40, 0x40, 1), (0x40, 0x80, 1)])
def test_only_a_more_urgent_interrupt_interrupts_another(
    tmp_path: Path, low: int, high: int, depth: int
) -> None:
    """TIM2's handler pends TIM3's and looks whether it ran in between."""
    tiny = run(
        tmp_path,
        f"R8(NVIC + 0x300 + 28) = {low}; R8(NVIC + 0x300 + 29) = {high};"
        "R(NVIC) = 3 << 28; R(NVIC + 0x100) = 1 << 28; wait(10);",
        "static volatile uint32_t deep;"
        "void on_tim2(void) { deep = 1; R(NVIC + 0x100) = 1 << 29; wait(50); deep = 0; }"
        "void on_tim3(void) { result[0] = deep ? 2 : 1; }",
    )
    assert tiny.result() == depth


def test_masked_interrupts_wait(tmp_path: Path) -> None:
    """PRIMASK holds a pended interrupt until it is cleared."""
    tiny = run(
        tmp_path,
        '__asm__ volatile("cpsid i"); R(NVIC) = 1 << 28; R(NVIC + 0x100) = 1 << 28; wait(50);'
        'result[0] = result[1]; __asm__ volatile("cpsie i"); wait(5); result[0] |= result[1] << 4;',
        "void on_tim2(void) { result[1] = 1; }",
    )
    assert tiny.result() == 0x10


def test_base_priority_holds_back_the_less_urgent(tmp_path: Path) -> None:
    tiny = run(
        tmp_path,
        "R8(NVIC + 0x300 + 28) = 0x80; R8(NVIC + 0x300 + 29) = 0x40;"
        '__asm__ volatile("msr basepri, %0" :: "r"(0x60)); R(NVIC) = 3 << 28; R(NVIC + 0x100) = 3 << 28;'
        "wait(50); result[0] = result[1];",
        "void on_tim2(void) { result[1] |= 1; } void on_tim3(void) { result[1] |= 2; }",
    )
    assert tiny.result() == 2


def test_registers_survive_an_interrupt_at_any_block(tmp_path: Path) -> None:
    """A sum over a busy loop, flags and conditional instructions included, is right although it is interrupted hundreds
    of times."""
    tiny = run(
        tmp_path,
        "clock_72(); clocks_on(); R(TIM2 + 0x2c) = 500; R(TIM2 + 0xc) = 1; R(TIM2) = 1; R(NVIC) = 1 << 28;"
        "uint32_t a = 1, s = 0; for (int i = 0; i < 20000; i++) { a = a * 1664525u + 1013904223u;"
        "if (a >> 31) s += a >> 7; else s ^= a; } R(TIM2) = 0; result[0] = s; result[1] = result[2];",
        "void on_tim2(void) { R(TIM2 + 0x10) = 0; result[2]++; volatile uint32_t x[8];"
        "for (int i = 0; i < 8; i++) x[i] = ~i; }",
        seconds=0.05,
    )
    a, s = 1, 0
    for _ in range(20000):
        a = (a * 1664525 + 1013904223) & 0xFFFFFFFF
        s = s + (a >> 7) & 0xFFFFFFFF if a >> 31 else s ^ a
    assert tiny.result() == s
    assert tiny.chip.counters()["count"][16 + 28] > 300


def test_floating_point_registers_survive_an_interrupt(tmp_path: Path) -> None:
    tiny = run(
        tmp_path,
        "R(SCB + 0x88) = 0xf << 20; float s = 0, x = 1; R(NVIC) = 1 << 28;"
        "for (int i = 0; i < 1000; i++) { s += x; x *= 1.001f; if (i % 100 == 50) R(NVIC + 0x100) = 1 << 28; }"
        "result[0] = (uint32_t)s;",
        "void on_tim2(void) { volatile float y = 3.0f; for (int i = 0; i < 9; i++) y = y * 7.5f + (float)i; }",
    )
    # 1000 terms of a geometric series in single precision
    assert tiny.result() == pytest.approx((1.001**1000 - 1) / 0.001, rel=1e-3)
    assert tiny.chip.counters()["count"][16 + 28] == 10


def test_systick_counts_the_processor_clock(tmp_path: Path) -> None:
    tiny = run(
        tmp_path,
        "clock_72(); R(SYST + 4) = 71999; R(SYST + 8) = 0; R(SYST) = 7;",
        "void on_systick(void) { result[0]++; }",
        seconds=0.05,
    )
    assert tiny.result() == 48  # 50 ms less the 1.2 ms that HSE and PLL take to start


def test_the_watchdog_restarts_the_chip_unless_it_is_fed(tmp_path: Path) -> None:
    """40 kHz / 4 with reload 99: 10 ms. Fed for 50 ms, then not."""
    tiny = Tiny(
        tmp_path,
        "R(IWDG) = 0x5555; R(IWDG + 4) = 0; R(IWDG + 8) = 99; R(IWDG) = 0xcccc;"
        "for (int i = 0; i < 50; i++) { wait(2000); R(IWDG) = 0xaaaa; }",
    )
    tiny.run(0.03)
    assert not tiny.lib.sim_mcu_take_reset()
    tiny.run(0.1)
    assert tiny.lib.sim_mcu_take_reset()


def test_the_cause_of_a_reset_can_be_read(tmp_path: Path) -> None:
    program = (
        "uint32_t cause = R(RCC + 0x24) >> 24; if (cause & 8) R(SCB + 0xc) = 0x05fa0004; result[0] = cause;"
    )
    tiny = Tiny(tmp_path, program)
    tiny.run(0.001)
    assert tiny.lib.sim_mcu_take_reset()
    tiny.lib.sim_mcu_boot(tiny.board, tiny.now)  # as the world does it
    tiny.run(0.001)
    assert tiny.result() == 0x14  # software reset, pin reset; no longer power-on


def test_the_same_run_twice_is_the_same_to_the_instruction(tmp_path: Path) -> None:
    program = (
        "clock_72(); clocks_on(); R(TIM2 + 0x2c) = 777; R(TIM2 + 0xc) = 1; R(TIM2) = 1; R(NVIC) = 1 << 28;"
        "for (;;) result[1] = result[1] * 5 + 1;"
    )
    runs = []
    for _ in range(2):
        tiny = run(tmp_path, program, "void on_tim2(void) { R(TIM2 + 0x10) = 0; result[0] += result[1]; }")
        runs.append((tiny.result(), tiny.chip.counters()))
    assert runs[0] == runs[1]


def test_stretches_of_time_do_not_change_the_run(tmp_path: Path) -> None:
    """However finely the world cuts its time, the chip does the same."""
    program = (
        "clock_72(); clocks_on(); R(TIM2 + 0x2c) = 777; R(TIM2 + 0xc) = 1; R(TIM2) = 1; R(NVIC) = 1 << 28;"
    )
    results = []
    for parts in (1, 97):
        tiny = Tiny(tmp_path, program, "void on_tim2(void) { R(TIM2 + 0x10) = 0; result[0]++; }")
        for part in range(1, parts + 1):
            tiny.run_to(round(0.02 * FREQ * part / parts))
        results.append((tiny.result(), tiny.chip.counters()["instructions"]))
    assert results[0] == results[1]
