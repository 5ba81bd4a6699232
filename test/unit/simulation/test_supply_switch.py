"""The switch in the supply of a simulated bridge follows its pin, late by its delay; then the bus empties itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulation import world as world_module
from simulation.world import Pin, parameter_values
from world_rig import Rig, build_fake

ENABLE = Pin(0, 7)


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world_module.build()
    return build_fake(tmp_path_factory.mktemp("fake"))


def stuck_on(fake: Path, delay_s: float = 0.001, watchdog_s: float = 0.0, **changes: float) -> Rig:
    """A bridge that stays at full phase whatever is commanded, behind a switch."""
    rig = Rig(fake)
    values = {"start_c": 250.0, "fault": 3.0, "fault_phase_ticks": 45000.0, **changes}
    rig.world.add_nozzle(0, parameter_values("nozzle", "strong", values))
    rig.world.add_supply_switch(0, ENABLE, delay_s, watchdog_s)
    rig.start()
    return rig


def test_without_its_pin_the_supply_is_open(fake: Path) -> None:
    rig = stuck_on(fake)
    rig.run(0.1)
    now = rig.world.nozzle(0)
    assert (now["supply_closed"], now["power_w"], now["supply_v"]) == (0, 0.0, 0.0)


def test_the_supply_follows_the_pin_by_its_delay(fake: Path) -> None:
    rig = stuck_on(fake, delay_s=0.015)
    rig.write(ENABLE, 1)
    rig.run(0.014)
    assert rig.world.nozzle(0)["power_w"] == 0.0
    rig.run(0.002)
    assert rig.world.nozzle(0)["power_w"] == pytest.approx(282.0)
    rig.write(ENABLE, 0)
    rig.run(0.014)
    assert rig.world.nozzle(0)["power_w"] == pytest.approx(282.0)
    rig.run(0.002)
    assert rig.world.nozzle(0)["power_w"] == 0.0


def test_with_a_watchdog_a_pin_that_stands_still_opens_the_supply(fake: Path) -> None:
    rig = stuck_on(fake, watchdog_s=0.010)
    for n in range(10):
        rig.write(ENABLE, 1 - n % 2)
        rig.run(0.008)
    assert rig.world.nozzle(0)["supply_closed"] == 1
    rig.run(0.005)
    assert rig.world.nozzle(0)["supply_closed"] == 0


def test_the_heat_after_the_switch_opens_is_the_share_of_what_the_bus_holds(fake: Path) -> None:
    rig = stuck_on(fake, bus_uf=2000.0, start_c=20.0, loss_factor=0.2)
    rig.write(ENABLE, 1)
    rig.run(0.1)
    rig.write(ENABLE, 0)
    rig.run(0.001)
    opened_c = rig.world.nozzle(0)["skin_c"]
    rig.run(0.05)
    # 576 mJ on the bus; the power of the bridge goes with V^2, the heat with V^1.5: 282/336 x 4/3 of it; 0.425 J/K
    assert rig.world.nozzle(0)["skin_c"] - opened_c == pytest.approx(
        0.576 * 282 / 336 * 4 / 3 / 0.425, rel=0.1
    )
