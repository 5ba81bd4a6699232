"""[nozzle_monitor] through the whole stack: lost filament is found by the heat of the melt alone."""

from __future__ import annotations

import pytest

from system.conftest import Simulate, square

BEGIN_S = 45.0  # half a minute of clear extrusion is behind
ROUNDS = 60  # 80 s of extrusion


@pytest.mark.parametrize(
    ("fault", "condition"),
    [("runout", "no_filament"), ("grind:0.3", "restricted"), ("clog:0", "no_filament")],
)
def test_lost_filament_is_found_within_ten_seconds(simulate: Simulate, fault: str, condition: str) -> None:
    run = simulate(square(ROUNDS), more=["--fault", f"{fault}@{BEGIN_S}"])
    assert run.status == 0, run.stderr
    assert len(run.summary["messages"]) == 1
    assert "less heat than its planned flow" in run.summary["messages"][0]
    assert 0.0 < run.summary["injected"][0]["warned_after_ms"] < 10e3
    conditions = [(row["t_s"], row["condition"]) for row in run.summary["nozzle_monitor"]]
    assert {found for t_s, found in conditions if t_s < BEGIN_S} == {"unknown", "clear"}
    assert conditions[-1][1] == condition


@pytest.mark.parametrize("seed", [1, 2])
def test_a_clean_print_with_a_fan_and_other_melt_has_no_alarm(simulate: Simulate, seed: int) -> None:
    gcode = square(ROUNDS).replace("M109 S250", "M109 S250\nM106 S128", 1)
    gcode = gcode.replace("G1 E-1 F2400", "M106 S255\n" + gcode.partition("M106 S128")[2], 1)
    settings = ["simulator nozzle nozzle.melt_heat_mj_m3k=2.4", "simulator nozzle nozzle.loss_factor=1.1"]
    run = simulate(gcode, seed=seed, settings=settings)
    assert run.status == 0, run.stderr
    assert run.summary["messages"] == []
    assert run.summary["nozzle_monitor"][-1]["condition"] == "clear"


def test_an_alarm_runs_its_template_and_ends_when_filament_is_back(simulate: Simulate) -> None:
    settings = ["nozzle_monitor.alarm_gcode=SIMULATOR_FAULT FAULT=grind ARG=0"]
    run = simulate(square(ROUNDS), settings=settings, more=["--fault", f"runout@{BEGIN_S}"])
    assert run.status == 0, run.stderr
    assert [record["fault"] for record in run.summary["injected"]] == ["runout", "grind:0"]
    conditions = [row["condition"] for row in run.summary["nozzle_monitor"]]
    assert {"no_filament", "restricted"} & set(conditions)  # how much is lost shows while it is judged
    assert conditions[-1] == "clear"
    assert len(run.summary["messages"]) == 1


def test_a_monitor_of_a_heater_that_is_not_there_is_refused(simulate: Simulate) -> None:
    run = simulate("G4 P100\n", settings=["nozzle_monitor.heater=nosel"])
    assert run.status == 2
    assert "heater 'nosel' must be an [induction_heater] that an extruder uses" in run.stderr
