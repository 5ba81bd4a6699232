"""The picture of a simulated print: the page's main charts on one sheet, where a page will not do."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure as Sheet
from matplotlib.gridspec import GridSpec

from .charts import CHARTS, Chart, Line, lines
from .data import SETTLED_BAND_C, Layer, thin_path
from .figures import Figure, PrintRun

BUCKETS = 2_000  # about one a pixel
PATH_POINTS = 60_000
COLOURS = {  # as in page.css
    "target": "#3a4552",
    "estimate": "#2f6fde",
    "true": "#d4380d",
    "bore": "#b7791f",
    "melt": "#0f8a7e",
    "power": "#c2410c",
    "phase": "#6d4fc4",
    "flow": "#1b8a5a",
}
INCHES_A_PIXEL = 1.0 / 115.0  # of a chart's height on the page
TABLE_INCHES, LAYER_INCHES = 2.6, 4.6
SOFT = "#66717f"
ERROR_MAP = LinearSegmentedColormap.from_list("error", ["#2166ac", "#b9c0c8", "#c62a2a"])


def draw_png(path: Path, title: str, run: PrintRun) -> None:
    """Draws the sheet to `path`. Raises OSError if it cannot be written."""
    panels = [(chart, drawn) for chart in CHARTS if (drawn := lines(chart, run.trace, BUCKETS))]
    heights = [TABLE_INCHES, *(chart.height_px * INCHES_A_PIXEL for chart, _ in panels), LAYER_INCHES]
    sheet = Sheet(figsize=(13.0, sum(heights) + 0.4 * len(heights)), layout="constrained")
    FigureCanvasAgg(sheet)
    grid = GridSpec(len(heights), 2, figure=sheet, height_ratios=heights, width_ratios=(3, 2))
    sheet.suptitle(f"{title} on the simulated printer", fontsize=17, fontweight="bold", x=0.01, ha="left")
    _draw_table(sheet.add_subplot(grid[0, :]), run.table)
    first: Axes | None = None
    for row, (chart, drawn) in enumerate(panels, 1):
        axes = sheet.add_subplot(grid[row, :], sharex=first)
        first = first or axes
        _draw_chart(axes, chart, drawn)
    _draw_layers(sheet.add_subplot(grid[-1, 0]), run.layers)
    _draw_path(sheet.add_subplot(grid[-1, 1]), run)
    sheet.align_ylabels()
    sheet.supxlabel(_footer(run.provenance), fontsize=8, color=SOFT, x=0.01, ha="left")
    sheet.savefig(path, dpi=100, facecolor="white")


def _footer(provenance: Sequence[Figure]) -> str:
    return "\n".join(textwrap.wrap("   ".join(f"{fact.label}: {fact.value}" for fact in provenance), 200))


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


def _mark_cuts(axes: Axes, at: Sequence[float] | np.ndarray, sign: int, colour: str) -> None:
    """Marks on the edge of the scale where something goes on beyond it."""
    if not len(at):
        return  # an empty line upsets the layout
    edge = np.full(len(at), max(sign, 0))  # of the height
    marker = "^" if sign > 0 else "v"
    axes.plot(at, edge, marker, color=colour, transform=axes.get_xaxis_transform(), clip_on=False)


def _draw_chart(axes: Axes, chart: Chart, drawn: Sequence[Line]) -> None:
    _style(axes, chart.unit)
    note = f" (scale to ±{chart.limit:g}, ▲ ▼ where it goes beyond)" if chart.limit else ""
    axes.set_title(chart.title + note, fontsize=11, loc="left")
    axes.set_xlabel("simulated time, s", fontsize=8.5, color=SOFT, labelpad=1.0)
    shown = [line for line in drawn if line.series.shown]
    for line in shown:
        colour, style = COLOURS[line.series.colour], "--" if line.series.dashed else "-"
        axes.plot(
            line.t_s, line.values, color=colour, label=line.series.label, linewidth=1.1, linestyle=style
        )
        for sign in (1, -1):
            _mark_cuts(axes, [(a + b) / 2.0 for a, b, side in line.cuts if side == sign], sign, colour)
    if chart.limit:
        axes.axhspan(-SETTLED_BAND_C, SETTLED_BAND_C, color="#168250", alpha=0.08, linewidth=0)
        axes.set_ylim(-chart.limit, chart.limit)
    if chart.from_zero:
        axes.set_ylim(bottom=0.0)
    if len(shown) > 1:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncols=len(shown), borderpad=0.0
        )
    axes.set_xlim(float(drawn[0].t_s[0]), float(drawn[0].t_s[-1]))


def _draw_layers(axes: Axes, layers: Sequence[Layer]) -> None:
    _style(axes, "true − target, °C")
    axes.set_title(
        "By layer, extruding moves: mean, min and max (▲ ▼ beyond the scale)", fontsize=11, loc="left"
    )
    axes.set_xlabel("layer")
    if not layers:
        return
    number = np.arange(1, len(layers) + 1)
    mean = np.array([layer.error_mean_c for layer in layers])
    low = np.array([layer.error_min_c for layer in layers])
    high = np.array([layer.error_max_c for layer in layers])
    axes.axhspan(-SETTLED_BAND_C, SETTLED_BAND_C, color="#168250", alpha=0.08, linewidth=0)
    axes.vlines(
        number, low, high, color=COLOURS["estimate"], alpha=0.35, linewidth=min(6.0, 300.0 / len(layers))
    )
    axes.plot(number, mean, ".", color=COLOURS["estimate"], markersize=4)
    room, limit = SETTLED_BAND_C * 1.2, SETTLED_BAND_C * 2.0
    axes.set_xlim(0.5, len(layers) + 0.5)
    axes.set_ylim(max(-limit, min(-room, low.min())), min(limit, max(room, high.max())))
    _mark_cuts(axes, number[high > limit], 1, COLOURS["estimate"])
    _mark_cuts(axes, number[low < -limit], -1, COLOURS["estimate"])


def _draw_path(axes: Axes, run: PrintRun) -> None:
    layers = run.layers
    axes.set_aspect("equal")
    if not layers:
        axes.axis("off")
        return
    _style(axes, "y, mm")
    axes.set_xlabel("x, mm")
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
