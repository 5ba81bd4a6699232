"""A coil above the bed as the probe, in closed loop: a simulated LDC1612, its drift, the real firmware's trigger."""

from __future__ import annotations

import statistics
from pathlib import Path

import pytest

import eddy_rig
from eddy_rig import CALIBRATE, FORCE, SECTION, START
from probe_rig import FLAT, Option, bed
from probe_rig import run as run_probe
from simulation.runner import BAD_INPUT, PRINTED

# 0.2 um of standard deviation (scripts/bench/probe_figures.py), and what lies between the points of the curve
MEASURED_MM = 0.0015


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> list[Option]:
    """The options of a calibrated probe."""
    result = eddy_rig.run(tmp_path_factory.mktemp("eddy"), CALIBRATE)
    assert result.status == PRINTED, result.reason
    assert "z: 0.530 # noise 0.000" in result.text and "Total frequency range" in result.text
    return eddy_rig.calibration(result)


def test_homing_stops_at_the_height_and_probing_measures_it(tmp_path: Path, known: list[Option]) -> None:
    result = eddy_rig.run(tmp_path, "G28\nG1 Z2 F600\nPROBE\nPROBE METHOD=scan\n", known)
    assert result.status == PRINTED, result.reason
    ((_, _, z),) = result.found()
    assert z == pytest.approx(0.5, abs=MEASURED_MM)
    assert result.status_of("probe")["last_z_result"] == pytest.approx(0.5, abs=MEASURED_MM)
    place = result.object("toolhead").get_position()[2]
    assert result.axis_mm("z") == pytest.approx(place, abs=0.002)


def test_repeated_probings_agree(tmp_path: Path, known: list[Option]) -> None:
    result = eddy_rig.run(tmp_path, f"{START}G1 Z1.5 F600\nPROBE_ACCURACY SAMPLES=30\n", known)
    assert result.status == PRINTED, result.reason
    heights = [z for _, _, z in result.found()]
    assert statistics.pstdev(heights) < 0.001
    assert statistics.fmean(heights) == pytest.approx(0.5, abs=MEASURED_MM)
    seconds = (result.times[-1] - result.times[0]) / 29
    assert seconds < 1.0


@pytest.mark.parametrize(
    ("method", "limit_mm"), [("automatic", 0.003), ("scan", 0.003), ("rapid_scan", 0.006)]
)
def test_a_mesh_is_the_bed(tmp_path: Path, known: list[Option], method: str, limit_mm: float) -> None:
    """Below the coil, not below the nozzle. In 40 ms of a scan the head goes 8 mm over the bump."""
    shape = bed(
        bed_height=0.0, tilt_x=0.001, tilt_y=-0.0005, bump_height=0.1, bump_x=70, bump_y=130, bump_radius=60
    )
    gcode = f"{START}G1 Z2 F600\nBED_MESH_CALIBRATE METHOD={method} PROBE_COUNT=4,4\n"
    options = [*shape, FORCE, ("simulator probe", "noise", "0"), *known]
    result = run_probe(tmp_path, gcode, *options, config=eddy_rig.CONFIG)
    assert result.status == PRINTED, result.reason
    mesh = result.status_of("bed_mesh")
    points = mesh["probed_matrix"]
    (x0, y0), (x1, y1) = mesh["mesh_min"], mesh["mesh_max"]
    errors = []
    for row, line in enumerate(points):
        for column, z in enumerate(line):
            x, y = x0 + column * (x1 - x0) / 3, y0 + row * (y1 - y0) / 3
            errors.append(z - result.bed(x, y))
    assert len(errors) == 16 and max(map(abs, errors)) < limit_mm


def test_the_drift_calibration_takes_the_temperature_out(tmp_path: Path, known: list[Option]) -> None:
    """From 25 to 75 degC it is measured; 0 and 80 degC lie outside. Without it: 44 and -79 um."""
    ramp = eddy_rig.coil(coil_temp=25, coil_ramp=0.1, coil_end_temp=80)
    learned = eddy_rig.run(tmp_path, eddy_rig.drift_gcode(0.1, 10.0, 6), [*known, *ramp])
    assert learned.status == PRINTED, learned.reason
    assert learned.status_of("temperature_probe coil")["compensation_enabled"] is True
    options = eddy_rig.calibration(learned)
    for temp_c in (0, 25, 50, 80):
        fixed = eddy_rig.coil(coil_temp=temp_c)
        enable = "TEMPERATURE_PROBE_ENABLE PROBE=coil ENABLE=0\n" if temp_c == 0 else ""
        gcode = f"{START}G1 Z2 F600\nG4 P10000\nPROBE\n{enable}G1 Z2\nPROBE\n"
        result = eddy_rig.run(tmp_path, gcode, [*options, *fixed])
        first, second = (z for _, _, z in result.found())
        assert first == pytest.approx(0.5, abs=0.005), temp_c
        if enable:
            assert abs(second - 0.5) > 0.03


def test_a_tap_finds_the_bed_below_the_nozzle(tmp_path: Path, known: list[Option]) -> None:
    stages = "".join(
        f"PROBE_EDDY_CURRENT_TAP_CALIBRATE TAP={stage}\n" for stage in ("guess", "refine", "verify")
    )
    gcode = f"{START}G1 Z4 F600\n{stages}PROBE METHOD=tap\nG1 Z4\n"
    result = eddy_rig.run(tmp_path, gcode, known)
    assert result.status == PRINTED, result.reason
    taps = [z for _, _, z in result.found()]
    assert len(taps) == 8
    # the bed is at 0, so that descend_z above it would be 0.5; below the contact the frame gives way by a tenth
    assert taps == pytest.approx([0.5] * 8, abs=0.02)
    assert statistics.pstdev(taps) < 0.003
    place = result.status_of("probe")["last_probe_position"]
    assert (place[0], place[1]) == (100.0, 100.0)
    assert result.object("probe").tap_threshold > 1000.0


def test_a_current_is_found_by_the_chip(tmp_path: Path) -> None:
    result = eddy_rig.run(tmp_path, "LDC_CALIBRATE_DRIVE_CURRENT CHIP=coil\n")
    assert result.status == PRINTED, result.reason
    assert "reg_drive_current: 15" in result.text


@pytest.mark.parametrize(
    ("gcode", "words"),
    [
        (f"{START}PROBE\n", "PROBE_EDDY_CURRENT_CALIBRATE CHIP=coil"),
        (f"{START}TEMPERATURE_PROBE_CALIBRATE PROBE=coil TARGET=60\n", "PROBE_EDDY_CURRENT_CALIBRATE"),
        (f"{START}PROBE METHOD=fast\n", "METHOD is 'fast'"),
        (f"{START}PROBE METHOD=tap\n", "tap_threshold"),
        (f"{START}PROBE_EDDY_CURRENT_TAP_CALIBRATE TAP=refine\n", "TAP=guess first"),
    ],
)
def test_what_is_missing_is_said(tmp_path: Path, gcode: str, words: str) -> None:
    result = eddy_rig.run(tmp_path, gcode)
    assert result.status == BAD_INPUT and words in result.reason


def test_an_aborted_drift_calibration_keeps_nothing(tmp_path: Path, known: list[Option]) -> None:
    gcode = (
        f"{START}G1 Z5\nTEMPERATURE_PROBE_CALIBRATE PROBE=coil TARGET=79\nTESTZ Z=-5\nACCEPT\nABORT\nPROBE\n"
    )
    result = eddy_rig.run(tmp_path, gcode, known)
    assert result.status == PRINTED, result.reason
    assert result.object(SECTION).coil.drift is None


def test_a_coil_far_from_the_bed_does_not_scan(tmp_path: Path, known: list[Option]) -> None:
    result = eddy_rig.run(tmp_path, f"{START}G1 Z8 F600\nPROBE METHOD=scan\n", known)
    assert result.status == BAD_INPUT and "ends at 4.05 mm" in result.reason


def test_a_chip_that_does_not_answer_is_reported(tmp_path: Path, known: list[Option]) -> None:
    text = eddy_rig.CONFIG.read_text().partition("[simulator gauge")[0]
    (tmp_path / "none.cfg").write_text(text)
    result = run_probe(tmp_path, f"{START}PROBE\n", *FLAT, FORCE, *known, config=tmp_path / "none.cfg")
    assert result.status == BAD_INPUT and "I2C device at address 42" in result.reason
