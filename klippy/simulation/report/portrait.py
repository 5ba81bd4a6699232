"""The picture of the printed part: its roads in space, coloured by the melt they were printed with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Sheet
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from .figures import PrintRun

SHOWN = ("Simulated time", "Heat-up", "Temperature error, rms", "Time within ±3 °C", "Flow")
DARK, LIGHT, SOFT = "#10151c", "#e8edf2", "#8fa0b3"
ROAD_MM = 3.0  # nothing extruded goes further in a row of the trace: that is a travel move
RANGE_PERCENT = (2.0, 98.0)
ELEVATION_DEG, AZIMUTH_DEG = 14.0, -52.0
LINE_POINTS = 2.2


def draw_portrait(path: Path, title: str, run: PrintRun) -> None:
    """Draws the part to `path`. Raises OSError if it cannot be written."""
    trace, extrudes = run.trace, run.masks.extrudes
    if run.layers:
        extrudes = extrudes & (trace.t_s >= run.layers[0].start_s)
    points = np.column_stack((trace.x_mm, trace.y_mm, trace.z_mm))
    segments = np.stack((points[:-1], points[1:]), axis=1)
    drawn = extrudes[1:] & extrudes[:-1]
    drawn &= np.abs(np.diff(points, axis=0)).max(axis=1) < ROAD_MM
    sheet = Sheet(figsize=(9.0, 11.0), facecolor=DARK)
    FigureCanvasAgg(sheet)
    axes = sheet.add_axes((0.0, 0.08, 1.0, 0.86), projection="3d")
    assert isinstance(axes, Axes3D)
    axes.set_facecolor(DARK)
    axes.set_axis_off()
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)
    if drawn.any():
        _add_roads(sheet, axes, segments[drawn], trace.melt_c[1:][drawn])
    sheet.text(0.06, 0.95, title, color=LIGHT, fontsize=22, fontweight="bold")
    sheet.text(
        0.06,
        0.925,
        "printed on the simulated machine with a nozzle heated by induction",
        color=SOFT,
        fontsize=12,
    )
    figures = {figure.label: figure.value for figure in run.table}
    for number, label in enumerate(name for name in SHOWN if name in figures):
        x = 0.06 + 0.18 * number
        sheet.text(x, 0.055, figures[label], color=LIGHT, fontsize=13, fontweight="bold")
        sheet.text(x, 0.033, label, color=SOFT, fontsize=8.5)
    sheet.savefig(path, dpi=120, facecolor=DARK)


def _add_roads(sheet: Sheet, axes: Axes3D, segments: np.ndarray, melt_c: np.ndarray) -> None:
    roads = Line3DCollection(list(segments), cmap="inferno", linewidths=LINE_POINTS, capstyle="round")
    roads.set_array(melt_c)
    low, high = (float(np.percentile(melt_c, percent)) for percent in RANGE_PERCENT)
    margin = 0.35 * max(high - low, 1.0)  # the darkest colours are the background's
    roads.set_clim(low - margin, high)
    axes.add_collection3d(roads)
    lowest, highest = segments.min(axis=(0, 1)), segments.max(axis=(0, 1))
    middle, half = (lowest + highest) / 2.0, float((highest - lowest).max()) / 2.0
    for setter, centre in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        setter(centre - half, centre + half)
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.3)
    bar_axes = sheet.add_axes((0.86, 0.3, 0.018, 0.35))
    bar = sheet.colorbar(roads, cax=bar_axes)
    bar.ax.set_ylim(low, high)
    bar.set_label("melt at the outlet, °C", color=SOFT)
    bar.ax.tick_params(colors=SOFT)
    bar.outline.set_visible(False)
