"""What simulate.py says, and its exit status, when it cannot print: one clear paragraph, no traceback."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from log_extract import extract, story
from system.conftest import CONFIG, ROOT, Run, Simulate

HOT = "G28\nM109 S250\nG90\nM83\n"


def assert_clear(run: Run, status: int, *words: str) -> None:
    assert run.status == status, run.stderr
    assert "Traceback" not in run.stderr
    assert "\n\n" not in run.stderr.strip()
    for word in words:
        assert word in run.stderr, run.stderr


def test_missing_files_are_named(simulate: Simulate, tmp_path: Path) -> None:
    assert_clear(simulate(tmp_path / "nothing.gcode"), 2, "nothing.gcode")
    assert_clear(simulate("G28\n", config=tmp_path / "nothing.cfg"), 2, "nothing.cfg")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("stepper_q.step_pin=PA1", ("stepper_q",)),
        ("extruder.colour=red", ("colour", "extruder")),
        ("extruder.nozzle_diameter=wide", ("nozzle_diameter", "wide")),
        ("printer.max_velocity=-1", ("max_velocity",)),
        ("stepper_x.step_pin=PZ9", ("PZ9",)),
        ("fan.pin=PA1", ("PA1",)),
        ("simulator nozzle nozzle.mass=1", ("mass", "mass_g")),
        ("simulator nozzle nozzle.mass_g=900", ("mass_g", "20")),
        ("simulator nozzle nozzle.fan=none_such", ("none_such",)),
        ("simulator nozzle nozzle.vdc_pin=PA7", ("vdc_scale",)),
        ("simulator nozzle nozzle.supply_v=0:24, 5", ("supply_v", "TIME:VALUE")),
        ("simulator nozzle nozzle.supply_v=5:24, 5:25", ("supply_v", "rise")),
        ("simulator nozzle nozzle.supply_v=0:24, 5:240", ("supply_v", "240", "100")),
        ("simulator load bed.heater_w=0:100, 5:200", ("heater_w", "nozzle")),
        ("no_dot", ("SECTION.OPTION=VALUE",)),
    ],
)
def test_settings_that_cannot_be_are_explained(
    simulate: Simulate, setting: str, words: tuple[str, ...]
) -> None:
    assert_clear(simulate("G28\n", settings=[setting]), 2, *words)


def test_a_missing_section_is_named(simulate: Simulate, tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"
    config.write_text(CONFIG.read_text().replace("[stepper_y]", "[stepper_w]"))
    assert_clear(simulate("G28\n", config=config), 2, "stepper_")


@pytest.mark.parametrize(
    ("gcode", "words"),
    [
        ("G1 X10 Y10 F3000\n", ("home",)),
        ("G28\nG1 X500 F3000\n", ("range",)),
        ("G28\nG1 X50 E5 F600\n", ("extrude",)),
        ("G28\nM104 S900\n", ("temperature",)),
        ("G28\nG1 Xabc\n", ("abc",)),
    ],
)
def test_a_file_that_asks_for_the_impossible_ends_with_its_error(
    simulate: Simulate, gcode: str, words: tuple[str, ...]
) -> None:
    run = simulate(gcode)
    assert run.status == 2, run.stderr
    assert "Traceback" not in run.stderr
    for word in words:
        assert word in run.stderr.lower(), run.stderr
    assert run.summary["exit_status"] == 2
    assert run.summary["faults"]


def test_a_config_of_a_real_printer_is_distinguished_from_a_broken_sensor(simulate: Simulate) -> None:
    config = CONFIG.with_name("example-cartesian.cfg")
    assert_clear(simulate("G28\n", config=config), 2, "no [simulator ...] section", "sim-induction.cfg")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            b"root:x:0:0:root:/root:/bin/bash\ndaemon:x:1:1:daemon:/usr/sbin:/usr/sbin/nologin\n",
            "not G-code: no line",
        ),
        (b"; only\n; remarks\n", "not G-code: no line"),
        (b"\x7fELF\x02\x01\x01\0\0\0G28\n", "not G-code: it is a binary file"),
    ],
)
def test_a_file_that_is_no_g_code_is_not_printed(
    simulate: Simulate, tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "passwd"
    path.write_bytes(content)
    run = simulate(path)
    assert_clear(run, 2, f"passwd is {words}")
    assert run.summary["faults"] == [run.summary["reason"]]


def test_a_part_larger_than_the_bed_is_refused_before_anything_is_heated(simulate: Simulate) -> None:
    run = simulate(HOT + "G1 X20 Y20 Z0.3 F6000\nG1 X181 E1\n")
    assert_clear(run, 2, "part.gcode, line 6: 'G1 X181 E1' is out of range: X 181", "from 0 to 180 mm")
    assert max(run.column("target_c")) == 0.0 and run.summary["simulated_s"] < 5.0


def test_ctrl_c_ends_the_demo_with_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "demo.py"), "--out", str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as demo:
        limit_s, trace = time.monotonic() + 60.0, tmp_path / "trace.csv"
        while not trace.exists():
            assert time.monotonic() < limit_s
            time.sleep(0.05)
        os.killpg(demo.pid, signal.SIGINT)  # as a terminal does: the demo and what it has started
        assert demo.communicate(timeout=30)[1] == "simulate: interrupted\n"
    assert demo.returncode == 130


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            ("fault=4", "fault_code=300"),
            ("Induction heater 'nozzle'", "or the signal stands still", "amplifier"),
        ),
        (("fault=2",), ("Induction heater 'nozzle'", "the coil's signal", "sensing lead open")),
        (("fault=5",), ("Induction heater 'nozzle'", "the coil's signal", "sensing lead open")),
    ],
    ids=["signal stands still", "coil open", "sensing lead open"],
)
def test_a_fault_of_the_coil_s_signal_is_named_as_one(
    simulate: Simulate, fault: tuple[str, ...], words: tuple[str, ...]
) -> None:
    """Not as one of a temperature sensor: this nozzle has none."""
    run = simulate(
        "M109 S200\nG4 P1000\n", settings=[f"simulator nozzle nozzle.{setting}" for setting in fault]
    )
    assert_clear(run, 3, *words)
    assert "temperature sensor" not in run.stderr


def test_an_unknown_command_is_mentioned_and_passed_over(simulate: Simulate) -> None:
    assert simulate("G28\nM9876\nG1 X10 F6000\n").status == 0


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("heater_bed.min_temp=40", r"heater_bed: 2\d\.\d C; allowed are 40 to 120 C"),
        (
            "simulator load bed.fault=1",
            "heater_bed: no temperature, a broken or shorted sensor; allowed are 0 to 120 C",
        ),
    ],
)
def test_a_sensor_out_of_its_range_is_named(simulate: Simulate, setting: str, words: str) -> None:
    run = simulate("G4 P5000\n", settings=[setting])
    assert run.status == 3 and re.search(words, run.summary["reason"]), run.summary["reason"]
    assert "reference:" not in run.summary["reason"]  # the sensor that is well


def test_a_file_that_saves_its_findings_ends_with_the_restart_of_it(
    simulate: Simulate, tmp_path: Path
) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(CONFIG.read_text())
    run = simulate("HEATER_PROFILE HEATER=heater_bed SAVE=mine\nSAVE_CONFIG\nM117 never\n", config=path)
    assert run.status == 0 and "ended by the file's own RESTART or SAVE_CONFIG" in run.summary["reason"]
    assert "[heater_profile heater_bed mine]" in path.read_text()


def test_what_a_file_measures_lies_beside_the_log(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "logs" / "sim.log"
    log.parent.mkdir()
    run = simulate("INDUCTION_DUMP HEATER=nozzle DURATION=0.1\nG4 P500\n", more=["--log", log])
    assert run.status == 0, run.stderr
    assert f"raw blocks to {log.parent}/induction-nozzle-dump.csv" in log.read_text()
    assert (log.parent / "induction-nozzle-dump.csv").stat().st_size > 1000


def test_a_file_writes_where_files_of_commands_belong_and_nowhere_else(
    simulate: Simulate, tmp_path: Path
) -> None:
    config = tmp_path / "printer.cfg"
    config.write_text(f"[include {CONFIG}]\n")
    run = simulate(f"INDUCTION_DUMP HEATER=nozzle FILE={config}\n", config=config)
    assert_clear(run, 2, str(config), "is not in", str(run.log.parent))
    assert config.read_text() == f"[include {CONFIG}]\n"


def test_an_emergency_stop_in_the_file_is_a_shutdown(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "sim.log"
    run = simulate(HOT + "M112\n", more=["--log", log])
    assert run.status == 3
    with log.open() as lines:
        assert "ERROR     error: Transition to shutdown state: Shutdown due to M112" in story(extract(lines))
    assert run.summary["reason"]
    assert run.summary["reason"] in run.stderr
    # the nozzle is on its way down two seconds later
    assert run.column("phase_ticks")[-1] == 0
    assert run.column("true_c")[-1] < 240.0


def test_a_nozzle_whose_signal_is_lost_shuts_the_printer_down(simulate: Simulate) -> None:
    run = simulate(HOT + "G4 P20000\n", settings=["simulator nozzle nozzle.fault=5"])
    assert run.status == 3
    assert run.summary["reason"]
    assert max(run.column("true_c")) < 400.0, "the guard acts before harm is done"
