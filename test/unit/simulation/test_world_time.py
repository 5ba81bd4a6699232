"""Time, clocks and lines of the simulated world (klippy/simulation/world/world.c, world_link.c), with fake MCUs."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulation import world as world_module
from simulation.world import World
from world_rig import FAKE_CLOCK_HZ, Rig, build_fake

BYTE_S = 10 / 250000


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world_module.build()
    return build_fake(tmp_path_factory.mktemp("fake"))


def test_time_passes_exactly_as_far_as_asked(fake: Path) -> None:
    rig = Rig(fake)
    rig.world.advance(100.123456789)
    assert rig.world.now == 100.123456789


def test_clocks_run_at_their_own_rate(fake: Path) -> None:
    world = World(1)
    fast, slow = (
        world.add_mcu(clock_ppm=ppm, baud=0.0, latency_s=0.0, library=fake) for ppm in (50.0, -50.0)
    )
    rig = Rig.__new__(Rig)
    rig.world, rig.mcus = world, [fast, slow]
    rig.start()
    begin = [rig.clock(fast), rig.clock(slow), world.now]
    rig.run(1000.0)
    elapsed = [rig.clock(fast) - begin[0], rig.clock(slow) - begin[1]]
    # each clock was read within 50 us of the time noted: 3600 ticks of 7.2e10
    assert elapsed[0] == pytest.approx(1000.0 * FAKE_CLOCK_HZ * (1 + 50e-6), abs=2e4)
    assert elapsed[1] == pytest.approx(1000.0 * FAKE_CLOCK_HZ * (1 - 50e-6), abs=2e4)


def test_bytes_arrive_after_their_time_on_the_line_and_the_latency(fake: Path) -> None:
    rig = Rig(fake, baud=250000.0, latency_s=0.002)
    rig.run(0.1)
    rig.world.drain_bytes(0)
    sent = rig.world.now
    rig.world.feed_bytes(0, b"c")
    expected = BYTE_S + 0.002 + 8 * BYTE_S + 0.002  # one byte there, eight back
    rig.world.advance(sent + expected - 1e-6)
    assert rig.world.drain_bytes(0) == b""
    # an MCU may run ahead by the lookahead, 250 us at most, so its clock is that exact
    rig.world.advance(sent + expected + 1e-6)
    answer = rig.world.drain_bytes(0)
    assert len(answer) == 8
    at_mcu = int.from_bytes(answer, "little") / FAKE_CLOCK_HZ
    assert at_mcu == pytest.approx(sent - rig.world.start_s + BYTE_S + 0.002, abs=1e-6)


def test_a_line_delivers_no_faster_than_its_baud_rate(fake: Path) -> None:
    rig = Rig(fake, baud=250000.0, latency_s=0.0)
    rig.run(0.1)
    rig.world.drain_bytes(0)
    rig.world.feed_bytes(0, b"c" * 60)  # 480 bytes come back: 19.2 ms
    rig.run(0.010)
    first = len(rig.world.drain_bytes(0))
    rig.run(0.015)
    assert 0.25 * 480 < first < 0.55 * 480
    assert first + len(rig.world.drain_bytes(0)) == 480


def counted(fake: Path, seed: int, **chance: float) -> tuple[bytes, dict[str, int]]:
    rig = Rig(fake, seed, **chance)
    rig.run(0.01)
    rig.world.drain_bytes(0)
    received = b""
    for _ in range(500):
        rig.world.feed_bytes(0, b"xxxxxxxxxx" * 4)  # orders that mean nothing: few are answered
        rig.run(0.001)
        received += rig.world.drain_bytes(0)
    return received, rig.world.link(0)


def test_bytes_are_damaged_as_often_as_asked(fake: Path) -> None:
    _, link = counted(fake, 1, corrupt=0.01, drop=0.02, duplicate=0.03)
    total = link["bytes_down"] + link["bytes_up"]
    assert total >= 20000
    for name, chance in (("corrupted", 0.01), ("dropped", 0.02), ("duplicated", 0.03)):
        sigma = (total * chance) ** 0.5
        assert abs(link[name] - total * chance) < 5 * sigma, name


def test_damage_is_a_function_of_the_seed(fake: Path) -> None:
    assert counted(fake, 3, corrupt=0.01) == counted(fake, 3, corrupt=0.01)
    assert counted(fake, 3, corrupt=0.01) != counted(fake, 4, corrupt=0.01)


def test_a_clean_line_damages_nothing(fake: Path) -> None:
    _, link = counted(fake, 1)
    assert link["corrupted"] == link["dropped"] == link["duplicated"] == link["overflowed"] == 0


def test_a_line_nobody_reads_overflows_instead_of_growing(fake: Path) -> None:
    rig = Rig(fake)
    for _ in range(40):
        rig.world.feed_bytes(0, b"c" * 60)
        rig.run(0.001)
    assert rig.world.link(0)["overflowed"] > 0


def test_the_trace_has_its_rows_at_its_rate(fake: Path, tmp_path: Path) -> None:
    rig = Rig(fake)
    rig.world.open_trace(tmp_path / "trace.csv", 100.0)
    rig.run(2.0)
    rig.world.close_trace()
    lines = (tmp_path / "trace.csv").read_text().splitlines()
    assert lines[0].startswith(
        "t_s,target_c,estimate_c,true_c,bore_c,melt_c,phase_ticks,power_w,flow_mm3_s,x_mm,y_mm,z_mm,e_mm"
    )
    times = [float(line.split(",")[0]) for line in lines[1:]]
    assert times == pytest.approx([0.01 * n for n in range(len(times))], abs=1e-9)
    assert len(times) == 201
