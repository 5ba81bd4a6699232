"""Commands that tune heaters: a wrong word is reported and harms nothing; a dead sensor is not heated."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from extras.heater import run as heater_run
from simulation.runner import BAD_INPUT, RunOptions, Simulation
from system.conftest import CONFIG, Simulate, machine


def play(simulate: Simulate, tmp_path: Path, lines: str, more: str = "") -> tuple[int, str, list[float]]:
    run = simulate(lines, config=machine(tmp_path, more))
    power = run.column("power_w") if run.trace.exists() else []
    return run.status, run.log.read_text() + run.stderr, power


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("PID_CALIBRATE HEATER=oven TARGET=200", "Unknown heater 'oven'"),
        ("PID_CALIBRATE HEATER=extruder TARGET=20", "TARGET must be 10 C above"),
        ("PID_CALIBRATE HEATER=extruder TARGET=900", "TARGET"),
        ("PID_CALIBRATE HEATER=extruder", "TARGET"),
        ("MODEL_CALIBRATE HEATER=oven", "Unknown heater 'oven'"),
        ("PID_CALIBRATE TARGET=200", "missing HEATER"),
    ],
)
def test_a_bad_command_is_reported_and_nothing_is_heated(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    status, text, power = play(simulate, tmp_path, f"G4 P300\n{line}\n")
    assert status == 2 and words in text, text[-600:]
    assert max(power) < 2.0  # looks of 1.5 W, no heat


@pytest.mark.parametrize("command", ["PID_CALIBRATE", "MODEL_CALIBRATE POWER=200"])
def test_a_bed_that_does_not_warm_its_sensor_ends_the_run(
    simulate: Simulate, tmp_path: Path, command: str
) -> None:
    broken = "[simulator load bed]\nfault: 3\n"
    lines = f"{command} HEATER=heater_bed TARGET=60 WAIT=1\nG4 P1000\n"
    status, text, _ = play(simulate, tmp_path, lines, broken)
    assert status == 3, text[-600:]
    assert "loose or broken heater or sensor" in text  # verify_heater's patience is the shorter one
    assert f"{command.split(maxsplit=1)[0]} ended: the printer stopped. Nothing was changed." in text
    assert "save_config: set" not in text


@pytest.mark.parametrize(("fault", "words"), [(1, "disconnected"), (2, "shorted")])
@pytest.mark.parametrize("command", ["PID_CALIBRATE", "MODEL_CALIBRATE POWER=200"])
def test_a_bed_with_a_dead_sensor_is_not_calibrated(
    simulate: Simulate, tmp_path: Path, command: str, fault: int, words: str
) -> None:
    lines = f"G4 P1900\n{command} HEATER=heater_bed TARGET=60 WAIT=1\nG4 P1000\n"
    status, text, _ = play(simulate, tmp_path, lines, f"[simulator load bed]\nfault: {fault}\n")
    assert status == 2 and "save_config: set" not in text
    assert words in text and "'heater_bed' reads" in text, text[-800:]


def test_a_pid_run_of_the_nozzle_can_be_ended_and_run_again(simulate: Simulate, tmp_path: Path) -> None:
    lines = "PID_CALIBRATE HEATER=extruder TARGET=220 WAIT=0\nG4 P1400\nABORT\nG4 P500\n"
    status, text, power = play(simulate, tmp_path, lines * 2 + "G4 P500\n")
    assert status == 0, text[-600:]
    assert text.count("PID_CALIBRATE ended: ended by ABORT. Nothing was changed.") == 2
    assert max(power) > 50.0 and max(power[-20:]) < 2.0


def test_pid_gains_of_the_nozzle_hold_it(simulate: Simulate, tmp_path: Path) -> None:
    lines = "PID_CALIBRATE HEATER=extruder TARGET=220 KEEP_LAW=pid\nLAW\nM109 S230\nG4 P5000\n"
    status, text, _ = play(simulate, tmp_path, lines, LAW)
    assert status == 0 and "set [induction_heater nozzle] pid_kp_w_per_k" in text
    assert "set [induction_heater nozzle] control = pid" in text and "works with pid" in text
    assert "The new gains are in use" in text and "MODEL_CALIBRATE" not in text


LAW = """
[gcode_macro LAW]
gcode: { action_respond_info("works with %s" % printer["induction_heater nozzle"].control) }
"""


def test_a_nozzle_with_predictive_control_keeps_it_and_says_how_to_change_that(
    simulate: Simulate, tmp_path: Path
) -> None:
    status, text, _ = play(simulate, tmp_path, "PID_CALIBRATE HEATER=extruder TARGET=220\nLAW\n", LAW)
    assert status == 0 and "works with model" in text
    assert (
        "set [induction_heater nozzle] pid_kp_w_per_k" in text
        and "set [induction_heater nozzle] control" not in text
    )
    words = "Heater 'extruder' stays with control: model"
    begun, found = text.index("will swing around"), text.index("PID parameters:")
    assert (
        begun < text.index(words) < found < text.rindex(words)
    )  # before a minute is spent, and with the gains
    assert "MODEL_CALIBRATE HEATER=extruder" in text and "KEEP_LAW=pid changes the law" in text


def test_a_nozzle_with_a_pid_gets_its_new_gains_without_more_words(
    simulate: Simulate, tmp_path: Path
) -> None:
    more = LAW + "[induction_heater nozzle]\ncontrol: pid\n"
    status, text, _ = play(simulate, tmp_path, "PID_CALIBRATE HEATER=nozzle TARGET=220\nLAW\n", more)
    assert status == 0 and "works with pid" in text
    assert "The new gains are in use" in text and "KEEP_LAW" not in text


def test_all_commands_know_the_nozzle_by_both_names(simulate: Simulate, tmp_path: Path) -> None:
    lines = "INDUCTION_STATUS\n"
    for name in ("nozzle", "extruder"):
        lines += f"INDUCTION_STATUS HEATER={name}\nSET_HEATER_TEMPERATURE HEATER={name} TARGET=100\nG4 P500\n"
        lines += f"HEATER_PROFILE HEATER={name} SAVE={name}\nHEATER_PROFILE HEATER={name} LIST=1\n"
        lines += f"HEATER_PROFILE HEATER={name} LOAD={name}\nSET_HEATER_TEMPERATURE HEATER={name} TARGET=0\n"
    lines += "PID_CALIBRATE HEATER=nozzle TARGET=150 WAIT=0\nG4 P500\nABORT\nG4 P500\n"
    status, text, _ = play(simulate, tmp_path, lines + "INDUCTION_DUMP DURATION=0.1\nG4 P500\n")
    assert status == 0, text[-600:]
    assert text.count("Induction heater 'nozzle': law tank") == 3
    assert "extruder nozzle: control=model" in text and "extruder extruder (in use): control=model" in text
    status, text, _ = play(simulate, tmp_path, "MODEL_CALIBRATE TARGET=150\nG4 P500\nABORT\nG4 P500\n")
    assert status == 0 and "MODEL_CALIBRATE: heater 'extruder' up to 150 C" in text


WHILE_HOLDING = {
    "PID_CALIBRATE HEATER=oven TARGET=200": "Unknown heater 'oven'",
    "PID_CALIBRATE HEATER=extruder TARGET=250": "Turn heater 'extruder' off before calibrating it",
    "PID_CALIBRATE HEATER=extruder TARGET=900": "TARGET must have maximum of 300",
    "PID_CALIBRATE HEATER=extruder TARGET=250 KEEP_LAW=model": "only 'pid' can come of it",
    "PID_CALIBRATE HEATER=extruder TARGET=hot": "TARGET: 'hot' is not a number",
    "PID_CALIBRATE HEATER=heater_bed TARGET=60 WAIT=x": "WAIT: 'x' is not a whole number",
    "PID_CALIBRATE HEATER=heater_bed TARGET=23": "TARGET must be 10 C above",
    "MODEL_CALIBRATE HEATER=extruder": "The run begins cold",
    "MODEL_CALIBRATE HEATER=heater_bed": "POWER= in watts",
    "MODEL_CALIBRATE HEATER=heater_bed POWER=-200": "POWER must have minimum of 0.0",
    "MODEL_CALIBRATE HEATER=heater_bed POWER=0.001": "POWER= in watts",
    "MODEL_CALIBRATE HEATER=heater_bed POWER=200 TARGET=25": "TARGET must have minimum of 5",
    "MODEL_CALIBRATE HEATER=heater_bed POWER=200 AMBIENT=500": "AMBIENT must have maximum of 60.0",
    "MODEL_CALIBRATE HEATER=heater_bed POWER=200 FLOW=-1": "FLOW must have minimum of 0.0",
    "HEATER_PROFILE HEATER=extruder LOAD=nope": "has no profile 'nope' (known: before)",
    "HEATER_PROFILE HEATER=extruder SAVE='a b'": "is no profile name",
    "HEATER_PROFILE HEATER=extruder SAVE=a LOAD=before": "needs one of SAVE=, LOAD=, USE=, REMOVE=",
    "HEATER_PROFILE HEATER=oven LIST=1": "Unknown heater 'oven'",
    "HEATER_PROFILE HEATER=heater_bed LOAD=alone": "its MCU takes over (control: mcu_onoff) only at start-up",
    "SET_HEATER_TEMPERATURE HEATER=extruder TARGET=9999": "Requested temperature (9999.0) out of range",
    "SET_HEATER_TEMPERATURE HEATER=extruder TARGET=nan": "TARGET: 'nan' is not a number",
}
KEPT = re.compile(r"save_config: set \[heater_profile (\w+) (before|after)\] (\w+) = (.*)")


def kept(text: str, name: str) -> dict[tuple[str, str], str]:
    """(heater, option) → value of the tuning that HEATER_PROFILE SAVE=name found in use."""
    return {(heater, option): value for heater, n, option, value in KEPT.findall(text) if n == name}


def test_after_refused_commands_the_heaters_go_on_as_they_were(simulate: Simulate, tmp_path: Path) -> None:
    """Each comes from a delayed_gcode, whose error ends nothing else, while the nozzle holds 200 degC."""
    more = "[simulator load bed]\nbody_j_k: 40\nelement_j_k: 60\n"
    more += "[heater_profile heater_bed alone]\ncontrol: mcu_onoff\n"
    for i, command in enumerate(WHILE_HOLDING):
        more += f"[delayed_gcode wrong{i}]\ninitial_duration: {5.0 + 0.1 * i:.1f}\ngcode:\n  {command}\n"
    both = "HEATER_PROFILE HEATER=extruder SAVE={0}\nHEATER_PROFILE HEATER=heater_bed SAVE={0}\n"
    lines = both.format("before") + "M109 S200\nG4 P8000\nM400\nM190 S50\n" + both.format("after")
    run = simulate(lines + "M109 S230\nG4 P1000\n", config=machine(tmp_path, more))
    text = run.log.read_text()
    for i, (command, words) in enumerate(WHILE_HOLDING.items()):
        said = [line for line in text.splitlines() if line.startswith(f"delayed_gcode wrong{i}: ")]
        assert len(said) == 1 and words in said[0], (command, said)
    assert "Traceback" not in text and "internal error" not in text
    assert kept(text, "before") and kept(text, "before") == kept(text, "after")
    assert set(re.findall(r"save_config: set \[([^]]*)\]", text)) == {
        f"heater_profile {heater} {name}"
        for heater in ("extruder", "heater_bed")
        for name in ("before", "after")
    }
    true_c, target_c = run.column("true_c"), run.column("target_c")
    held = [c for c, t, s in zip(true_c, target_c, run.column("t_s"), strict=True) if t == 200.0 and s > 5.0]
    assert held and all(abs(c - 200.0) < 1.0 for c in held)
    assert true_c[-1] == pytest.approx(230.0, abs=1.0)
    assert run.column("bed_c")[-1] == pytest.approx(50.0, abs=2.0)


@pytest.mark.parametrize(
    "command", ["PID_CALIBRATE HEATER=extruder TARGET=220", "MODEL_CALIBRATE HEATER=extruder"]
)
def test_after_an_ended_run_the_nozzle_has_its_tuning_and_takes_a_target(
    simulate: Simulate, tmp_path: Path, command: str
) -> None:
    lines = f"HEATER_PROFILE HEATER=extruder SAVE=before\n{command} WAIT=0\nG4 P2500\nABORT\nG4 P500\n"
    lines += "HEATER_PROFILE HEATER=extruder SAVE=after\nM109 S200\nG4 P1000\n"
    run = simulate(lines, config=machine(tmp_path))
    text = run.log.read_text()
    assert run.status == 0, run.stderr
    assert "ended: ended by ABORT. Nothing was changed." in text
    assert kept(text, "before") and kept(text, "before") == kept(text, "after")
    assert run.column("true_c")[-1] == pytest.approx(200.0, abs=0.5)


def test_while_a_heater_is_calibrated_its_law_is_neither_replaced_nor_kept_as_a_profile(
    simulate: Simulate, tmp_path: Path
) -> None:
    """The run is the law for that time: another one in its place would hold the heater hot, and no run would end it."""
    more = "[heater_profile extruder swings]\ncontrol: watermark\n"
    for i, verb in enumerate(("LOAD=swings", "SAVE=run")):
        command = f"HEATER_PROFILE HEATER=extruder {verb}"
        more += f"[delayed_gcode early{i}]\ninitial_duration: {3.0 + 0.1 * i:.1f}\ngcode:\n  {command}\n"
    lines = "PID_CALIBRATE HEATER=extruder TARGET=220 WAIT=0\n" + "G4 P500\n" * 40
    _, text, _ = play(simulate, tmp_path, lines, more)
    for i in range(2):
        assert f"delayed_gcode early{i}: Heater 'extruder' is being calibrated; ABORT ends that" in text
    assert "PID parameters: " in text and "heater_profile extruder run" not in text


@pytest.mark.parametrize(
    "command", ["PID_CALIBRATE HEATER=extruder TARGET=220", "INDUCTION_CALIBRATE REFERENCE=reference"]
)
def test_a_target_is_refused_while_the_nozzle_is_calibrated_and_turning_it_off_ends_that(
    simulate: Simulate, tmp_path: Path, command: str
) -> None:
    more = "[delayed_gcode early]\ninitial_duration: 3\ngcode:\n  M104 S200\n"
    lines = f"{command} WAIT=0\n" + "G4 P500\n" * 13 + "M104 S0\nG4 P1000\n"
    status, text, power = play(simulate, tmp_path, lines, more)
    assert status == 2, text[-600:]  # the refused one
    assert "delayed_gcode early: Heater 'extruder' is being calibrated; ABORT ends that" in text
    assert "ended: the heater was turned off. Nothing was changed." in text
    assert max(power[-20:]) < 2.0


def test_an_uncalibrated_nozzle_refuses_a_pid_run_and_keeps_its_law(
    simulate: Simulate, tmp_path: Path
) -> None:
    more = LAW + "[induction_heater nozzle]\nestimator: uncalibrated\n"
    more += "[delayed_gcode wrong]\ninitial_duration: 3\ngcode:\n  PID_CALIBRATE HEATER=extruder TARGET=220\n"
    status, text, _ = play(simulate, tmp_path, "G4 P500\n" * 10 + "LAW\n", more)
    assert status == 2 and "delayed_gcode wrong: Heater 'extruder' is not calibrated" in text
    assert "works with model" in text


@pytest.mark.parametrize("command", ["MODEL_CALIBRATE HEATER=extruder", "INDUCTION_CALIBRATE HEATER=nozzle"])
def test_a_run_whose_fit_lacks_a_package_does_not_begin(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is evaluated minutes later, with the packages of requirements.txt."""
    monkeypatch.setattr(heater_run, "FIT_PACKAGES", ("numpy", "no_such_package"))
    gcode = tmp_path / "calibrate.gcode"
    gcode.write_text(command + "\n")
    outcome = Simulation(RunOptions(CONFIG, gcode)).run()
    assert outcome.status == BAD_INPUT, outcome.reason
    assert "missing: no_such_package. Run scripts/install.sh" in outcome.reason
