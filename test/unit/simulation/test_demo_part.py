"""The part of the demo: what a nozzle has to do is in it; and its picture."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from simulation import demo_part
from simulation.report.figures import PrintRun
from simulation.report.portrait import draw_portrait
from unit.simulation.test_report import SUMMARY, made_up_print


def test_the_part_has_walls_infill_an_overhang_and_small_layers() -> None:
    layers = list(demo_part.layers())
    kinds = {path.kind for _, _, paths in layers for path in paths}
    assert kinds == {"External perimeter", "Perimeter", "Solid infill", "Internal infill"}
    widths = [
        max(x for path in paths for x, _ in path.points)
        for stage, _, paths in layers
        if stage.name == "gallery"
    ]
    grows = (widths[-1] - widths[0]) / (len(widths) - 1)
    assert grows > 0.7 * demo_part.LAYER_MM, "45 degrees"
    lengths = [sum(path.length_mm for path in paths) for _, _, paths in layers]
    assert min(lengths) < 10.0 and max(lengths) > 500.0


def test_no_layer_but_the_tip_is_printed_sooner_than_its_minimum_time() -> None:
    for _, z_mm, paths in demo_part.layers():
        seconds = sum(path.length_mm / path.speed_mm_s for path in paths)
        slowest = max(path.speed_mm_s for path in paths) <= demo_part.SLOWEST_MM_S
        assert slowest or seconds == pytest.approx(3.0) or seconds > 3.0, z_mm


def test_the_file_stays_on_the_bed_and_within_the_flow_of_the_nozzle() -> None:
    text = demo_part.gcode()
    for axis in "XY":
        values = [float(value) for value in re.findall(rf"{axis}([\d.]+)", text)]
        assert min(values) > 75.0 and max(values) < 105.0
    flow = demo_part.LAYER_MM * demo_part.WIDTH_MM * demo_part.INFILL_MM_S
    assert flow < 10.0
    heights = [float(value) for value in re.findall(r"^;Z:([\d.]+)", text, re.M)]
    assert heights == sorted(heights) and heights[-1] == 32.0


def test_the_portrait_shows_the_roads_in_the_colours_of_the_melt(tmp_path: Path) -> None:
    draw_portrait(tmp_path / "part.png", "Part", PrintRun.of(made_up_print(), SUMMARY))
    picture = plt.imread(tmp_path / "part.png")[..., :3]
    middle = picture[300:1000, 150:850].reshape(-1, 3)
    coloured = middle[np.ptp(middle, axis=1) > 0.3]
    assert len(coloured) > 2000
