"""HEATER_PROFILE: tunings under names, on an ordinary heater and an induction nozzle, kept by SAVE_CONFIG."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from system.conftest import CONFIG, Simulate, machine

PROFILES = """
[heater_profile]
[heater_profile heater_bed slow]
control: pid
pid_Kp: 30
pid_Ki: 0.5
pid_Kd: 300
[heater_profile extruder soft]
control: pid
pid_kp_w_per_k: 2
pid_ki_w_per_k_s: 4
pid_kd_w_s_per_k: 0.1
"""


def play(simulate: Simulate, tmp_path: Path, lines: str, status: int = 0) -> tuple[str, Path]:
    """(log, the config file after the run)."""
    path = tmp_path / "printer.cfg"
    run = simulate(lines, config=path if path.exists() else machine(tmp_path, PROFILES))
    assert run.status == status, run.stderr
    return run.log.read_text(), path


def test_a_profile_is_used_saved_listed_and_removed(simulate: Simulate, tmp_path: Path) -> None:
    lines = """
HEATER_PROFILE LIST=1
HEATER_PROFILE HEATER=heater_bed SAVE=mine
HEATER_PROFILE HEATER=heater_bed LOAD=slow
HEATER_PROFILE HEATER=heater_bed LIST=1
HEATER_PROFILE HEATER=heater_bed USE=mine
HEATER_PROFILE HEATER=heater_bed REMOVE=slow
HEATER_PROFILE HEATER=heater_bed LIST=1
"""
    text, _ = play(simulate, tmp_path, lines)
    assert "extruder soft: control=pid" in text
    assert re.search(r"heater_bed slow \(in use\): control=pid", text)
    assert re.search(r"heater_bed mine \(in use\): .*pid_kp=60", text)
    assert "Profile 'slow' of heater 'heater_bed' removed" in text
    last = text[text.rindex("removed; SAVE_CONFIG") :]
    assert "heater_bed mine" in last and "heater_bed slow" not in last
    assert "set [heater_bed] pid_kp = 60" in text  # USE makes it the heater's own


def test_a_nozzle_changes_its_law_while_it_holds_and_goes_on_holding(
    simulate: Simulate, tmp_path: Path
) -> None:
    lines = "HEATER_PROFILE HEATER=extruder SAVE=own\nM109 S200\nG4 P2000\n"
    lines += "HEATER_PROFILE HEATER=extruder LOAD=soft\nG4 P4000\nHEATER_PROFILE HEATER=extruder LOAD=own\nG4 P3000\n"
    run = simulate(lines, config=machine(tmp_path, PROFILES))
    assert run.status == 0, run.stderr
    true = run.column("true_c")
    assert run.log.read_text().count("works with profile") == 2
    assert true[-1] == pytest.approx(200.0, abs=0.5)
    # it goes on at the power it had: 0.33 degC seen, mainly the soft PID's own noise
    assert all(abs(t - 200.0) < 0.6 for t in true[-800:])


def test_a_bed_changes_between_pid_and_model_while_it_holds(simulate: Simulate, tmp_path: Path) -> None:
    more = (
        "[heater_profile]\n[heater_profile heater_bed known]\ncontrol: model\nheater_power_w: 200\n"
        "model_heat_j_per_k: 410\nmodel_element_j_per_k: 110\nmodel_element_w_per_k: 11\nmodel_loss_w_per_k: 1.2\n"
        "model_sensor_lag: 3\nmodel_ambient_temp: 22\n"
    )
    lines = "HEATER_PROFILE HEATER=heater_bed SAVE=own\nM190 S60\nG4 P120000\n"
    lines += "".join(
        f"HEATER_PROFILE HEATER=heater_bed LOAD={name}\nG4 P60000\n" for name in ("known", "own")
    )
    run = simulate(lines, config=machine(tmp_path, more))
    assert run.status == 0, run.stderr
    held = run.column("bed_c")[-12000:]
    assert max(held) - min(held) < 0.5


def test_a_profile_outlives_a_restart_and_so_does_its_removal(simulate: Simulate, tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(CONFIG.read_text() + PROFILES)  # SAVE_CONFIG does not edit included files

    def play_again(lines: str) -> str:
        run = simulate(lines, config=path)
        assert run.status == 0, run.stderr
        return run.log.read_text()

    play_again(
        "HEATER_PROFILE HEATER=heater_bed SAVE=kept\nHEATER_PROFILE HEATER=extruder SAVE=kept\nSAVE_CONFIG RESTART=0\n"
    )
    text = play_again("HEATER_PROFILE HEATER=heater_bed USE=kept\nHEATER_PROFILE HEATER=extruder LOAD=kept\n")
    assert text.count("works with profile 'kept'") + text.count("set [heater_bed] pid_kp = 60") >= 2
    play_again("HEATER_PROFILE HEATER=heater_bed REMOVE=kept\nSAVE_CONFIG RESTART=0\n")
    assert "[heater_profile heater_bed kept]" not in path.read_text()
    assert "[heater_profile extruder kept]" in path.read_text()
    assert "heater_bed kept" not in play_again("HEATER_PROFILE LIST=1\n")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("HEATER_PROFILE HEATER=heater_bed LOAD=none", "no profile 'none' (known: slow)"),
        ("HEATER_PROFILE HEATER=heater_bed", "needs one of SAVE=, LOAD=, USE=, REMOVE="),
        ("HEATER_PROFILE HEATER=heater_bed SAVE=a/b", "no profile name"),
        ("HEATER_PROFILE HEATER=oven SAVE=a", "oven"),
        ("HEATER_PROFILE HEATER=heater_bed SAVE=a LOAD=slow", "needs one of"),
    ],
)
def test_a_bad_command_says_what_would_be_right(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    text, _ = play(simulate, tmp_path, line + "\n", status=2)
    assert words in text
