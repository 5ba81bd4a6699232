"""The report of a simulated print, on traces whose figures are known beforehand."""

from __future__ import annotations

import base64
import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from simulation.report import ReportError, render_page, write_report
from simulation.report.charts import cuts
from simulation.report.data import (
    COLUMNS,
    Trace,
    envelope,
    extruding,
    find_layers,
    head_speed,
    read_trace,
    settled,
    thin_path,
)
from simulation.report.figures import Figure, PrintRun

ROWS_PER_S = 100
ERROR_AMPLITUDE_C = 0.8
SUMMARY = {"wall_s": 2.0, "moves": 1234, "seed": 7, "faults": []}


def made_up_print(seconds: float = 60.0, layers: int = 4) -> Trace:
    """Heats to 250 degC in 5 s, then prints squares of 20 mm with a slow sine on the temperature.

    Each layer has a travel move with a lift of 0.6 mm in its middle.
    """
    t = np.arange(int(seconds * ROWS_PER_S)) / ROWS_PER_S
    target = np.where(t < 1.0, 0.0, 250.0)
    true = np.minimum(20.0 + np.maximum(t - 1.0, 0.0) * 46.0, 250.0)
    printed = (t >= 10.0) & (t < seconds - 2.0)
    true += np.where(t > 8.0, ERROR_AMPLITUDE_C * np.sin(2.0 * math.pi * t), 0.0)
    part = np.clip((t - 10.0) / (seconds - 12.0), 0.0, 0.999999) * layers
    lap = part % 1.0
    travel = (lap > 0.5) & (lap < 0.55)
    side = (4.0 * lap * 5.0) % 4.0
    x = 90.0 + 20.0 * np.clip(np.abs(side - 2.5) * -1.0 + 1.5, 0.0, 1.0)
    y = 90.0 + 20.0 * np.clip(np.abs(side - 1.5) * -1.0 + 1.5, 0.0, 1.0)
    z = np.where(printed, 0.2 * (np.floor(part) + 1.0) + np.where(travel, 0.6, 0.0), 5.0)
    flow = np.where(printed & ~travel, 6.0, 0.0)
    power = np.where(t < 1.0, 0.0, 30.0)
    columns = (
        target,
        true + 0.3,
        true,
        true - 0.2,
        true - 12.0,
        45000 * np.sqrt(power / 81.3),
        power,
        flow,
        x,
        y,
        z,
    )
    e = np.cumsum(flow) / ROWS_PER_S / 2.405
    return Trace(t, *(c.astype(np.float32) for c in (*columns, e)))


def write_csv(trace: Trace, path: Path, columns: tuple[str, ...] = COLUMNS) -> Path:
    table = np.column_stack([getattr(trace, name) for name in columns])
    np.savetxt(path, table, delimiter=",", fmt="%.4f", header=",".join(columns), comments="")
    return path


def value_of(table: list[Figure] | tuple[Figure, ...], label: str) -> str:
    return next(figure.value for figure in table if figure.label == label)


def data_of(page: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    data = json.loads(found.group(1))
    assert isinstance(data, dict)
    return data


@pytest.fixture(scope="module")
def trace() -> Trace:
    return made_up_print()


@pytest.fixture(scope="module")
def run(trace: Trace) -> PrintRun:
    return PrintRun.of(trace, SUMMARY)


def test_a_trace_comes_back_from_its_file(trace: Trace, tmp_path: Path) -> None:
    back = read_trace(write_csv(trace, tmp_path / "t.csv"))
    for name in COLUMNS:
        # the file has four decimals, the columns single precision (2e-3 ticks at 45000)
        np.testing.assert_allclose(getattr(back, name), getattr(trace, name), atol=3e-3)


def test_columns_may_stand_in_any_order_among_others(trace: Trace, tmp_path: Path) -> None:
    path = write_csv(trace, tmp_path / "t.csv", tuple(reversed(COLUMNS)))
    lines = path.read_text().splitlines()
    path.write_text("\n".join(["bed_c," + lines[0], *("60.0," + line for line in lines[1:])]))
    np.testing.assert_allclose(read_trace(path).true_c, trace.true_c, atol=1e-3)


def test_the_table_holds_the_figures_of_the_trace(run: PrintRun) -> None:
    assert value_of(run.table, "Simulated time") == "60.0 s"
    # 46 K/s from 1 s: within 3 degC after (250 - 3 - 20)/46 = 4.93 s, and it stays there
    assert value_of(run.table, "Heat-up") == "4.9 s"
    rms_c = float(value_of(run.table, "Temperature error, rms").split()[0])
    assert rms_c == pytest.approx(
        ERROR_AMPLITUDE_C / math.sqrt(2.0), abs=0.01
    )  # whole periods; printed with 2 digits
    assert value_of(run.table, "Temperature error, range") == "−0.80 to +0.80 °C"
    assert value_of(run.table, "Estimator error, mean") == "+0.30 °C"
    assert value_of(run.table, "Power into the nozzle") == "30.0 W"
    assert value_of(run.table, "Moves") == "1,234"
    assert value_of(run.table, "Faults") == "none"


def test_a_fault_is_reported_in_the_table(trace: Trace) -> None:
    faulty = PrintRun.of(trace, {**SUMMARY, "faults": ["guard tripped"]})
    assert value_of(faulty.table, "Faults") == "guard tripped"


def test_layers_are_found_by_height_and_a_lift_does_not_split_them(trace: Trace) -> None:
    layers = find_layers(trace, extruding(trace))
    assert [round(layer.z_mm, 3) for layer in layers] == [0.2, 0.4, 0.6, 0.8]
    for layer in layers:
        assert layer.duration_s == pytest.approx(12.0, abs=0.1)  # 48 s in four layers; ends are rows
        assert layer.flow_mean_mm3_s == pytest.approx(6.0)
        assert layer.error_max_c == pytest.approx(ERROR_AMPLITUDE_C, abs=0.01)  # rows fall close to the crest


def test_a_continuous_spiral_has_layers_too() -> None:
    spiral = made_up_print()
    climb = np.linspace(0.0, 2.0, len(spiral.t_s)).astype(np.float32)
    trace = Trace(*(climb if name == "z_mm" else getattr(spiral, name) for name in COLUMNS))
    assert (
        20 < len(find_layers(trace, extruding(trace))) < 60
    )  # 1.6 mm climbed while printing, a step each 0.04 mm


def test_settled_begins_when_the_band_is_kept_and_lasts_to_the_next_target() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    target = np.where(t < 10.0, 200.0, 0.0)
    # passes through the band at 1 s for 1 s, comes to stay at 4 s, is disturbed at 8 s
    true = np.where(((t > 1.0) & (t < 2.0)) | (t > 4.0), 200.0, 100.0)
    true = np.where((t > 8.0) & (t < 8.5), 210.0, true)
    zeros = np.zeros_like(t)
    trace = Trace(t, target, zeros, true, *([zeros] * 9))
    rows = t[settled(trace)]
    assert rows[0] == pytest.approx(4.0, abs=0.02)
    assert rows[-1] == pytest.approx(10.0, abs=0.02)
    assert len(rows) == pytest.approx(600, abs=2)


def test_a_target_never_reached_is_not_settled() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    target, true = np.full_like(t, 200.0), np.full_like(t, 150.0)
    zeros = np.zeros_like(t)
    assert not settled(Trace(t, target, zeros, true, *([zeros] * 9))).any()


def test_thinning_keeps_a_spike_of_one_row() -> None:
    t = np.arange(600_000) / ROWS_PER_S
    values = np.zeros(len(t), dtype=np.float32)
    values[123_457], values[400_001] = 9.0, -4.0
    thin = envelope(t, values, 1000)
    assert len(thin.t_s) <= 1000
    assert thin.high.max() == 9.0
    assert thin.low.min() == -4.0
    at = int(np.argmax(thin.high))
    assert thin.t_s[at] <= t[123_457] < thin.t_s[at + 1]


def test_a_thinned_series_is_one_line_through_its_extremes() -> None:
    t = np.arange(1000) / ROWS_PER_S
    values = np.zeros(len(t), dtype=np.float32)
    values[500] = 9.0
    t_s, line = envelope(t, values, 100).line()
    assert (np.diff(t_s) > 0.0).all()
    assert line.max() == 9.0
    assert t_s[int(np.argmax(line))] == pytest.approx(t[500], abs=0.1)  # within its bucket


def test_peaks_beyond_the_scale_are_marked_once_each() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    values = np.zeros(len(t), dtype=np.float32)
    values[300:350], values[360] = 7.0, 8.0  # the second is too near for a mark of its own
    values[1200] = -6.5
    values[1500] = 5.9
    found = [(round(start, 2), round(end, 2), sign) for start, end, sign in cuts(t, values, 6.0)]
    assert found == [(3.0, 3.6, 1), (12.0, 12.0, -1)]
    assert cuts(t, values, None) == []


def test_the_head_speed_is_that_of_its_path() -> None:
    speed = head_speed(made_up_print())
    # five times round a square of 20 mm a side in the 12 s of a layer
    assert np.median(speed[1100:1500]) == pytest.approx(5 * 80.0 / 12.0, rel=0.01)


def test_columns_a_trace_may_lack_are_drawn_when_it_has_them(trace: Trace, tmp_path: Path) -> None:
    path = write_csv(trace, tmp_path / "t.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0] + ",bed_c,sigma_c", *(line + ",60.0,nan" for line in lines[1:])]))
    charts = data_of(render_page("part.gcode", PrintRun.of(read_trace(path), SUMMARY)))["charts"]
    assert isinstance(charts, list)
    bed = next(chart for chart in charts if chart["title"] == "Bed")
    assert [series["label"] for series in bed["series"]] == ["bed"]
    assert not any(
        "error" in chart["title"] and "host" in chart["title"] for chart in charts
    )  # nothing but nan


def test_the_page_says_how_to_repeat_the_run(trace: Trace) -> None:
    facts = {
        "version": "0.2.0-abc",
        "config": "config/sim.cfg",
        "gcode": "folder/part.gcode",
        "gcode_sha256": "0123abcd",
        "date": "2026-01-02 03:04:05+00:00",
        "command": "scripts/simulate.py config/sim.cfg",
    }
    page = render_page("part.gcode", PrintRun.of(trace, {**SUMMARY, **facts}))
    made = page[page.index("How it was made") :]
    for text in ("0.2.0-abc", "sim.cfg", "0123abcd", "<dd>7</dd>", "03:04:05", "scripts/simulate.py"):
        assert text in made
    assert "folder/" not in made  # of a file its hash says more than its place


def test_the_figures_follow_the_first_chart_and_settled_is_explained(run: PrintRun) -> None:
    page = render_page("part.gcode", run)
    places = [page.index(f'id="{name}"') for name in ("first-chart", "figures", "charts", "layers")]
    assert places == sorted(places)
    assert "has kept within 3 °C of the target\n    for 2 s" in page


def test_a_short_series_is_not_thinned() -> None:
    t, values = np.arange(10.0), np.arange(10, dtype=np.float32)
    thin = envelope(t, values, 10)
    assert np.array_equal(thin.low, values)
    assert np.array_equal(thin.high, values)


def test_the_thinned_path_keeps_its_corners_and_lifts_the_pen_over_travel(trace: Trace) -> None:
    extrudes = extruding(trace)
    layers = find_layers(trace, extrudes)
    path = thin_path(trace, layers, extrudes, max_points=400)
    assert len(path.x_mm) < 1.2 * 400
    assert len(path.layer_start) == len(layers)
    for corner in ((90.0, 90.0), (110.0, 90.0), (110.0, 110.0), (90.0, 110.0)):
        distance = np.hypot(path.x_mm - corner[0], path.y_mm - corner[1])
        assert distance.min() < 0.5  # a row is 0.33 mm long
    # each layer starts with the pen up, and once more after its travel move
    assert np.count_nonzero(path.pen == 0) == 2 * len(layers)


def test_the_page_needs_nothing_but_itself(run: PrintRun) -> None:
    page = render_page("part.gcode", run)
    page = page.replace("/*! https://github.com/leeoniya/uPlot", "")  # a comment of the library
    assert not re.search(r"https?:|@import|url\(|<link|<img|\bsrc=|\bhref=|\bfetch\(|XMLHttpRequest", page)
    for figure in run.table:
        assert figure.label in page
        assert figure.value in page


def test_the_page_carries_the_series(run: PrintRun) -> None:
    data = data_of(render_page("part.gcode", run))
    charts = data["charts"]
    assert isinstance(charts, list)
    shown = {series["label"]: series for chart in charts for series in chart["series"]}
    flow = np.frombuffer(base64.b64decode(shown["flow"]["values"]), dtype="<f4")
    assert np.array_equal(flow, run.trace.flow_mm3_s)


def test_names_from_outside_cannot_break_the_page(run: PrintRun) -> None:
    page = render_page("</script><b>.gcode", run)
    assert "</script><b>" not in page


def test_the_page_of_a_long_print_stays_small() -> None:
    run = PrintRun.of(made_up_print(seconds=6000.0, layers=300), SUMMARY)  # 600,000 rows
    assert len(run.layers) == 300
    assert len(render_page("long.gcode", run).encode()) < 5_000_000


def test_the_picture_is_drawn(trace: Trace, tmp_path: Path) -> None:
    from matplotlib.image import imread

    path = tmp_path / "report.png"
    write_report(write_csv(trace, tmp_path / "t.csv"), SUMMARY, "part.gcode", png=path)
    pixels = imread(path)
    assert pixels.shape[0] > 1000
    assert pixels.shape[1] > 1000
    ink = np.mean(np.any(pixels[..., :3] < 0.95, axis=2))
    assert 0.02 < ink < 0.9  # neither blank nor a blot


def test_a_print_that_deposits_nothing_down_is_reported_all_the_same(tmp_path: Path) -> None:
    still = made_up_print()
    nothing = np.zeros_like(still.flow_mm3_s)
    trace = Trace(*(nothing if name == "flow_mm3_s" else getattr(still, name) for name in COLUMNS))
    table = write_report(
        write_csv(trace, tmp_path / "t.csv"),
        {},
        "empty.gcode",
        html=tmp_path / "r.html",
        png=tmp_path / "r.png",
    )
    assert value_of(table, "Printed") == "nothing"
    assert "there are no layers" in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t_s,target_c\n0,1\n", "no column estimate_c, true_c"),
        (",".join(COLUMNS) + "\n", "no rows"),
        (",".join(COLUMNS) + "\n" + ",".join("0" * 12 + "x") + "\n", "not a number"),
        ("", "no column"),
    ],
)
def test_an_unusable_trace_is_reported_in_one_sentence(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(ReportError, match=complaint):
        write_report(path, {}, "part.gcode", html=tmp_path / "r.html")


def test_missing_files_are_found_by_name(trace: Trace, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"cannot read the trace .*absent\.csv"):
        write_report(tmp_path / "absent.csv", {}, "part.gcode")
    path = write_csv(trace, tmp_path / "t.csv")
    with pytest.raises(ReportError, match=r"cannot read the summary .*absent\.json"):
        write_report(path, tmp_path / "absent.json", "part.gcode")
    with pytest.raises(ReportError, match="cannot write the report"):
        write_report(path, {}, "part.gcode", html=tmp_path / "absent" / "r.html")


# ---- in a browser ----------------------------------------------------------------------------------------------


def browse(page: str, tmp_path: Path, *options: str, link: str = "") -> str:
    """What headless Chromium prints for a page; `options` say what."""
    chromium = shutil.which("chromium")
    assert chromium, "Chromium is not installed; run: scripts/setup.sh browser"
    path = tmp_path / "r.html"
    path.write_text(page, encoding="utf-8")
    command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000", *options]
    done = subprocess.run(
        [*command, path.as_uri() + link], capture_output=True, text=True, timeout=120, check=True
    )
    assert "Uncaught" not in done.stderr, done.stderr
    return done.stdout


@pytest.fixture
def page(run: PrintRun) -> str:
    return render_page("part.gcode", run)


@pytest.mark.browser
def test_the_page_comes_alive_in_a_browser(page: str, tmp_path: Path) -> None:
    dom = browse(page, tmp_path, "--dump-dom")
    assert "3 of 4, z = 0.60 mm" in dom  # the script opens the page at the middle layer
    assert re.findall(r'<div class="u-title">(.*?)</div>', dom) == [
        "Temperature, °C",
        "Temperature error, °C (scale to ±6, ▲ ▼ where it goes beyond)",
        "Power into the nozzle, W",
        "Bridge phase, 45000 ticks = 180°, ticks",
        "Flow, mm³/s",
        "Speed of the head, mm/s",
        "True minus target over the extruding moves of a layer, °C (scale to ±6, ▲ ▼ where it goes beyond)",
    ]
    assert "true minus target" in dom


@pytest.mark.browser
@pytest.mark.parametrize(("colour", "words"), [("temp", "true temperature:"), ("flow", "mm³/s</span>")])
def test_a_link_opens_a_layer_in_its_colours(page: str, tmp_path: Path, colour: str, words: str) -> None:
    dom = browse(page, tmp_path, "--dump-dom", link=f"#layer=2&colour={colour}")
    assert "2 of 4, z = 0.40 mm" in dom
    assert words in dom


@pytest.mark.browser
@pytest.mark.parametrize("link", ["#layer=99&colour=none", "#%%%&layer=x"])
def test_a_wrong_link_opens_the_page_all_the_same(page: str, tmp_path: Path, link: str) -> None:
    dom = browse(page, tmp_path, "--dump-dom", link=link)
    assert re.search(r"[1-4] of 4, z = ", dom)
    assert "true minus target" in dom


@pytest.mark.browser
def test_the_layers_path_is_drawn_in_the_colours_of_its_temperature(page: str, tmp_path: Path) -> None:
    shots = {}
    for colour in ("error", "temp"):
        file = tmp_path / f"{colour}.png"
        browse(
            page,
            tmp_path,
            f"--screenshot={file}",
            "--window-size=1200,3600",
            link=f"#layer=2&colour={colour}",
        )
        shots[colour] = plt.imread(file)[..., :3]
    changed = np.any(np.abs(shots["error"] - shots["temp"]) > 0.05, axis=2)
    rows, columns = np.nonzero(changed)
    # nothing above the layers depends on the choice; below, the path and its scale do
    assert rows.min() > 1000
    assert changed.sum() > 2000
    assert len(np.unique(shots["temp"][rows, columns].round(2), axis=0)) > 10, "a ramp of colours"


LAYOUT = """<script>
addEventListener("load", () => setTimeout(() => {
  const top = (id) => document.getElementById(id).getBoundingClientRect().top;
  const places = ["first-chart", "figures", "charts", "layers"].map(top);
  document.title = JSON.stringify([innerWidth, document.documentElement.scrollWidth, ...places]);
}, 300));
</script></body>"""


@pytest.mark.browser
def test_on_a_phone_the_figures_follow_the_first_chart_and_nothing_is_wider_than_the_screen(
    page: str, tmp_path: Path
) -> None:
    dom = browse(page.replace("</body>", LAYOUT), tmp_path, "--dump-dom", "--window-size=390,844")
    (title,) = re.findall(r"<title>(.*?)</title>", dom)
    screen_px, page_px, first_px, figures_px, charts_px, layers_px = json.loads(title)
    assert page_px <= screen_px <= 500
    assert first_px < 300 and figures_px < 844, "one screen shows the first chart, and the figures begin"
    assert first_px < figures_px < charts_px < layers_px
    assert charts_px - figures_px < 1.2 * 844, "two columns of them"


DRAG = """<script>
addEventListener("load", () => setTimeout(() => {
  const over = document.querySelector(".u-over"), box = over.getBoundingClientRect();
  const send = (type, part) => over.dispatchEvent(new MouseEvent(type, {
    clientX: box.left + part * box.width, clientY: box.top + 50, movementX: 1, bubbles: true, button: 0,
  }));
  const release = () => document.dispatchEvent(new MouseEvent("mouseup", {
    clientX: box.left + 0.5 * box.width, clientY: box.top + 50, bubbles: true, button: 0,
  }));
  const steps = [() => send("mouseenter", 0.25), () => send("mousemove", 0.25), () => send("mousedown", 0.25),
    () => send("mousemove", 0.5), release, () => send("mousemove", 0.0)];
  steps.forEach((step, i) => setTimeout(step, 100 * i));
}, 100));
</script></body>"""


@pytest.mark.browser
def test_a_drag_in_one_chart_zooms_all(page: str, tmp_path: Path) -> None:
    dom = browse(page.replace("</body>", DRAG), tmp_path, "--dump-dom")
    at_s = [float(text) for text in re.findall(r'at</div></th><td class="u-value">([\d.]+)</td>', dom)]
    # of 60 s the quarter from 15 s; the pointer is at the left edge of one chart, and followed by the others
    assert len(at_s) == 6
    assert at_s == pytest.approx([15.0] * 6, abs=0.2)
