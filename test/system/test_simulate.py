"""A G-code file through the whole stack: host, wire, firmware, nozzle, and what simulate.py says of it."""

from __future__ import annotations

import hashlib
import statistics
from pathlib import Path

import pytest

from simulation import demo_part
from system.conftest import CONFIG, TWO_MCUS, Run, Simulate, square

TRACE_COLUMNS = (
    "t_s,target_c,estimate_c,true_c,bore_c,melt_c,phase_ticks,power_w,flow_mm3_s,x_mm,y_mm,z_mm,e_mm"
)


def steps(run: Run) -> dict[str, tuple[int, int]]:
    axes = run.summary["axes"]
    return {name: (axis["steps_forward"], axis["steps_backward"]) for name, axis in axes.items()}


def assert_same_motion(first: Run, second: Run) -> None:
    """Step for step, but for homing: where an approach ends depends on when the switch is sampled, a step or two."""
    slack = {"extruder": 0}
    for name, (forward, backward) in steps(first).items():
        assert abs(steps(second)[name][0] - forward) <= slack.get(name, 2), name
        assert abs(steps(second)[name][1] - backward) <= slack.get(name, 2), name


def test_a_part_is_printed_where_the_file_says_and_hot(simulate: Simulate) -> None:
    run = simulate(square())
    assert run.status == 0, run.stderr
    facts = run.summary
    assert facts["faults"] == []
    # homing leaves each axis with the error of its switch: the sampling interval at the second, slow approach
    for name, mm in (("x", 60.0), ("y", 60.0), ("z", 0.3)):
        assert facts["axes"][name]["position_mm"] == pytest.approx(mm, abs=0.02), name
    assert facts["axes"]["extruder"]["position_mm"] == pytest.approx(
        8 * 20 * 0.4 * 0.2 / 2.405 - 1, abs=0.005
    )
    # the retraction at the end moves no melt back into the figures
    assert facts["extruded_mm3"] == pytest.approx(8 * 20 * 0.4 * 0.2, rel=0.002)
    assert facts["heater"]["settled_max_error_c"] <= 3.0
    assert facts["moves"] >= 8
    header = run.trace.read_text().splitlines()[0]
    assert header.startswith(TRACE_COLUMNS)
    rows = run.column("t_s")
    assert len(rows) == pytest.approx(100 * facts["simulated_s"], abs=2)
    assert max(run.column("estimate_c")) == pytest.approx(max(run.column("true_c")), abs=5.0)
    sigmas_c = run.column("sigma_c")  # from the first estimate on
    assert 0.0 < sigmas_c[-1] < 3.0
    assert run.column("supply")[-1] == pytest.approx(1.0, abs=0.05)
    assert facts["gcode_sha256"] == hashlib.sha256(Path(facts["gcode"]).read_bytes()).hexdigest()
    assert facts["command"].startswith("scripts/simulate.py ")


def test_the_same_seed_gives_the_same_trace_and_another_seed_other_noise(simulate: Simulate) -> None:
    first, again, other = (simulate(square(1), seed=seed).trace.read_bytes() for seed in (7, 7, 8))
    assert first == again
    assert first != other


def test_the_real_machine_runs_and_its_parameters_may_be_profiles(simulate: Simulate) -> None:
    nozzle = "simulator nozzle nozzle."
    run = simulate(
        "G4 P1500\n",
        settings=[
            *(nozzle + option for option in ("preset=real", "start_c=30", "ambient_c=0:30, 1:40")),
            "induction_heater nozzle.estimator=uncalibrated",
        ],
    )
    assert run.status == 0, run.stderr
    assert run.column("true_c")[-1] > 30.01, "the warmer air warms the nozzle"
    assert run.column("mean_c")[-1] == pytest.approx(run.column("true_c")[-1], abs=0.01)


@pytest.mark.slow
def test_the_part_of_the_demo_is_hot_on_a_machine_with_the_faults_of_a_real_one(simulate: Simulate) -> None:
    run = simulate(demo_part.gcode(), config=CONFIG.with_name("sim-real.cfg"), more=["--until", "330"])
    assert run.status == 0 and run.summary["faults"] == []
    columns = (run.column(name) for name in ("flow_mm3_s", "target_c", "true_c"))
    errors = sorted(
        abs(true_c - target_c) for flow, target_c, true_c in zip(*columns, strict=True) if flow > 0.5
    )
    assert len(errors) > 15_000
    # four seeds: 1.23 to 1.46 and 1.95 to 2.36
    assert statistics.fmean(error**2 for error in errors) ** 0.5 < 2.0
    assert errors[len(errors) * 99 // 100] < 3.5


def test_it_stops_at_the_time_given(simulate: Simulate) -> None:
    run = simulate(square(100), more=["--until", "8"])
    assert run.status == 0
    assert run.summary["simulated_s"] == pytest.approx(8.0, abs=0.5)
    assert "as asked" in run.summary["reason"]


def test_two_mcus_with_drifting_clocks_print_the_same_part(simulate: Simulate) -> None:
    one, two = simulate(square()), simulate(square(), config=TWO_MCUS)
    assert two.status == 0, two.stderr
    assert set(two.summary["links"]) == {"mcu", "heater"}
    assert two.summary["heater"]["settled_max_error_c"] <= 3.0
    assert_same_motion(one, two)


def test_a_lossy_line_gives_the_same_motion_as_a_clean_one(simulate: Simulate) -> None:
    clean = simulate(square(4))
    lossy = simulate(square(4), settings=["simulator mcu.corrupt=0.001", "simulator mcu.drop=0.001"])
    assert lossy.status == 0, lossy.stderr
    link = lossy.summary["links"]["mcu"]
    assert link["corrupted"] > 10
    assert link["dropped"] > 10
    assert_same_motion(clean, lossy)
    assert lossy.summary["heater"]["settled_max_error_c"] <= 3.0


def test_a_line_that_damages_one_byte_in_500_is_not_taken_for_a_drift(simulate: Simulate) -> None:
    hot = "M104 S220\nG28\nG1 X50 Y50 Z5 F6000\nM109 S220\nM83\n" + "G1 X110 E2 F1800\nG1 X50 E2\n" * 15
    run = simulate(hot, settings=["simulator mcu.corrupt=0.002"])
    assert run.status == 0, run.stderr
    assert run.summary["links"]["mcu"]["corrupted"] > 500
    assert run.summary["messages"] == []


@pytest.mark.parametrize("mass", [0.8, 1.2])
@pytest.mark.parametrize("loss", [0.8, 1.2])
@pytest.mark.parametrize("efficiency", [0.8, 1.2])
def test_an_unlike_nozzle_still_holds_three_degrees(
    simulate: Simulate, mass: float, loss: float, efficiency: float
) -> None:
    nozzle = "simulator nozzle nozzle"
    run = simulate(
        square(6),
        settings=[
            f"{nozzle}.mass_factor={mass}",
            f"{nozzle}.loss_factor={loss}",
            f"{nozzle}.efficiency_factor={efficiency}",
        ],
    )
    assert run.status == 0, run.stderr
    assert run.summary["heater"]["settled_s"] > 5.0
    assert run.summary["heater"]["settled_max_error_c"] <= 3.0


@pytest.mark.slow
def test_a_sliced_part_prints_to_its_end_also_over_a_lossy_line(simulate: Simulate, cubhelix: Path) -> None:
    clean = simulate(cubhelix)
    assert clean.status == 0, clean.stderr
    assert clean.summary["file_progress"] == 1.0
    assert clean.summary["faults"] == []
    assert clean.summary["heater"]["settled_s"] > 300.0
    assert clean.summary["heater"]["settled_max_error_c"] <= 3.0
    assert clean.summary["peak_memory_mb"] < 300.0
    lossy = simulate(cubhelix, settings=["simulator mcu.corrupt=0.001", "simulator mcu.drop=0.001"])
    assert lossy.status == 0, lossy.stderr
    assert_same_motion(clean, lossy)
    assert lossy.summary["heater"]["settled_max_error_c"] <= 3.0


def test_a_nozzle_turned_off_just_as_it_is_to_be_a_little_cooler_stays_off(simulate: Simulate) -> None:
    """The plan for the lower target turns the bridge off and on again: none of it may be left."""
    run = simulate("M109 S250\nG4 P1000\nM104 S248\nM104 S0\nG4 P500\n")
    assert run.status == 0, run.stderr
    last = max(row for row, target_c in enumerate(run.column("target_c")) if target_c)
    assert max(run.column("phase_ticks")[last + 3 :]) <= 2012  # from 30 ms on: pulses that measure
