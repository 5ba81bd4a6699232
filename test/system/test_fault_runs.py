"""simulate.py --fault: what is refused, what the summary says, and a host that stands still or dies."""

from __future__ import annotations

import pytest

from system.conftest import Simulate, square

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
    reasons = ("below min_temp", "below its limit", "changed faster than a nozzle can")
    assert any(reason in record["detected_by"] for reason in reasons)
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
    run = simulate(
        HOLD, settings=["simulator nozzle nozzle.preset=strong"], more=["--fault", "sense_gain:0.5@6"]
    )
    record = run.summary["injected"][0]
    assert "changed faster than a nozzle can" in record["detected_by"]
    assert record["after_ms"] < 10.0
    assert record["peak_above_target_c"] < 5.0


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
