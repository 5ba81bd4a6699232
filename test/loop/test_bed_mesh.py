"""A mesh of the simulated bed, probed by the real firmware, and the nozzle that follows it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from extras.probing.surface_fit import Surface
from probe_rig import FLAT, STEP_MM, bed, run
from simulation.runner import PRINTED

ONE_SAMPLE = ("probe", "samples", "1")
FAST = [("bed_mesh", "speed", "300"), ("bed_mesh", "horizontal_move_z", "3.5"), ("probe", "speed", "8")]
# a look at the probe comes up to one step's time after the trigger, and reports whole steps; the same at the reference
SEEN_MM = 4 * STEP_MM


def height_at(result, x: float, y: float) -> float:
    status = result.status_of("bed_mesh")
    return Surface(status["mesh_min"], status["mesh_max"], status["mesh_matrix"]).z(x, y)


def test_the_mesh_is_the_bed(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nBED_MESH_CALIBRATE\n", *bed(noise=0.0), ONE_SAMPLE, *FAST)
    assert result.status == PRINTED, result.reason
    status = result.status_of("bed_mesh")
    assert status["profile_name"] == "default" and status["mesh_max"] == (195.0, 190.0)
    zero = result.bed(100, 100) - height_at(result, 100, 100)
    assert height_at(result, 100, 100) == pytest.approx(0.0, abs=1e-9)  # zero_reference_position
    for row, y in enumerate((5, 51.25, 97.5, 143.75, 190)):
        for column, x in enumerate((25, 67.5, 110, 152.5, 195)):
            found = status["probed_matrix"][row][column]
            # the reference is interpolated between points 45 mm apart on a bump of 0.12 mm
            assert found == pytest.approx(result.bed(x, y) - zero, abs=SEEN_MM + 0.02)
    # among each other the probed points are as far apart as the bed is, to the steps
    probed = status["probed_matrix"]
    for row, y in enumerate((5, 51.25, 97.5, 143.75, 190)):
        for column, x in enumerate((25, 67.5, 110, 152.5, 195)):
            rise = result.bed(x, y) - result.bed(25, 5)
            assert probed[row][column] - probed[0][0] == pytest.approx(rise, abs=SEEN_MM)


def test_noise_of_the_probe_is_that_of_the_mesh(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nBED_MESH_CALIBRATE\n", *FLAT, *bed(noise=0.01), ONE_SAMPLE, *FAST)
    assert result.status == PRINTED, result.reason
    heights = [z for row in result.status_of("bed_mesh")["probed_matrix"] for z in row]
    mean = sum(heights) / 25
    spread = (sum((z - mean) ** 2 for z in heights) / 24) ** 0.5
    assert spread == pytest.approx(0.01, rel=0.45)  # three times 1/sqrt(2 * 24)


def test_the_nozzle_keeps_its_distance_from_the_bed(tmp_path: Path) -> None:
    """Over a bed tilted by 0.34 mm the nozzle ends where the bed is, plus what G-code says."""
    level_bed = bed(noise=0.0, bump_height=0.0)
    where = "G28\nBED_MESH_CALIBRATE\nG1 X{} Y{} Z0.3 F9000\nM400\n"
    for x, y in ((170, 20), (40, 180)):
        result = run(tmp_path, where.format(x, y), *level_bed, ONE_SAMPLE, *FAST)
        assert result.status == PRINTED, result.reason
        # homing is off by two steps at most, standing by half a step
        assert result.axis_mm("z") - result.bed(x, y) == pytest.approx(0.3, abs=SEEN_MM + 2.5 * STEP_MM)
        assert result.status_of("gcode_move")["gcode_position"].z == pytest.approx(0.3, abs=1e-6)


def test_above_the_fade_the_path_is_level(tmp_path: Path) -> None:
    gcode = "G28\nBED_MESH_CALIBRATE\nG1 X30 Y20 Z12 F9000\nM400\nG1 X170 Y180\nM400\nGET_POSITION\n"
    result = run(tmp_path, gcode, *bed(noise=0.0, bump_height=0.0), ONE_SAMPLE, *FAST)
    z = float(re.findall(r"toolhead: X:[\d.-]+ Y:[\d.-]+ Z:([\d.-]+)", result.text)[0])
    # the fade's target: the mesh's mean
    matrix = result.status_of("bed_mesh")["mesh_matrix"]
    mean = sum(map(sum, matrix)) / (len(matrix) * len(matrix[0]))
    assert z == pytest.approx(12 + mean, abs=1e-5)


def test_only_the_objects_area_is_probed(tmp_path: Path) -> None:
    gcode = (
        "G28\nEXCLUDE_OBJECT_DEFINE NAME=a CENTER=80,80 POLYGON=[[70,70],[90,70],[90,95],[70,95]]\n"
        "BED_MESH_CALIBRATE ADAPTIVE=1 ADAPTIVE_MARGIN=5 PROBE_COUNT=5\n"
    )
    result = run(tmp_path, gcode, *bed(noise=0.0), ONE_SAMPLE, *FAST)
    assert result.status == PRINTED, result.reason
    status = result.status_of("bed_mesh")
    assert (status["mesh_min"], status["mesh_max"]) == ((65.0, 65.0), (95.0, 100.0))
    assert (
        len(status["probed_matrix"]) == 3 and status["profile_name"] == "adaptive" and not status["profiles"]
    )
    assert len(result.found()) == 10  # nine, and the reference, which lies outside


def test_a_saved_mesh_is_read_again(tmp_path: Path) -> None:
    """What SAVE_CONFIG writes is what the next start reads."""
    gcode = "G28\nBED_MESH_CALIBRATE PROFILE=warm PROBE_COUNT=3 \nSAVE_CONFIG RESTART=0\n"
    config = tmp_path / "printer.cfg"
    config.write_text(f"[include {Path(__file__).resolve().parents[2] / 'config' / 'sim-probe.cfg'}]\n")
    first = run(tmp_path, gcode, ONE_SAMPLE, *FAST, config=config)
    assert first.status == PRINTED, first.reason
    assert "[bed_mesh warm]" in config.read_text()
    second = run(tmp_path, "BED_MESH_PROFILE LOAD=warm\n", *FAST, config=config)
    assert second.status == PRINTED, second.reason
    before, after = first.status_of("bed_mesh"), second.status_of("bed_mesh")
    assert after["profile_name"] == "warm" and after["profiles"] == before["profiles"]
    for a, b in zip(before["mesh_matrix"], after["mesh_matrix"], strict=True):
        assert b == pytest.approx(a, abs=2e-6)  # six digits are written


class Request:
    """What a client asks of an endpoint, and the answer."""

    def __init__(self, **params: Any) -> None:
        self.params, self.answer = params, {}

    def get_dict(self, name: str, default: Any) -> Any:
        return self.params.get(name, default)

    def send(self, answer: dict[str, Any]) -> None:
        self.answer = json.loads(json.dumps(answer))


def test_clients_get_the_mesh_and_its_places(tmp_path: Path) -> None:
    result = run(tmp_path, "G28\nBED_MESH_CALIBRATE PROBE_COUNT=3\n", ONE_SAMPLE, *FAST)
    mesh = result.object("bed_mesh")
    request = Request(mesh_args={"probe_count": "4,3", "mesh_min": "30,30"})
    mesh._handle_dump(request)
    answer = request.answer
    assert answer["current_mesh"]["name"] == "default" and len(answer["current_mesh"]["probed_matrix"]) == 3
    assert answer["calibration"]["points"][0] == [30, 30] and len(answer["calibration"]["points"]) == 12
    assert answer["profiles"]["default"]["mesh_params"]["x_count"] == 3 and answer["probe_offsets"] == [
        20,
        -5,
        1.5,
    ]
    # a question changes nothing
    assert mesh.shape.counts == (5, 5) and mesh.profile_name == "default"
    json.dumps(result.status_of("bed_mesh"))


def test_a_mesh_is_probed_on_a_corexy_too(tmp_path: Path) -> None:
    """Each motor of the belts turns with x and y; only z's stop at the trigger."""
    kinematics = [("printer", "kinematics", "corexy"), *bed(noise=0.0, bump_height=0.0)]
    result = run(tmp_path, "G28\nBED_MESH_CALIBRATE PROBE_COUNT=3\n", *kinematics, ONE_SAMPLE, *FAST)
    assert result.status == PRINTED, result.reason
    probed = result.status_of("bed_mesh")["probed_matrix"]
    for row, y in enumerate((5, 97.5, 190)):
        for column, x in enumerate((25, 110, 195)):
            rise = result.bed(x, y) - result.bed(25, 5)
            assert probed[row][column] - probed[0][0] == pytest.approx(rise, abs=SEEN_MM)
