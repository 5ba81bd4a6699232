"""Faults by name: what is refused and why, and what each does to the machine (klippy/simulation/faults.py)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from simulation import faults
from simulation import world as world_module
from simulation.faults import FAULTS, FaultError, Injector, Target, parse
from simulation.machine import Machine
from simulation.simtime import SimTime
from simulation.world import Pin, parameter_tables, parameter_values
from world_rig import Rig, build_fake

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "Simulation.md"
NOT_OF_THE_NOZZLE = ("command_stuck", "adc_stop", "host_stall", "host_kill", "mcu_reset", "clock_step")


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world_module.build()
    return build_fake(tmp_path_factory.mktemp("fake"))


def machine(fake: Path, nozzle: bool = True) -> tuple[Rig, Injector]:
    rig = Rig(fake)
    built = Machine(rig.world, builds={"mcu": SimpleNamespace(emulated=False)})  # type: ignore[dict-item]
    if nozzle:
        rig.world.add_nozzle(0, parameter_values("nozzle", "real", {"start_c": 250.0}))
        built.nozzle_mcus.append(0)
        built.beds.append(rig.world.add_load(parameter_values("load", "bed", {}), True, Pin(0, 5), Pin(0, 6)))
    time = SimTime(rig.world)
    return rig, Injector(Target(built, time, SimpleNamespace(lookup_objects=lambda name: [])))


def test_the_page_lists_every_fault_with_its_argument() -> None:
    text = PAGE.read_text(encoding="utf-8")
    missing = [
        name
        for name in FAULTS
        if f"`{name}`" not in text and f"`{name}:" not in text and f"`{name}[" not in text
    ]
    assert missing == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("coil_open", "NAME[:ARG]@T"),
        ("coil_open@soon", "NAME[:ARG]@T"),
        ("coil_open@-1", "NAME[:ARG]@T"),
        ("coil_opn@3", "there is no fault 'coil_opn'"),
        ("coil_open:3@3", "takes no numbers"),
        ("sense_gain@3", "needs its argument, as in sense_gain:factor@20"),
        ("sense_gain:much@3", "'much' is not a number"),
        ("sense_gain:11@3", "factor must be from 0 to 10, not 11"),
        ("adc_bit:12=1@3", "bit must be from 0 to 11"),
        ("emi:5@3", "emi needs its argument, as in emi:lsb,hz@20"),
    ],
)
def test_a_fault_that_cannot_be_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(FaultError) as e:
        parse(text)
    assert reason in str(e.value)


def test_arguments_are_read_as_listed() -> None:
    assert parse("adc_bit:5=1@2.5") == faults.Order("adc_bit:5=1", "adc_bit", (5.0, 1.0), 2.5)
    assert parse("bridge_stuck_on@1").numbers == (45000.0,)
    assert parse("link_cut:0.3@1").numbers == (0.3,)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("coil_open@1", "no induction-heated nozzle"),
        ("fan_stuck:1@1", "no fan"),
        ("bed_stuck_on@1", "no bed"),
        ("host_kill@1", "one process"),
    ],
)
def test_a_fault_of_what_the_machine_lacks_is_refused(fake: Path, text: str, reason: str) -> None:
    _, injector = machine(fake, nozzle=False)
    with pytest.raises(FaultError, match=reason):
        injector.order([parse(text)])


def example(name: str) -> str:
    """With arguments in the middle of their range."""
    numbers = [f"{round(a.low + 0.4 * (a.high - a.low)) or 1}" for a in FAULTS[name].arguments]
    return f"{name}:{','.join(numbers)}@0.5"


@pytest.mark.parametrize(
    "name", [n for n, fault in FAULTS.items() if fault.needs == "nozzle" and n not in NOT_OF_THE_NOZZLE]
)
def test_a_fault_of_the_nozzle_changes_its_parameters_at_its_time_and_not_before(
    fake: Path, name: str
) -> None:
    rig, injector = machine(fake)
    order = parse(example(name) if FAULTS[name].arguments else f"{name}@0.5")
    time = injector.target.time

    def parameters() -> list[float]:
        return [rig.world.parameter(0, row) for row in parameter_tables()["nozzle"]]

    injector.order([order])
    before = parameters()
    while time.monotonic() < rig.world.start_s + 0.49:
        time.wait(rig.world.start_s + 0.49, SimpleNamespace(poll=lambda seconds: []))
    assert parameters() == before
    while time.monotonic() < rig.world.start_s + 0.6:
        time.wait(rig.world.start_s + 0.6, SimpleNamespace(poll=lambda seconds: []))
    assert injector.injected[0].at_s == pytest.approx(rig.world.start_s + 0.5)
    assert parameters() != before


def test_the_heat_of_a_bridge_that_stays_on_is_in_the_record(fake: Path) -> None:
    rig, injector = machine(fake)
    injector.order([parse("bridge_stuck_on@0.5")])
    time = injector.target.time
    while time.monotonic() < rig.world.start_s + 1.5:
        time.wait(rig.world.start_s + 1.5, SimpleNamespace(poll=lambda seconds: []))
    record = injector.results()[0]
    assert record["power_at_end_w"] > 60.0
    assert record["peak_above_target_c"] == pytest.approx(150.0, abs=40.0)
    assert record["bridge_off_after_ms"] is None
    assert record["detected_by"] is None
