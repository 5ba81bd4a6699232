"""The report of a simulated print: one HTML page that needs nothing but itself, and one picture.

    write_report("trace.csv", summary, "part.gcode", html="report.html", png="report.png")

The page holds the figures, zoomable charts of the whole run and a view of each layer; it is opened from disk
and reaches for no network. Series are thinned to envelopes of their extremes, so a page stays under 5 MB
however long the print was, and no peak is lost.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np

from .charts import CHARTS, Chart, Line, lines
from .data import SETTLED_BAND_C, SETTLED_HOLD_S, Floats, Layer, Path2D, ReportError, read_trace, thin_path
from .figures import Figure, PrintRun
from .png import draw_png

__all__ = ["ReportError", "render_page", "write_report"]

PAGE_FOLDER = Path(__file__).parent / "page"

# Sizes for a page under 5 MB, in base64 (4/3): a bucket takes 8 bytes for each of 18 series and the time: 2.4 MB;
# a point of the path takes 8 bytes: 1.6 MB.
MAX_BUCKETS = 12_000
MAX_PATH_POINTS = 150_000
PATH_ERROR_SPAN_C = 5.0  # path colours hold errors to ±this in 127 steps


def write_report(
    trace_csv: Path | str,
    summary: Mapping[str, object] | Path | str,
    gcode: Path | str,
    html: Path | str | None = None,
    png: Path | str | None = None,
) -> list[Figure]:
    """Writes the page and/or the picture of one simulated print; returns the table of figures.

    trace_csv: the trace (columns in report_data.COLUMNS). summary: what `simulate.py --summary` writes, as a
    mapping or as the path of the JSON file. gcode: the printed file, for the title. Raises ReportError with a
    text for people if the trace or the summary cannot be used, or a file cannot be written.
    """
    facts = _summary(summary)
    run = PrintRun.of(read_trace(Path(trace_csv)), facts)
    title = Path(gcode).name
    try:
        if html is not None:
            Path(html).write_text(render_page(title, run), encoding="utf-8")
        if png is not None:
            draw_png(Path(png), title, run)
    except OSError as e:
        raise ReportError(f"cannot write the report {e.filename}: {e.strerror}") from None
    return list(run.table)


def _summary(summary: Mapping[str, object] | Path | str) -> Mapping[str, object]:
    if isinstance(summary, Mapping):
        return summary
    try:
        facts = json.loads(Path(summary).read_text(encoding="utf-8"))
    except OSError as e:
        raise ReportError(f"cannot read the summary {summary}: {e.strerror}") from None
    except ValueError as e:
        raise ReportError(f"the summary {summary} is not JSON: {e}") from None
    if not isinstance(facts, dict):
        raise ReportError(f"the summary {summary} is not a JSON object")
    return facts


def render_page(title: str, run: PrintRun) -> str:
    """The page as text."""
    trace = run.trace
    panels = [(chart, lines(chart, trace, MAX_BUCKETS)) for chart in CHARTS]
    data = {
        "band_c": SETTLED_BAND_C,
        "time": _float32(panels[0][1][0].t_s),
        "charts": [_chart(chart, drawn) for chart, drawn in panels if drawn],
        "views": _views(run),
        "layers": [_layer(layer) for layer in run.layers],
        "path": _path(thin_path(trace, run.layers, run.masks.extrudes, MAX_PATH_POINTS)),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PAGE_FOLDER),
        autoescape=jinja2.select_autoescape(default_for_string=True, default=True),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        title=title,
        figures=run.table,
        provenance=run.provenance,
        band_c=SETTLED_BAND_C,
        hold_s=SETTLED_HOLD_S,
        layers=run.layers,
        css=_read("uplot/uPlot.min.css", "page.css"),
        script=_read("uplot/uPlot.iife.min.js", "page.js"),
        data=_inline_json(data),
    )


def _read(*names: str) -> str:
    return "\n".join((PAGE_FOLDER / name).read_text(encoding="utf-8") for name in names)


def _inline_json(data: object) -> str:
    """JSON that may stand inside a script element whatever strings it holds."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _views(run: PrintRun) -> list[dict[str, object]]:
    """Stretches of time to jump to: the whole run, and the printing part with a little room."""
    trace = run.trace
    start, end = float(trace.t_s[0]), float(trace.t_s[-1])
    views: list[dict[str, object]] = [{"label": "whole run", "from": start, "to": end}]
    rows = np.flatnonzero(run.masks.prints)
    if len(rows):
        first, last = float(trace.t_s[rows[0]]), float(trace.t_s[rows[-1]])
        room = 0.01 * (last - first)
        views.append({"label": "printing", "from": max(start, first - room), "to": min(end, last + room)})
    return views


def _chart(chart: Chart, drawn: Sequence[Line]) -> dict[str, object]:
    return {
        "title": chart.title,
        "unit": chart.unit,
        "height": chart.height_px,
        "limit": chart.limit,
        "fromZero": chart.from_zero,
        "series": [
            {
                "label": line.series.label,
                "colour": line.series.colour,
                "shown": line.series.shown,
                "dashed": line.series.dashed,
                "values": _float32(line.values),
                "cuts": line.cuts,
            }
            for line in drawn
        ],
    }


def _layer(layer: Layer) -> dict[str, object]:
    return {
        "z": round(layer.z_mm, 3),
        "start": round(layer.start_s, 2),
        "duration": round(layer.duration_s, 2),
        "mean": round(layer.error_mean_c, 3),
        "min": round(layer.error_min_c, 3),
        "max": round(layer.error_max_c, 3),
        "true": round(layer.true_mean_c, 2),
        "flow": round(layer.flow_mean_mm3_s, 2),
        "flowMax": round(layer.flow_max_mm3_s, 2),
    }


def _path(path: Path2D) -> dict[str, object]:
    """The path with x, y as 1/65535 of the part's larger side, the error as 1/127 of its span, others as 1/255."""
    if not len(path.x_mm):
        return {"points": 0, "starts": []}
    left, front = float(path.x_mm.min()), float(path.y_mm.min())
    side = max(float(path.x_mm.max()) - left, float(path.y_mm.max()) - front, 1.0)
    error = np.clip(path.error_c / PATH_ERROR_SPAN_C, -1.0, 1.0)
    temp_low_c, temp_high_c = _span(path.true_c)
    flow_high_mm3_s = max(_span(path.flow_mm3_s)[1], 0.1)
    return {
        "points": len(path.x_mm),
        "starts": path.layer_start,
        "left": left,
        "front": front,
        "side": side,
        "errorSpan": PATH_ERROR_SPAN_C,
        "x": _base64(np.round((path.x_mm - left) / side * 65535.0).astype("<u2")),
        "y": _base64(np.round((path.y_mm - front) / side * 65535.0).astype("<u2")),
        "error": _base64(np.round(error * 127.0).astype("i1")),
        "tempLow": temp_low_c,
        "tempHigh": temp_high_c,
        "temp": _base64(_bytes(path.true_c, temp_low_c, temp_high_c)),
        "flowHigh": flow_high_mm3_s,
        "flow": _base64(_bytes(path.flow_mm3_s, 0.0, flow_high_mm3_s)),
        "pen": _base64(path.pen),
    }


def _span(values: Floats) -> tuple[float, float]:
    """Between which values nearly all are, rounded outwards: an odd point may saturate."""
    low, high = (float(part) for part in np.percentile(values, (0.5, 99.5)))
    step = 10.0 ** math.floor(math.log10(max(high - low, 1.0)) - 0.5)
    low, high = math.floor(low / step) * step, math.ceil(high / step) * step
    return round(low, 3), round(max(high, low + step), 3)


def _bytes(values: Floats, low: float, high: float) -> np.ndarray:
    """Values as 0..255 between two of them."""
    return np.round(np.clip((values - low) / (high - low), 0.0, 1.0) * 255.0).astype("u1")


def _float32(values: np.ndarray) -> str:
    return _base64(values.astype("<f4"))


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
