"""Resonances in closed loop: real firmware reads simulated chips on a ringing frame, the host finds what rings."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from probe_rig import CONFIG, Option, Probed, run
from simulation.runner import PRINTED

RESONANCE = CONFIG.with_name("sim-resonance.cfg")
QUICK = "FREQ_START=25 FREQ_END=65 HZ_PER_SEC=2"
GRAVITY_MM_S2 = 9806.65


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements go where temporary files go."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def measured(result: Probed) -> tuple[float, ...]:
    found = re.search(r"accelerometer values \(x, y, z\): (\S+), (\S+), (\S+)", result.text)
    assert found is not None, result.text
    return tuple(float(value) for value in found.groups())


def test_shaper_calibrate_finds_the_frequencies_of_the_frame(tmp_path: Path) -> None:
    frame = [("simulator frame", "frequency_x", "51.5"), ("simulator frame", "frequency_y", "36.0")]
    result = run(tmp_path, f"G28\nSHAPER_CALIBRATE {QUICK} NAME=t\n", *frame, config=RESONANCE)
    assert result.status == PRINTED, result.reason
    found = re.findall(r"Resonance of axis (.): (\S+) Hz, damping ratio (\S+)", result.text)
    assert [(axis, pytest.approx(float(hz), abs=1.0)) for axis, hz, _ in found] == [("x", 51.5), ("y", 36.0)]
    assert [float(z) for _, _, z in found] == pytest.approx([0.05, 0.07], rel=0.25)
    best = re.findall(r"Recommended shaper_type_(.) = (\S+), shaper_freq_. = (\S+) Hz", result.text)
    assert [axis for axis, _, _ in best] == ["x", "y"]
    pending = result.object("configfile").get_status(0.0)["save_config_pending_items"]
    assert pending["input_shaper"]["shaper_freq_x"] == best[0][2]
    header = (tmp_path / "calibration_data_x_t.csv").read_text().splitlines()[0]
    assert header.startswith("freq,psd_x,psd_y,psd_z,psd_xyz,zv(")
    # the head is where it was, and the motors know it
    assert result.axis_mm("y") == pytest.approx(90.0 - 18.0, abs=0.05)


CORNER = (
    "G28\nG1 X40 Y90 Z20 F6000\nG4 P500\nACCELEROMETER_MEASURE\n"
    "G1 X140 F9000\nG4 P600\nACCELEROMETER_MEASURE NAME=t\n"
)


def ringing(folder: Path, *options: Option) -> float:
    """Root mean square of X in the 0.3 s after a move, mm/s^2."""
    folder.mkdir()
    result = run(
        folder, CORNER, ("simulator accelerometer adxl345", "noise", "0"), *options, config=RESONANCE
    )
    assert result.status == PRINTED, result.reason
    rows = [
        line.split(",") for line in next(folder.parent.glob("adxl345-t*.csv")).read_text().splitlines()[1:]
    ]
    next(folder.parent.glob("adxl345-t*.csv")).unlink()
    end = float(rows[-1][0]) - 0.6
    after = [float(x) for t, x, _, _ in rows if end + 0.05 <= float(t) <= end + 0.35]
    assert len(after) > 500
    return float((sum(x * x for x in after) / len(after)) ** 0.5)


def test_a_shaped_move_rings_less(tmp_path: Path) -> None:
    plain = ringing(tmp_path / "plain")
    shaped = ringing(tmp_path / "shaped", ("input_shaper", "shaper_freq_x", "47"))
    assert plain > 200.0
    assert shaped < 0.2 * plain


CHIPS = {
    "adxl345": "cs_pin: toolboard:PH1",
    "lis2dw": "cs_pin: toolboard:PH1",
    "lis2dw i2c": "i2c_mcu: toolboard\ni2c_bus: i2c0",
    "lis3dh": "cs_pin: toolboard:PH1",
    "mpu9250": "i2c_mcu: toolboard\ni2c_bus: i2c1",
    "icm20948": "i2c_mcu: toolboard\ni2c_bus: i2c1",
    "bmi160": "cs_pin: toolboard:PH1",
    "bmi160 i2c": "i2c_mcu: toolboard\ni2c_bus: i2c0",
}


@pytest.mark.parametrize("name", CHIPS)
def test_each_chip_measures_gravity_along_its_map(tmp_path: Path, name: str) -> None:
    text = RESONANCE.read_text().replace("include sim", f"include {CONFIG.parent}/sim")
    head, _, rest = text.partition("[adxl345]")
    rest = rest[rest.index("[input_shaper]") :].replace("adxl345", name)
    config = tmp_path / "printer.cfg"
    config.write_text(f"{head}[{name}]\n{CHIPS[name]}\naxes_map: x, z, -y\n\n{rest}orientation: x, z, -y\n")
    result = run(tmp_path, f"ACCELEROMETER_QUERY CHIP={name.rsplit(maxsplit=1)[-1]}\n", config=config)
    assert result.status == PRINTED, result.reason
    # gravity is along the printer's z, which the sensor's y points along, and the map takes y as -z
    assert measured(result) == pytest.approx((0.0, 0.0, -GRAVITY_MM_S2), abs=40.0)
    assert "gaps" not in result.text


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("frozen", "[adxl345]: frozen: its samples do not change"),
        ("saturated", "[adxl345]: saturated: its samples reach the end of its range"),
        ("unplugged", "[adxl345]: invalid adxl345 id: 0xff, expected 0xe5. Nothing answers: check its power"),
    ],
)
def test_a_faulty_chip_is_named(tmp_path: Path, fault: str, text: str) -> None:
    option = ("simulator accelerometer adxl345", "fault", fault)
    result = run(tmp_path, "ACCELEROMETER_QUERY\n", option, config=RESONANCE)
    assert text in result.text


def test_the_nozzles_own_line_takes_the_rate_that_fits_and_no_more(tmp_path: Path) -> None:
    own = [("adxl345", "cs_pin", "PH1")]
    result = run(tmp_path, "ACCELEROMETER_QUERY\n", *own, config=RESONANCE)
    assert "has room for 1532 beside its other messages. Set rate: 800, or connect it" in result.text
    assert "accelerometer values" not in result.text
    gcode = "M104 S200\nACCELEROMETER_MEASURE\nG4 P20000\nACCELEROMETER_MEASURE\nACCELEROMETER_QUERY\n"
    result = run(tmp_path, gcode, *own, ("adxl345", "rate", "800"), config=RESONANCE)
    assert result.status == PRINTED, result.reason
    assert "gaps" not in result.text and measured(result)[2] == pytest.approx(GRAVITY_MM_S2, abs=40.0)
