"""A load cell as the probe in closed loop: the real firmware's filter and trigger, a simulated HX717 and bed."""

from __future__ import annotations

import statistics
from pathlib import Path

import pytest

from probe_rig import FLAT, ROOT, Probed, bed
from probe_rig import run as run_probe
from simulation.runner import BAD_INPUT, PRINTED

CONFIG = ROOT / "config" / "probes" / "sim-load-cell.cfg"
SECTION, GAUGE = "load_cell_probe", "simulator gauge load_cell_probe"
SPI = "cs_pin: PE2\ndata_ready_pin: PE3\nspi_bus: spi0\n"
CONVERTERS = {  # those the config file does not have: options, samples a second
    "hx711": ("dout_pin: PE0\nsclk_pin: PE1\n", 80.0),
    "ads1220": (SPI, 660.0),
    "ads131m02": (f"{SPI}clock_freq: 8192000\nsample_rate: 1000\n", 1000.0),
    "ads131m04": (f"{SPI}clock_freq: 8192000\nadc_channel: 2\n", 500.0),
}
# Of a contact by the fit: 0.6 um of standard deviation (scripts/bench/probe_figures.py), and steps of 0.6 um.
FOUND_MM = 0.004


def run(folder: Path, gcode: str, *options: tuple[str, str, str]) -> Probed:
    return run_probe(folder, gcode, *options, config=CONFIG)


def gauge(**options: float) -> list[tuple[str, str, str]]:
    return [(GAUGE, name, str(value)) for name, value in options.items()]


def test_homing_and_probing_find_where_the_nozzle_touches(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nPROBE\nG1 Z2 F600\nG1 X40 Y150 F9000\nPROBE\n")
    assert result.status == PRINTED, result.reason
    home = result.bed(100, 100)
    for x, y, z in result.found():
        assert z == pytest.approx(result.bed(x, y) - home, abs=2 * FOUND_MM)
    assert result.status_of("probe")["last_z_result"] == pytest.approx(result.found()[-1][2], abs=1e-6)
    assert result.status_of(SECTION)["last_trigger_time"] > 0.0


def test_repeated_probings_agree(tmp_path: Path) -> None:
    count = 40
    result = run(tmp_path, f"G28\nPROBE_ACCURACY SAMPLES={count}\n", *FLAT)
    assert result.status == PRINTED, result.reason
    heights = [z for _, _, z in result.found()]
    assert statistics.stdev(heights) < 0.001  # 0.00063, with 0.00007 of standard deviation itself
    assert (result.times[-1] - result.times[0]) / (count - 1) < 1.0


@pytest.mark.parametrize("kind", CONVERTERS)
def test_each_converter_stops_the_move_at_the_bed(tmp_path: Path, kind: str) -> None:
    options, rate_hz = CONVERTERS[kind]
    config = tmp_path / "cell.cfg"
    config.write_text(
        CONFIG.read_text().replace(
            "sensor_type: hx717\ndout_pin: PE0\nsclk_pin: PE1\n", f"sensor_type: {kind}\n{options}"
        )
    )
    speed = 2.0
    gcode = "G28\nPROBE_ACCURACY SAMPLES=5\nLOAD_CELL_DIAGNOSTIC\n"
    result = run_probe(tmp_path, gcode, *FLAT, (SECTION, "speed", str(speed)), config=config)
    assert result.status == PRINTED, result.reason
    heights = [z for _, _, z in result.found()]
    assert abs(statistics.fmean(heights)) < speed / rate_hz, "within the way of one sample"
    assert statistics.pstdev(heights) < 0.002
    rate = float(result.text.partition("samples per second: ")[2].split()[0])
    assert rate == pytest.approx(rate_hz * 1.005, rel=0.003)  # the chip's clock is 0.5 % off


def test_a_lift_finds_the_contact_as_the_way_down_does(tmp_path: Path) -> None:
    result = run(
        tmp_path, "G28\nPROBE_ACCURACY SAMPLES=8\n", *FLAT, (SECTION, "interpolate_lift_dist", "0.25")
    )
    assert result.status == PRINTED, result.reason
    heights = [z for _, _, z in result.found()]
    assert statistics.fmean(heights) == pytest.approx(0.0, abs=FOUND_MM)
    assert statistics.pstdev(heights) < 0.002  # 0.4 um


def test_without_interpolation_the_force_of_the_trigger_counts(tmp_path: Path) -> None:
    """1000 g/mm: 75 g are 75 um deeper, and up to two samples and the filter later at 1 mm/s."""
    plain = [(SECTION, "interpolate_enable", "False"), (SECTION, "speed", "1")]
    plain.append((SECTION, "drift_filter_cutoff_frequency", "0.01"))  # else a slow rise of force is drift
    gcode = "G28\nG1 Z1\nPROBE\nG1 Z1\nPROBE TRIGGER_FORCE=150\n"
    result = run(tmp_path, gcode, *FLAT, *plain)
    assert result.status == PRINTED, result.reason
    (_, _, usual), (_, _, harder) = result.found()
    assert usual - harder == pytest.approx(0.075, abs=0.02)


def test_drift_is_no_touch_with_the_filter_and_one_without(tmp_path: Path) -> None:
    """100 g/s: within the second of the way down more than the trigger's force."""
    drifts = [*FLAT, *gauge(drift=100.0, tare=-1500.0), (SECTION, "reference_tare_counts", "0")]
    slow = "G28\nG1 Z3 F600\nPROBE PROBE_SPEED=1.5\n"
    result = run(tmp_path, slow, *drifts)
    assert result.status == PRINTED, result.reason
    assert result.found()[-1][2] == pytest.approx(0.0, abs=0.05)
    without = run(tmp_path, slow, *drifts, (SECTION, "drift_filter_cutoff_frequency", "0.01"))
    assert without.found()[-1][2] > 0.5


def test_a_cell_that_is_not_calibrated_does_not_probe(tmp_path: Path) -> None:
    text = (CONFIG).read_text().replace("counts_per_gram: 500\n", "")
    (tmp_path / "raw.cfg").write_text(text)
    result = run_probe(tmp_path, "G28\n", config=tmp_path / "raw.cfg")
    assert result.status == BAD_INPUT and "Load Cell not calibrated" in result.reason


def test_a_force_beyond_the_limit_stops_the_move(tmp_path: Path) -> None:
    """The trigger would come at 5 kg."""
    gcode = "G28\nPROBE TRIGGER_FORCE=5000 FORCE_SAFETY_LIMIT=300\n"
    result = run(tmp_path, gcode, *FLAT)
    assert result.status == BAD_INPUT and "beyond its safe range" in result.reason
    assert result.axis_mm("z") > -0.6, "300 g are 0.3 mm, and the head brakes"


def test_a_load_from_the_beginning_is_refused(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\n", *gauge(tare=3000.0))
    assert result.status == BAD_INPUT and "beyond force_safety_limit" in result.reason


def test_a_cell_that_sends_nothing_is_reported(tmp_path: Path) -> None:
    """No gauge: the line of the data stays as it is."""
    text = CONFIG.read_text().partition("[simulator gauge")[0]
    (tmp_path / "open.cfg").write_text(text)
    result = run_probe(tmp_path, "G28\n", config=tmp_path / "open.cfg")
    assert result.status == BAD_INPUT and "check its wiring" in result.reason


def test_a_scale_is_calibrated_tared_and_read(tmp_path: Path) -> None:
    """The bed is the load: 0.4 mm deep are 400 g."""
    gcode = (
        "SET_KINEMATIC_POSITION X=71.3 Y=40.2 Z=12.7\nLOAD_CELL_CALIBRATE\nTARE\nG1 Z-0.4 F600\nM400\n"
        "CALIBRATE GRAMS=400\nACCEPT\nLOAD_CELL_READ\nLOAD_CELL_TARE\nLOAD_CELL_READ\nG1 Z2\nM400\nLOAD_CELL_READ\n"
    )
    force = ("force_move", "enable_force_move", "1")
    result = run(tmp_path, gcode, *FLAT, force, *gauge(drift=0.0))
    assert result.status == PRINTED, result.reason
    status = result.status_of(SECTION)
    # of a second at 320 samples of 0.5 g: 0.03 g
    assert status["counts_per_gram"] == pytest.approx(500.0, rel=0.002)
    assert status["reference_tare_counts"] == pytest.approx(60000, abs=100)
    reads = [float(line.split()[1].rstrip("g")) for line in result.console if "g (" in line and "%" in line]
    assert reads == pytest.approx([400.0, 0.0, -400.0], abs=1.0)
    assert status["force_g"] == pytest.approx(-400.0, abs=1.0)


def test_the_diagnostic_says_what_the_wiring_gives(tmp_path: Path) -> None:
    result = run(tmp_path, "LOAD_CELL_DIAGNOSTIC\n", *gauge(drift=0.0))
    rate = float(result.text.partition("samples per second: ")[2].split()[0])
    assert rate == pytest.approx(320.0 * 1.005, rel=0.002)  # the chip's clock is 0.5 % off
    assert "Saturated samples: 0" in result.text


def test_taps_by_hand_are_not_there_without_a_hand(tmp_path: Path) -> None:
    result = run(tmp_path, "LOAD_CELL_TEST_TAP TAPS=1 TIMEOUT=2\n")
    assert result.status == BAD_INPUT and "No tap within 2 seconds" in result.reason


def test_a_mesh_is_the_bed(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nBED_MESH_CALIBRATE PROBE_COUNT=3,3\n", *bed(bump_radius=60))
    assert result.status == PRINTED, result.reason
    home = result.bed(100, 100)
    errors = [z - (result.bed(x, y) - home) for x, y, z in result.found()]
    assert len(errors) == 9 and max(map(abs, errors)) < 2 * FOUND_MM
