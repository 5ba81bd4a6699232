"""A file written by plan_temperature.py --emit, printed by a printer that has no plan: as its report foretold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import plan_temperature
from path_rig import offline_plan
from plan_rig import watch
from simulation import plan_offline
from system.conftest import CONFIG, ROOT, Simulate, machine

SECTION = (
    "[temperature_plan]\nmaterial: PLA\nbonding: no\nmelt_min: 190\nmelt_max: 240\nfeatures:\n  perimeter: 200\n"
    "  infill: 225\n"
)
PAUSES = (
    "[pause_resume]\n[delayed_gcode later]\ngcode:\n  RESUME\n"
    "[gcode_macro PAUSE]\nrename_existing: BASE_PAUSE\ngcode:\n  BASE_PAUSE\n"
    "  UPDATE_DELAYED_GCODE ID=later DURATION=6\n"
)
START = "M104 S215\nG28\nG90\nM83\nG1 X40 Y40 Z0.3 F6000\nM109 S215\n"
FILAMENT_MM2 = 2.405
STEP_C = 2.0
# M104 acts when it is read: about 1 s before its path, and two roads more that wait in the look-ahead. Then
# the nozzle needs its time: 26 degC down, at 10 degC/s and slowing down, with its holder still warm.
EARLY_S, SETTLE_S = 2.5, 5.0
ROAD_S, ROADS = 0.5, 24
# The minimum change that is written, half a degree of rounding, and what the control is off while the flow changes.
TOLERANCE_C = STEP_C + 0.5 + 0.5


def road(number: int, flow: float = 4.0) -> str:
    """25 mm in X, on a Y of its own."""
    e_mm, feed = flow * ROAD_S / FILAMENT_MM2, 60.0 * 25.0 / ROAD_S
    return f"G1 Y{50 + number} F6000\nG1 X{65 if number % 2 else 40} E{e_mm:.4f} F{feed:.1f}"


def part() -> str:
    """Four stretches of two features; between them a rest, a slower factor, a pause."""
    lines = []
    for stretch, between in enumerate(("G4 P3000", "M220 S60", "PAUSE", "M220 S100")):
        lines.append(f";TYPE:{'Perimeter' if stretch % 2 else 'Infill'}")
        lines += [road(ROADS * stretch + i) for i in range(ROADS)]
        lines.append(between)
    return START + "G1 X65 Y50 F6000\n" + "\n".join(lines) + "\nM400\nM104 S0\n"


def emitted(folder: Path, gcode: str, section: str) -> tuple[str, plan_offline.OfflinePlan]:
    """(the file that --emit writes, the plan that it is made of)."""
    config, source, target = folder / "plan.cfg", folder / "plain.gcode", folder / "planned.gcode"
    config.write_text(f"[include {CONFIG}]\n{section}")
    source.write_text(gcode)
    tool = ROOT / "scripts" / "plan_temperature.py"
    command = [sys.executable, tool, source, "--config", config, "--emit", target, "--step", STEP_C]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target.read_text(), offline_plan(folder, gcode, config.read_text())


def test_an_emitted_file_prints_as_predicted(simulate: Simulate, tmp_path: Path) -> None:
    """Also where the file slows down, rests and pauses: a target is that of its road, whenever that comes."""
    text, foretold = emitted(tmp_path, part(), SECTION)
    assert text.count(";planned") >= 3  # one a stretch at least
    run = simulate(text, config=machine(tmp_path, PAUSES), more=["--until", "300"])
    assert run.status == 0 and run.summary["reason"] == "printed to its end", run.stderr
    trace = np.genfromtxt(run.trace, delimiter=",", names=True)
    deposited, looked = trace["flow_mm3_s"] > 0.5, 0
    walls = {round(m.end_mm[1]): m.wall_c for m in foretold.moves}
    times = {y: trace["t_s"][deposited & (np.abs(trace["y_mm"] - y) < 0.05)] for y in walls}
    changes = [
        times[b][0] for a, b in zip(walls, list(walls)[1:], strict=False) if abs(walls[a] - walls[b]) > 5.0
    ]
    assert len(changes) >= 3  # and where M220 makes the flow less
    for y, wall_c in walls.items():
        here = times[y]
        quiet = np.array([all(not -EARLY_S < t - c < SETTLE_S for c in changes) for t in here])
        true = np.interp(here[quiet], trace["t_s"], trace["true_c"])
        looked += len(true)
        assert true == pytest.approx(wall_c, abs=TOLERANCE_C)
    assert looked > 1000  # rows of 10 ms, of 48 s of roads and more
    assert max(walls.values()) - min(walls.values()) > 25.0


def test_the_offline_plan_knows_the_nozzle_of_the_config(tmp_path: Path) -> None:
    """Its limits and what SAVE_CONFIG wrote, as the printer itself reads them."""
    config, gcode = tmp_path / "printer.cfg", tmp_path / "part.gcode"
    config.write_text(
        f"[include {CONFIG}]\n[temperature_plan]\nmaterial: ABS\npower_share: 0.6\nmelt_volume: 3\n"
        "[extruder]\nmin_extrude_temp: 181\n[induction_heater nozzle]\nmax_temp: 290\n"
        "#*# <---------------------- SAVE_CONFIG ---------------------->\n"
        "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.\n#*#\n"
        "#*# [induction_heater nozzle]\n#*# melt_exchange = 0.0333\n#*# heat_capacity_j_per_k = 0.45\n"
    )
    gcode.write_text("G28\n")
    options = plan_temperature.parse([str(gcode), "--config", str(config)])
    access, settings, induction = plan_temperature.read_config(options)
    offline, planner = plan_temperature.limits_of("induction", access, settings), watch(config, gcode).planner
    assert induction and offline == planner.session.nozzle
    assert (offline.max_c, offline.min_extrude_c, offline.capacity.at(25.0)) == (285.0, 181.0, 0.45)
    assert (offline.exchange.ua_w_k, offline.exchange.volume_mm3) == (0.0333, 3.0)


def test_an_emitted_speed_prints_in_the_predicted_time(simulate: Simulate, tmp_path: Path) -> None:
    """A hot tower of layers of 1.6 s: M220 in the file, and the roads take as long as the plan reckons."""
    layers = "".join(
        f";LAYER_CHANGE\nG1 Z{0.3 + 0.2 * n:.1f} F600\nG1 X58 E0.8 F1800\nG1 Y58 E0.8\nG1 X50 E0.8\nG1 Y50 E0.8\n"
        for n in range(10)
    )
    gcode = f"{START}G1 X50 Y50 F6000\n{layers}M104 S0\n"
    section = SECTION.partition("features")[0].replace("bonding: no", "bonding: yes\ninterface_temp: 125")
    text, foretold = emitted(tmp_path, gcode, section)
    assert min(change.speed.factor for change in foretold.speed_changes) < 0.6
    assert "M220 S" in text
    run = simulate(text)
    assert run.status == 0, run.stderr
    flow = np.array(run.column("flow_mm3_s"))
    starts = [move.start_s for move in foretold.moves]
    deposited_s = 0.01 * (np.flatnonzero(flow > 0.2)[-1] - np.flatnonzero(flow > 0.2)[0])
    assert deposited_s == pytest.approx(
        foretold.duration_s - starts[0], rel=0.03
    )  # M220 slows the way up, too
