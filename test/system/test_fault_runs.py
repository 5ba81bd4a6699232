"""simulate.py --fault: what is refused, what the summary says, and a host that stands still or dies."""

from __future__ import annotations

import math

import pytest

from system.conftest import Run, Simulate, square

HOLD = "M109 S250\nG4 P4000\n"


def test_an_unknown_fault_ends_with_status_2_and_names_the_known_ones(simulate: Simulate) -> None:
    run = simulate(HOLD, more=["--fault", "no_such@3"])
    assert run.status == 2
    assert "there is no fault 'no_such'" in run.stderr
    assert "coil_open" in run.stderr


def test_a_killed_host_ends_with_status_3_and_a_whole_trace(simulate: Simulate) -> None:
    run = simulate(HOLD, more=["--fault", "host_kill@6"])
    assert run.status == 3
    times = run.column("t_s")
    assert len(times) == pytest.approx(100 * 8.0, abs=2)
    record = run.summary["injected"][0]
    assert record["detected_by"] == "the MCU, without a host"
    assert record["after_ms"] <= 250.0
    assert record["peak_above_target_c"] < 1.0
    assert record["power_at_end_w"] == 0.0
    assert set(run.column("phase_ticks")[-100:]) == {0.0}


def test_a_broken_coil_is_in_the_summary_with_what_stopped_it(simulate: Simulate) -> None:
    run = simulate(HOLD, more=["--fault", "coil_open@6"])
    assert run.status == 3
    record = run.summary["injected"][0]
    assert any(words in record["detected_by"] for words in ("changed faster", "signal does not follow"))
    assert record["after_ms"] < 25.0
    assert record["bridge_off_after_ms"] < 25.0


def test_the_log_has_the_last_blocks_commands_and_the_plan_of_a_nozzle_that_stopped(
    simulate: Simulate,
) -> None:
    log = simulate(HOLD, more=["--fault", "sense_gain:0.5@6"]).log.read_text()
    blocks = [line for line in log.splitlines() if "Induction heater 'nozzle': block: " in line]
    assert len(blocks) == 64
    assert "rise missing" in log
    assert "Induction heater 'nozzle': command: from " in log
    times = [float(line.split("block: ")[1].split()[0]) for line in blocks]
    assert times == sorted(times)


def test_a_signal_that_jumps_is_no_reason_to_heat(simulate: Simulate) -> None:
    """The host's own judgement, without the board's tests of the signal, which are as quick."""
    settings = ["simulator nozzle nozzle.preset=strong", "induction_heater nozzle.signal_test_interval=0"]
    run = simulate(HOLD, settings=settings, more=["--fault", "sense_gain:0.5@6"])
    record = run.summary["injected"][0]
    assert "does not follow the heat" in record["detected_by"]
    assert record["after_ms"] < 40.0
    assert record["peak_above_target_c"] < 5.0


def test_commands_that_are_not_the_law_s_are_stopped_before_the_nozzle_is_too_hot(simulate: Simulate) -> None:
    settings = ["simulator nozzle nozzle.preset=strong", "induction_heater nozzle.power_full_w=282"]
    run = simulate(HOLD, settings=settings, more=["--fault", "command_stuck:45000@6"])
    record = run.summary["injected"][0]
    assert "more than any command asks for" in record["detected_by"]
    assert record["peak_above_target_c"] < 25.0


def test_a_fault_may_stand_in_the_config_and_be_combined(simulate: Simulate) -> None:
    run = simulate(
        HOLD, settings=["simulator.fault=sense_offset:-3@4 emi:1,37@5"], more=["--fault", "blob@6"]
    )
    assert [record["fault"] for record in run.summary["injected"]] == ["sense_offset:-3", "emi:1,37", "blob"]
    assert run.status == 0, run.stderr


def test_without_a_fault_the_summary_has_no_record(simulate: Simulate) -> None:
    assert simulate("G4 P100\n").summary["injected"] == []


def test_a_fault_of_a_running_printer_is_a_command(simulate: Simulate) -> None:
    run = simulate("M104 S250\nG4 P4000\nSIMULATOR_FAULT FAULT=coil_open\nG4 P2000\n")
    assert run.status == 3
    assert run.summary["injected"][0]["detected_by"]
    refused = simulate("SIMULATOR_FAULT FAULT=coil_open ARG=3\n")
    assert refused.status == 2
    assert "takes no numbers" in refused.stderr


def test_two_prints_with_the_same_fault_are_the_same(simulate: Simulate) -> None:
    first, second = (simulate(square(1), more=["--fault", "emi:2,37@6", "--until", "12"]) for _ in range(2))
    assert first.trace.read_bytes() == second.trace.read_bytes()


LATE = (
    "host_stall:0.3",
    "host_stall:0.8",
    "link_cut:0.3",
    "link_cut:0.8",
    "uplink_cut:0.3",
    "uplink_cut:0.8",
)
PRINT = "M109 S250\n" + square(3)  # heats from 1 s, prints from 8 s on
PRINT_S = 16.84  # from the first heat to the end


def phases(run: Run, since_s: float, until_s: float = math.inf) -> set[float]:
    rows = zip(run.column("t_s"), run.column("phase_ticks"), strict=True)
    return {phase for t, phase in rows if since_s < t < until_s}


@pytest.mark.parametrize("fault", LATE)
def test_a_late_host_or_a_line_cut_for_a_moment_costs_heat_not_the_print(
    simulate: Simulate, fault: str
) -> None:
    run = simulate(PRINT, more=["--fault", f"{fault}@12"])
    assert run.status == 0, run.stderr
    record = run.summary["injected"][0]
    assert record["detected_by"] is None
    assert "the bridge was off meanwhile" in record["warning"]
    assert record["peak_above_target_c"] < 5.0
    assert phases(run, 12.25, 12.29) == {0.0}
    assert max(phases(run, 14.0)) > 0.0
    times = run.column("t_s")
    heat_s = next(t for t, phase in zip(times, run.column("phase_ticks"), strict=True) if phase)
    assert times[-1] - heat_s == pytest.approx(PRINT_S, abs=0.2), "the motion went on"


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("host_stall:1.3", "no control for 1.3 s"),
        ("link_cut", "no samples"),
        ("uplink_cut", "no samples"),
    ],
)
def test_a_longer_silence_stops_the_printer_with_the_bridge_off(
    simulate: Simulate, fault: str, says: str
) -> None:
    run = simulate(PRINT, more=["--fault", f"{fault}@12"])
    assert run.status == 3
    record = run.summary["injected"][0]
    assert says in record["detected_by"]
    assert record["peak_above_target_c"] < 1.0
    assert phases(run, 12.26) == {0.0}
