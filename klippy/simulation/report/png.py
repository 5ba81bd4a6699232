"""The picture of a simulated print: the page's main charts on one sheet, where a page will not do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure as Sheet
from matplotlib.gridspec import GridSpec

from .data import SETTLED_BAND_C, Floats, Layer, Trace, envelope, thin_path
from .figures import Figure, PrintRun

BUCKETS = 2_000  # about one a pixel
PATH_POINTS = 60_000
COLOURS = {
    "target_c": "#3a4552",
    "estimate_c": "#2f6fde",
    "true_c": "#d4380d",
    "power_w": "#c2410c",
    "phase_ticks": "#6d4fc4",
    "flow_mm3_s": "#1b8a5a",
}
SOFT = "#66717f"
ERROR_MAP = LinearSegmentedColormap.from_list("error", ["#2166ac", "#b9c0c8", "#c62a2a"])


def draw_png(path: Path, title: str, run: PrintRun) -> None:
    """Draws the sheet to `path`. Raises OSError if it cannot be written."""
    trace = run.trace
    sheet = Sheet(figsize=(13.0, 16.0), layout="constrained")
    FigureCanvasAgg(sheet)
    grid = GridSpec(
        7, 2, figure=sheet, height_ratios=(1.9, 2.6, 1.6, 1.2, 1.2, 1.2, 3.4), width_ratios=(3, 2)
    )
    sheet.suptitle(f"{title} on the simulated printer", fontsize=17, fontweight="bold", x=0.01, ha="left")
    _draw_table(sheet.add_subplot(grid[0, :]), run.table)
    first = sheet.add_subplot(grid[1, :])
    _draw_temperature(first, trace)
    _draw_error(sheet.add_subplot(grid[2, :], sharex=first), trace)
    _draw_plain(sheet.add_subplot(grid[3, :], sharex=first), trace, trace.power_w, "power_w", "power, W")
    _draw_plain(
        sheet.add_subplot(grid[4, :], sharex=first), trace, trace.phase_ticks, "phase_ticks", "phase, ticks"
    )
    _draw_plain(
        sheet.add_subplot(grid[5, :], sharex=first), trace, trace.flow_mm3_s, "flow_mm3_s", "flow, mm³/s"
    )
    sheet.axes[-1].set_xlabel("time, s")
    _draw_layers(sheet.add_subplot(grid[6, 0]), run.layers)
    _draw_path(sheet.add_subplot(grid[6, 1]), run)
    sheet.align_ylabels()
    sheet.savefig(path, dpi=100, facecolor="white")


def _draw_table(axes: Axes, table: Sequence[Figure]) -> None:
    axes.axis("off")
    columns = 4
    rows = -(-len(table) // columns)
    for i, figure in enumerate(table):
        at = ((i // rows) / columns, 1.0 - (i % rows) / rows)
        axes.annotate(figure.label, at, xycoords="axes fraction", va="top", fontsize=9.5, color=SOFT)
        axes.annotate(
            figure.value,
            at,
            xytext=(0.0, -12.5),
            xycoords="axes fraction",
            textcoords="offset points",
            va="top",
            fontsize=12,
            fontweight="bold",
        )


def _style(axes: Axes, label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(color="#e6e9ee", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#c9cfd7")
    axes.tick_params(colors=SOFT, labelcolor="#1b2430")


def _line(axes: Axes, trace: Trace, values: Floats, colour: str, label: str, dashed: bool = False) -> None:
    """A thinned series: the band between its extremes, which is a line where they are one."""
    thin = envelope(trace.t_s, values, BUCKETS)
    t_s = np.repeat(thin.t_s, 2)
    v = np.column_stack((thin.low, thin.high)).ravel()
    axes.plot(t_s, v, color=colour, label=label, linewidth=1.1, linestyle="--" if dashed else "-")


def _draw_temperature(axes: Axes, trace: Trace) -> None:
    _style(axes, "temperature, °C")
    _line(axes, trace, trace.estimate_c, COLOURS["estimate_c"], "estimate")
    _line(axes, trace, trace.true_c, COLOURS["true_c"], "true (nozzle skin)")
    _line(axes, trace, trace.target_c, COLOURS["target_c"], "target", dashed=True)
    axes.legend(loc="lower right", frameon=False, ncols=3)
    axes.set_xlim(float(trace.t_s[0]), float(trace.t_s[-1]))


def _draw_error(axes: Axes, trace: Trace) -> None:
    _style(axes, "error, °C")
    limit = 2.0 * SETTLED_BAND_C
    axes.axhspan(-SETTLED_BAND_C, SETTLED_BAND_C, color="#168250", alpha=0.08, linewidth=0)
    _line(axes, trace, trace.estimate_c - trace.target_c, COLOURS["estimate_c"], "estimate − target")
    _line(axes, trace, trace.true_c - trace.target_c, COLOURS["true_c"], "true − target")
    axes.set_ylim(-limit, limit)
    axes.legend(loc="upper right", frameon=False, ncols=2)


def _draw_plain(axes: Axes, trace: Trace, values: Floats, column: str, label: str) -> None:
    _style(axes, label)
    _line(axes, trace, values, COLOURS[column], label)
    axes.set_ylim(bottom=0.0)


def _draw_layers(axes: Axes, layers: Sequence[Layer]) -> None:
    _style(axes, "true − target, °C")
    axes.set_title("By layer, extruding moves: mean, min and max", fontsize=11, loc="left")
    axes.set_xlabel("layer")
    if not layers:
        return
    number = np.arange(1, len(layers) + 1)
    mean = np.array([layer.error_mean_c for layer in layers])
    low = np.array([layer.error_min_c for layer in layers])
    high = np.array([layer.error_max_c for layer in layers])
    axes.axhspan(-SETTLED_BAND_C, SETTLED_BAND_C, color="#168250", alpha=0.08, linewidth=0)
    axes.vlines(
        number, low, high, color=COLOURS["estimate_c"], alpha=0.35, linewidth=min(6.0, 300.0 / len(layers))
    )
    axes.plot(number, mean, ".", color=COLOURS["estimate_c"], markersize=4)
    limit = SETTLED_BAND_C * 1.2
    axes.set_ylim(
        max(-2.0 * SETTLED_BAND_C, min(-limit, low.min())), min(2.0 * SETTLED_BAND_C, max(limit, high.max()))
    )


def _draw_path(axes: Axes, run: PrintRun) -> None:
    layers = run.layers
    axes.set_aspect("equal")
    axes.axis("off")
    if not layers:
        return
    index = len(layers) // 2
    path = thin_path(run.trace, layers[index : index + 1], run.masks.extrudes, PATH_POINTS)
    axes.set_title(f"Layer {index + 1}, z = {layers[index].z_mm:.2f} mm", fontsize=11, loc="left")
    points = np.column_stack((path.x_mm, path.y_mm))
    drawn = path.pen[1:] == 1
    segments = np.stack((points[:-1], points[1:]), axis=1)[drawn]
    lines = LineCollection(list(segments), cmap=ERROR_MAP, linewidths=1.3, capstyle="round")
    lines.set_array(path.error_c[1:][drawn])
    span = float(np.max(np.abs(path.error_c), initial=0.5))
    lines.set_clim(-span, span)
    axes.add_collection(lines)
    axes.autoscale_view()
    assert axes.figure is not None
    axes.figure.colorbar(lines, ax=axes, label="true − target, °C", shrink=0.8)
