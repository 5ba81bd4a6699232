"""The simulated bridge and synchronous ADC, seen through the induction unit: edges, sample order, half buffers."""

from __future__ import annotations

import time

import pytest

from block_codec import one_step
from mcu_harness import FREQ, Mcu

PERIOD = 600
HEATER = {
    "oid": 0,
    "bridge": 0,
    "adc_pin": 9,
    "period_ticks": PERIOD,
    "phase_max": 45000,
    "max_duration": FREQ // 2,
}


@pytest.fixture
def mcu() -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    stepper = {"oid": 1, "step_pin": 3, "dir_pin": 4, "invert_step": 255, "step_pulse_ticks": 0}
    mcu.configure(2, ("config_induction", HEATER), ("config_stepper", stepper))
    mcu.send("induction_report", oid=0, enable=1)
    return mcu


def test_samples_are_read_one_a_period_without_gap_or_overlap(mcu: Mcu) -> None:
    mcu.run(0.02)
    first, _, _ = mcu.sample_reads[0]
    expected = first
    for clock, count, period in mcu.sample_reads:
        assert (clock, period) == (expected, PERIOD)
        expected += count * PERIOD
    assert expected <= mcu.now + PERIOD
    assert {count for _, count, _ in mcu.sample_reads} == {32}  # half a buffer each while the phase stands


def test_a_phase_comes_into_force_at_the_next_period_edge(mcu: Mcu) -> None:
    mcu.run(0.002)
    origin = mcu.sample_reads[0][0]
    asked = [mcu.now + 10_001, mcu.now + 40_000]
    for clock, phase in zip(asked, (9000, 12000), strict=True):
        mcu.send("queue_induction_plan", oid=0, clock=clock, steps=one_step(phase))
    mcu.run(0.002)
    sent = [(clock, phase) for clock, phase in mcu.bridge_sets if phase]
    assert [phase for _, phase in sent] == [9000, 12000]
    for (clock, _), request in zip(sent, asked, strict=True):
        assert (clock - origin) % PERIOD == 0 and request < clock <= request + PERIOD


def test_samples_before_an_edge_are_read_before_the_world_hears_of_the_new_phase(mcu: Mcu) -> None:
    mcu.run(0.002)
    log: list[tuple[str, int, int]] = []
    mcu.bridge_sets = LoggedList(log, "phase")
    mcu.sample_reads = LoggedList(log, "read")
    for i in range(20):
        mcu.send("queue_induction_plan", oid=0, clock=mcu.now + 5000 + i * 7777, steps=one_step(9000 + i))
    mcu.run(0.01)
    in_force_from = 0
    for kind, clock, _ in log:
        if kind == "phase":
            in_force_from = clock
        else:
            assert clock >= in_force_from  # never a sample older than the phase it is read under
    reads = [(clock, count) for kind, clock, count in log if kind == "read"]
    edges = [clock for kind, clock, _ in log if kind == "phase"]
    assert len(edges) == 20
    for clock, count in reads:
        assert not any(clock < edge <= clock + (count - 1) * PERIOD for edge in edges)


class LoggedList(list):  # type: ignore[type-arg]
    """A list that also puts into a common log what is appended to it."""

    def __init__(self, log: list[tuple[str, int, int]], kind: str) -> None:
        super().__init__()
        self.log, self.kind = log, kind

    def append(self, item: tuple[int, ...]) -> None:
        self.log.append((self.kind, item[0], item[1]))


def test_shutdown_switches_the_bridge_off_at_once(mcu: Mcu) -> None:
    mcu.send("queue_induction_plan", oid=0, clock=mcu.now + 1000, steps=one_step(9000))
    mcu.run(0.0101)
    assert mcu.bridge_sets[-1][1] == 9000
    mcu.send("emergency_stop")
    assert mcu.bridge_sets[-1] == (mcu.now, 0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"bridge": 1}, "Not a valid bridge"),
        ({"adc_pin": 500}, "Not a valid ADC pin"),
    ],
)
def test_hardware_that_is_not_there_is_refused(change: dict[str, int], reason: str) -> None:
    mcu = Mcu()
    mcu.send("allocate_oids", count=1)
    mcu.send("config_induction", **HEATER | change)
    assert mcu.shutdown_reason() == reason


def test_same_calls_give_the_same_bytes() -> None:
    def life() -> list[tuple[int, bytes]]:
        mcu = Mcu()
        mcu.configure(1, ("config_induction", HEATER))
        mcu.send("induction_report", oid=0, enable=1)
        for i in range(10):
            mcu.send("queue_induction_plan", oid=0, clock=mcu.now + 9999, steps=one_step(9000 + 100 * i))
            mcu.run(0.0031)
        return mcu.sent

    assert life() == life()


def test_stepping_in_small_advances_changes_nothing() -> None:
    def life(slices: int) -> list[tuple[int, bytes]]:
        mcu = Mcu()
        mcu.configure(1, ("config_induction", HEATER))
        mcu.send("induction_report", oid=0, enable=1)
        mcu.send("queue_induction_plan", oid=0, clock=mcu.now + 9999, steps=one_step(9000))
        end = mcu.now + 720_000
        for i in range(slices):
            mcu.run_to(end - (slices - 1 - i) * (720_000 // slices))
        return mcu.sent

    assert life(1) == life(97)


def test_next_event_reports_when_there_is_something_to_do(mcu: Mcu) -> None:
    mcu.run(0.01)
    upcoming = mcu.lib.sim_mcu_next_event()
    assert mcu.now < upcoming <= mcu.now + 32 * PERIOD
    reads = len(mcu.sample_reads)
    mcu.run_to(upcoming - 1)
    assert len(mcu.sample_reads) == reads
    mcu.run_to(upcoming)
    assert len(mcu.sample_reads) == reads + 1
    mcu.lib.sim_mcu_receive(b"\x7e", 1)
    assert mcu.lib.sim_mcu_next_event() == mcu.now  # bytes wait: the tasks want to run now


def test_simulation_is_fast_enough_for_a_print_at_many_times_real_time() -> None:
    """40,000 steps and 3,750 half buffers, C board: the cost of the MCU alone.

    Measured 1.1 ms on a 2-core build machine; the limit is loose because the machine is shared.
    """
    mcu = Mcu()
    quiet_board(mcu)
    stepper = {"oid": 1, "step_pin": 3, "dir_pin": 4, "invert_step": 255, "step_pulse_ticks": 0}
    mcu.configure(2, ("config_induction", HEATER), ("config_stepper", stepper))
    mcu.send("induction_report", oid=0, enable=1)
    mcu.send("reset_step_clock", oid=1, clock=mcu.now + 1000)
    mcu.send("queue_step", oid=1, interval=1800, count=40000, add=0)
    begin = time.perf_counter()
    mcu.run(1.0)
    spent_s = time.perf_counter() - begin
    print(f"\none simulated second: {spent_s * 1000:.2f} ms")
    assert spent_s < 0.05


def quiet_board(mcu: Mcu) -> None:
    """Boot on a board whose functions are C and do nothing, to leave Python out of the measurement."""
    source = """
    #include <stdint.h>
    void pin_write(void *c, uint32_t p, uint8_t v, uint64_t k) {}
    uint8_t pin_read(void *c, uint32_t p, uint64_t k) { return 0; }
    void pwm_write(void *c, uint32_t p, uint32_t y, uint32_t v, uint64_t k) {}
    uint16_t adc_read(void *c, uint32_t p, uint64_t k) { return 2000; }
    void bridge_set(void *c, uint16_t f, uint64_t k) {}
    void sync_adc_read(void *c, uint16_t *s, uint32_t n, uint64_t k, uint32_t p)
    { for (uint32_t i = 0; i < n; i++) s[i] = 1000; }
    """
    names = ["pin_write", "pin_read", "pwm_write", "adc_read", "bridge_set", "sync_adc_read"]
    import ctypes
    import subprocess
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/board.so"
        command = ["gcc", "-O2", "-w", "-fPIC", "-shared", "-x", "c", "-o", path, "-"]
        subprocess.run(command, input=source, text=True, check=True)
        board = ctypes.CDLL(path)
    for name in names:
        address = ctypes.cast(getattr(board, name), ctypes.c_void_p).value
        setattr(mcu.board, name, mcu.ffi.cast("void *", address))
    mcu.boot(1000)
