"""The temperature plan in a print: ahead of the path, within the user's word, and without a trace when it is off."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from plan_rig import SECTION
from system.conftest import Simulate, machine, square

START = "M104 S215\nG28\nM83\nG1 X40 Y40 Z0.3 F6000\nM109 S215\n"
LINE_E = 5.0 * 1.5 / 2.405  # 5 mm3/s over 1.5 s


def config(folder: Path, more: str = "", section: str = SECTION) -> Path:
    return machine(folder, section + more)


def steps(count: int = 14) -> str:
    """Lines of 1.5 s on one straight way, so without a change of flow; wanted melt 15 degC up and down."""
    lines = [START, "G1 X6 F6000", "G4 P30000"]  # the holder takes 10 s to warm through
    for i in range(count):
        lines.append(f"SET_SEGMENT_TEMPERATURE TEMP={200 + 15 * (i % 2)}")
        lines.append(f"G1 X{18 + 12 * i} E{LINE_E:.5f} F480")
    return "\n".join([*lines, "M400", ""])


def melt_error(run) -> float:  # type: ignore[no-untyped-def]
    """Rms of extruded against requested melt, lines but the first two, degC."""
    trace = np.genfromtxt(run.trace, delimiter=",", names=True)
    deposited = (trace["flow_mm3_s"] > 1.0) & (trace["x_mm"] > 30.0) & np.isfinite(trace["melt_target_c"])
    return float(np.sqrt(np.mean((trace["melt_c"] - trace["melt_target_c"])[deposited] ** 2)))


def test_preview_halves_the_melts_error_at_steps(simulate: Simulate, tmp_path: Path) -> None:
    """15 degC every 1.5 s: less than half of what turning the nozzle at the border gives. The nozzle's holder and its
    losses are not those that the plan assumes."""
    errors = {}
    other = "[simulator nozzle nozzle]\nsecond_j_k: 0.744\nloss_factor: 1.1\n"
    for preview in ("yes", "no"):
        run = simulate(steps(), config=config(tmp_path, f"preview: {preview}\n{other}"))
        assert run.status == 0, run.stderr
        errors[preview] = melt_error(run)
    assert errors["yes"] < 0.5 * errors["no"], errors


def test_the_trace_has_the_requested_melt_temperature_while_filament_flows(
    simulate: Simulate, tmp_path: Path
) -> None:
    record = tmp_path / "rows.csv"
    run = simulate(steps(4), config=config(tmp_path, f"record: {record}\n"))
    trace = np.genfromtxt(run.trace, delimiter=",", names=True)
    requested = trace["melt_target_c"][(trace["flow_mm3_s"] > 4.0)]
    assert set(requested[np.isfinite(requested)]) == {200.0, 215.0}
    assert np.mean(np.isfinite(requested)) > 0.98  # the flow lags behind the plan by 20 ms
    assert not np.isfinite(trace["melt_target_c"][trace["x_mm"] < 5.0]).any()
    rows = np.genfromtxt(record, delimiter=",", names=True)
    assert set(rows["wanted_melt_c"]) == {200.0, 215.0}


def test_a_disabled_plan_changes_no_byte(simulate: Simulate, tmp_path: Path) -> None:
    plain = simulate(square(), config=config(tmp_path, section=""))
    disabled = simulate(square(), config=config(tmp_path, "enable: no\n"))
    enabled = simulate(square(), config=config(tmp_path, "layers:\n  1: 210\n"))
    assert plain.trace.read_bytes() == disabled.trace.read_bytes()
    assert plain.trace.read_bytes() != enabled.trace.read_bytes()


def test_the_users_word_wins_and_the_plan_goes_home(simulate: Simulate, tmp_path: Path) -> None:
    """During planned path M104 S0 turns the heater off at once; after path the target is the user's again."""
    lines = "".join(f"G1 X{90 if i % 2 else 40} E{LINE_E:.4f} F2400\n" for i in range(6))
    gcode = (
        f"{START}M104.1 S228\n{lines}M400\nG4 P3000\nTEMPERATURE_PLAN\n"
        f"M104.1 S0\n{lines}M104 S0\nM400\nG4 P500\nTEMPERATURE_PLAN ENABLE=0\n"
    )
    run = simulate(gcode, config=config(tmp_path))
    assert run.status == 0, run.stderr
    target, true, flow = (np.array(run.column(name)) for name in ("target_c", "true_c", "flow_mm3_s"))
    first = np.flatnonzero(flow > 1.0)
    hot = target[first[50] : first[50] + 500]
    assert hot.max() > 235.0  # a melt of 228 needs a wall well above it at this flow
    assert np.any(np.abs(target[first[-1] - 500 : first[-1]] - 215.0) < 0.5)  # the user's again
    span = target[first[0] : first[-1] - 500]
    assert np.diff(span).min() > -1.0, np.diff(span).min()  # home by a ramp, not by a jump
    assert target[-1] == 0.0 and true[-1] < 215.0
    assert "Temperature plan (PLA" in run.log.read_text()


def test_a_targets_repetition_in_the_file_disturbs_nothing(simulate: Simulate, tmp_path: Path) -> None:
    """Slicers say M104 again, with the target that is already there; the plan of what is queued goes on."""
    lines = [f"G1 X{90 if i % 2 else 40} E{LINE_E:.4f} F2400\n" for i in range(6)]
    plain = simulate(START + "M104.1 S228\n" + "".join(lines) + "M400\n", config=config(tmp_path))
    repeated = "M104 S215\n".join(lines)
    again = simulate(START + "M104.1 S228\n" + repeated + "M400\n", config=config(tmp_path))
    assert plain.status == again.status == 0
    assert again.trace.read_bytes() == plain.trace.read_bytes()


def test_another_target_in_mid_print_moves_the_plan_by_as_much(simulate: Simulate, tmp_path: Path) -> None:
    """M104 S205 after S215: what is not asked for by name is deposited 10 degC cooler, at once, without a jolt home."""
    lines = [f"G1 X{90 if i % 2 else 40} E{LINE_E:.4f} F2400\n" for i in range(6)]
    section = SECTION.replace("bonding: no", "bonding: yes\ninterface_temp: 130")
    targets = []
    for change in ("", "M104 S205\n"):
        gcode = START + "".join(lines[:4]) + change + "".join(lines[4:]) + "M400\n"
        run = simulate(gcode, config=config(tmp_path, section=section))
        assert run.status == 0, run.stderr
        deposited = np.array(run.column("flow_mm3_s")) > 1.0
        targets.append((np.flatnonzero(deposited), np.array(run.column("target_c"))))
    (at, before), (_, after) = targets
    last = slice(at[-1] - 100, at[-1] - 40)  # the sixth line, far behind the change
    # the road beside is cooler by then, too, which the weld wants made up for: a little less than 10
    assert 6.0 < np.mean(before[last] - after[last]) < 10.5
    printed = after[at[0] : at[-1]]
    # 30 ms, since the target moves with the steps of control: a ramp that the nozzle can go, no jump
    assert np.abs(printed[3:] - printed[:-3]).max() < 6.0


@pytest.mark.parametrize("how", ["M220 S50\n", "G4 P4000\n"])
def test_a_print_that_waits_or_slows_is_deposited_as_asked(
    simulate: Simulate, tmp_path: Path, how: str
) -> None:
    """Whatever stretches the print, the melt under way is that which was asked for, and nothing is left behind."""
    record = tmp_path / "rows.csv"
    lines = [f"G1 X{90 if i % 2 else 40} Y{40 + i} E{LINE_E:.4f} F2400\n" for i in range(4)]
    gcode = f"{START}M104.1 S228\n{''.join(lines[:2])}{how}{''.join(lines[2:])}M104.1 S0\nM400\nG4 P9000\n"
    more = f"record: {record}\n"
    run = simulate(gcode, config=config(tmp_path, more))
    assert run.status == 0, run.stderr
    rows = np.genfromtxt(record, delimiter=",", names=True)
    assert np.all(rows["wanted_melt_c"] == 228.0)
    assert np.sum(rows["end_s"] - rows["start_s"]) > 3.7  # three lines of 1.27 s, the first stands at its end
    settled = np.abs(rows["melt_c"] - 228.0)[len(rows) // 3 :]
    assert np.median(settled) < 1.0
    assert np.array(run.column("target_c"))[-1] == pytest.approx(215.0)  # home


def test_a_record_on_a_full_disk_ends_and_the_print_goes_on(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "log"
    lines = [f"G1 X{90 if i % 2 else 40} Y{40 + i} E{LINE_E:.4f} F2400\n" for i in range(40)]
    gcode = f"{START}M104.1 S228\n{''.join(lines)}M104.1 S0\nM400\nG4 P9000\n"
    run = simulate(gcode, config=config(tmp_path, "record: /dev/full\n"), more=["--log", str(log)])
    assert run.status == 0, run.stderr
    text = log.read_text()
    assert text.count("the record /dev/full ends: No space left on device") == 1
    assert "Traceback" not in text
    assert run.column("target_c")[-1] == pytest.approx(215.0)  # home: the plan was at work to its end


def test_a_hot_tower_is_deposited_more_slowly(simulate: Simulate, tmp_path: Path) -> None:
    """Layers of 1.6 s would stay above what the coolest melt can weld at 130 degC; without leave nothing changes."""
    layers = "".join(
        f";LAYER_CHANGE\nG1 Z{0.3 + 0.2 * n:.1f} F600\nG1 X58 E0.8 F1800\nG1 Y58 E0.8\nG1 X50 E0.8\nG1 Y50 E0.8\n"
        for n in range(14)
    )
    gcode = START + "G1 X50 Y50 F6000\n" + layers + "M400\n"
    section = SECTION.replace("bonding: no", "bonding: yes\ninterface_temp: 125\nchamber_temp: 40")
    seconds = {}
    for slowest in (1.0, 0.25):
        run = simulate(
            gcode + "TEMPERATURE_PLAN\n",
            config=config(tmp_path, f"minimum_speed_factor: {slowest}\n", section=section),
        )
        assert run.status == 0, run.stderr
        flow = np.array(run.column("flow_mm3_s"))
        seconds[slowest] = 0.01 * np.sum(flow > 0.2)
        log = run.log.read_text()
        slowed = slowest < 1.0
        assert log.count("A hot layer is deposited at") == slowed, "once, and only where it is"
        assert ("s longer" in log) == slowed
    assert 1.5 * seconds[1.0] < seconds[0.25] < 4.5 * seconds[1.0], seconds


def test_features_and_layers_of_a_sliced_file_are_deposited_as_asked(
    simulate: Simulate, tmp_path: Path
) -> None:
    record = tmp_path / "rows.csv"
    body = ""
    for layer in range(3):
        body += f";LAYER_CHANGE\n;TYPE:External perimeter\nG1 X100 Y{50 + layer} E{LINE_E:.4f} F2400\n"
        body += f";TYPE:Internal infill\nG1 X40 Y{50 + layer} E{LINE_E:.4f}\n"
    more = f"features:\n  outer wall: 205\nlayers:\n  2-3: 222\nrecord: {record}\n"
    run = simulate(START + body + "M400\n", config=config(tmp_path, more))
    assert run.status == 0, run.stderr
    with record.open(newline="") as stream:
        rows = [float(row["wanted_melt_c"]) for row in csv.DictReader(stream) if float(row["end_s"]) > 0]
    assert set(rows[-4:]) == {222.0}
    assert 205.0 in rows
    order = [value for i, value in enumerate(rows) if not i or value != rows[i - 1]]
    assert [round(v) for v in order[-5:]] == [205, 222, 205, 222][-5:] or order.count(205.0) == 3


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("SET_SEGMENT_TEMPERATURE TEMP=120", "min_extrude_temp"),
        ("SET_SEGMENT_TEMPERATURE", "TEMP"),
        ("SET_SEGMENT_TEMPERATURE TEMP=200 UNTIL=tomorrow", "layer, feature or object"),
        ("SET_SEGMENT_TEMPERATURE TEMP=900", "TEMP"),
        ("TEMPERATURE_PLAN MATERIAL=WOOD", "ABS"),
    ],
)
def test_a_bad_command_says_what_would_be_right(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    run = simulate(f"{line}\n", config=config(tmp_path))
    assert words in run.log.read_text()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("material: WOOD\n", "material"),
        ("layers:\n  9-1: 210\n", "ends before it begins"),
        ("power_share: 0.02\n", "below the lowest temperature"),
        ("heater: heater_bed\n", "no [induction_heater]"),
        ("melt_max: 100\n", "melt_max"),
        ("melt_min: 240\n", "not below melt_max, which is 230 C (printer.cfg, line 4)"),
        ("features:\n  infill: warm\n", "'warm' is not a number (printer.cfg, line 4)"),
        ("features:\n  infill: 2000\n", "PLA, which is deposited at 190 to 230 C; melt_min and melt_max say"),
        ("objects:\n  cube: 20\n", "'CUBE: 20' is no melt of PLA"),
        ("layers:\n  2-3: 20\n", "'2-3: 20' is no melt of PLA"),
        ("heights:\n  0.5-3: 231\n", "'0.5-3: 231' is no melt of PLA"),
        ("melt_max: 400\nlayers:\n  1: 340\n", "to 315 C (5 below max_temp) are (printer.cfg, line 5)"),
        ("record: /nowhere/rows.csv\n", "there is no folder '/nowhere'"),
        (
            "record: /\n",
            "'/' is a folder; the name of a file in a folder that exists is needed (printer.cfg, line 4)",
        ),
    ],
)
def test_a_bad_section_is_refused_by_name(simulate: Simulate, tmp_path: Path, more: str, words: str) -> None:
    section = "\n[temperature_plan]\n" + more
    run = simulate("M400\n", config=config(tmp_path, section=section))
    assert run.status == 2 and words in run.stderr, run.stderr
    assert "Internal error" not in run.stderr


def lines(count: int, y_mm: float = 40.0) -> str:
    """Roads of 1.27 s to and fro, each beside the one before."""
    return "".join(f"G1 X{40 if i % 2 else 90} Y{y_mm + i} E{LINE_E:.4f} F2400\n" for i in range(count))


def planned_run(simulate: Simulate, folder: Path, gcode: str, more: str = "", args: tuple[str, ...] = ()):  # type: ignore[no-untyped-def]
    """(run, rows deposited, its log): six lines of melt: the tests mean 228 degC, the user says 215."""
    record = folder / "rows.csv"
    run = simulate(
        f"{START}M104.1 S228\n{gcode}", config=config(folder, f"record: {record}\n{more}"), more=args
    )
    assert run.status == 0, run.stderr
    return run, np.genfromtxt(record, delimiter=",", names=True), run.log.read_text()


def test_a_pause_holds_the_users_target_and_resume_the_plan(simulate: Simulate, tmp_path: Path) -> None:
    """Paused for 16 s: what is queued is deposited as planned, then 215; the rest as planned again, nothing is lost."""
    more = (
        "[pause_resume]\n[delayed_gcode later]\ngcode:\n  RESUME\n"
        "[gcode_macro PAUSE]\nrename_existing: BASE_PAUSE\nvariable_target: 0\ngcode:\n  BASE_PAUSE\n"
        "  SET_GCODE_VARIABLE MACRO=PAUSE VARIABLE=target VALUE={printer.extruder.target}\n"
        "  UPDATE_DELAYED_GCODE ID=later DURATION=16\n"
        "[gcode_macro RESUME]\nrename_existing: BASE_RESUME\ngcode:\n"
        '  M104 S{printer["gcode_macro PAUSE"].target}\n  BASE_RESUME\n'
    )
    gcode = f"{lines(4)}PAUSE\n{lines(4, 50.0)}M400\nG4 P9000\nM400\n"
    run, rows, _ = planned_run(simulate, tmp_path, gcode, more, ("--until", "200"))
    assert run.summary["reason"] == "printed to its end"
    deposited = rows[np.isfinite(rows["interface_c"])]
    assert np.all(deposited["wanted_melt_c"] == 228.0)
    assert np.sum(deposited["end_s"] - deposited["start_s"]) == pytest.approx(8 * 1.27, rel=0.05)
    target, flow = np.array(run.column("target_c")), np.array(run.column("flow_mm3_s"))
    extruding = np.flatnonzero(flow > 1.0)
    gap = np.argmax(np.diff(extruding))
    paused = slice(extruding[gap], extruding[gap + 1])
    assert 0.01 * (paused.stop - paused.start) > 8.0
    # home as fast as a nozzle without flow cools, 38 degC in 7 s (10 degC/s in the beginning, but its holder stays
    # warm), off again shortly before the road
    assert np.abs(target[paused][750:-300] - 215.0).max() < 0.1
    middle = slice(extruding[gap + 1] + 200, extruding[-1] - 100)
    assert target[middle].min() > 235.0  # as before the pause: 228 in the melt
    assert target[-1] == pytest.approx(
        215.0, abs=0.1
    )  # what a PAUSE macro has saved is the user's, not the plan's


def test_cancel_deposits_what_is_queued_and_ends_the_plan(simulate: Simulate, tmp_path: Path) -> None:
    more = (
        "[pause_resume]\n[gcode_macro CANCEL_PRINT]\nrename_existing: BASE_CANCEL\ngcode:\n  BASE_CANCEL\n"
        "  G4 P8000\n  TEMPERATURE_PLAN\n"
    )
    run, rows, log = planned_run(simulate, tmp_path, f"{lines(4)}CANCEL_PRINT\n{lines(4, 50.0)}", more)
    deposited = rows[np.isfinite(rows["interface_c"])]
    assert np.sum(deposited["end_s"] - deposited["start_s"]) == pytest.approx(
        4 * 1.27, rel=0.05
    )  # what was queued
    assert np.array(run.column("target_c"))[-1] == pytest.approx(215.0, abs=0.1)
    assert "Temperature plan (PLA, welds above" in log


def test_m109_in_mid_print_waits_for_the_path_and_not_for_ever(simulate: Simulate, tmp_path: Path) -> None:
    """It is the user's target from then on; the file goes on when the nozzle is there."""
    gcode = f"{lines(4)}M109 S205\nM104.1 S0\n{lines(4, 50.0)}M400\nG4 P3000\nM400\n"
    run, rows, _ = planned_run(simulate, tmp_path, gcode)
    deposited = rows[np.isfinite(rows["interface_c"])]
    assert np.sum(deposited["end_s"] - deposited["start_s"]) == pytest.approx(8 * 1.27, rel=0.05)
    true, flow = np.array(run.column("true_c")), np.array(run.column("flow_mm3_s"))
    extruding = np.flatnonzero(flow > 1.0)
    gap = np.argmax(np.diff(extruding))
    waited_s = 0.01 * np.diff(extruding)[gap]
    assert 1.0 < waited_s < 15.0  # 33 degC down at 10 degC/s, and until it is settled
    assert true[extruding[gap + 1] - 60 : extruding[gap + 1]].min() == pytest.approx(205.0, abs=1.0)
    assert np.array(run.column("target_c"))[-1] == pytest.approx(205.0, abs=0.1)


SECOND_TOOL = """
[extruder1]
step_pin: PG0
dir_pin: PG1
rotation_distance: 7.7
microsteps: 16
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: PG2
sensor_type: EPCOS 100K B57560G104F
sensor_pin: PG3
control: pid
pid_kp: 25
pid_ki: 1
pid_kd: 100
min_temp: 0
max_temp: 300
min_extrude_temp: 0
[simulator load extruder1]
heater_pin: PG2
sensor_pin: PG3
"""


def test_another_tools_roads_are_left_out(simulate: Simulate, tmp_path: Path) -> None:
    """Only roads of the planned nozzle are in the totals, and while the other prints it goes to the user's target."""
    gcode = (
        f"{lines(4)}ACTIVATE_EXTRUDER EXTRUDER=extruder1\n{lines(10, 50.0)}"
        f"ACTIVATE_EXTRUDER EXTRUDER=extruder\n{lines(4, 60.0)}M400\nG4 P3000\nM400\n"
    )
    run, rows, _ = planned_run(simulate, tmp_path, gcode, SECOND_TOOL)
    deposited = rows[np.isfinite(rows["interface_c"])]
    assert np.sum(deposited["end_s"] - deposited["start_s"]) == pytest.approx(8 * 1.27, rel=0.05)
    target, flow = np.array(run.column("target_c")), np.array(run.column("flow_mm3_s"))
    extruding = np.flatnonzero(flow > 1.0)
    gap = np.argmax(np.diff(extruding))
    other = target[extruding[gap] : extruding[gap + 1]]
    assert len(other) > 1100 and np.abs(other[750:-250] - 215.0).max() < 0.1  # 7 s as in a pause
