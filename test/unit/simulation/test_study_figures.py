"""Figures of a print, and what is computed from the figures of many."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from simulation.study.analysis import influences, judge
from simulation.study.figures import collect
from simulation.study.job import Job, WrongWorker, copy_config, execute, input_hashes, version
from simulation.study.prepare import Prepared
from simulation.study.results import Rows
from simulation.study.sampling import Parameter, Plan, points
from simulation.study.studyfile import Limit

TRACE = "t_s,target_c,true_c,flow_mm3_s\n0,200,196,0\n1,200,201,4\n2,200,203,4\n3,200,200,0\n"


def row(status: str = "printed", **figures: float | None) -> dict[str, Any]:
    return {"status": status, "reason": "", "figures": figures}


@pytest.mark.parametrize(
    ("take", "where", "value"),
    [
        ("max_abs", [], 4.0),
        ("max", [["flow_mm3_s", ">", 0.5]], 3.0),
        ("min", [["t_s", ">=", 1.0], ["t_s", "<", 3.0]], 1.0),
        ("rms", [["flow_mm3_s", ">", 0.5]], math.sqrt(5.0)),
        ("p50", [], 0.5),
        ("last", [["flow_mm3_s", ">", 0.5]], 3.0),
        ("mean", [["t_s", ">", 9.0]], None),
        ("range", [], 7.0),
        ("p75_abs", [], 3.25),
        ("seconds", [["abs(true_c - target_c)", ">=", 3.0]], 2.0),
        ("seconds", [["true_c - target_c", ">=", 3.0]], 1.0),
    ],
)
def test_a_figure_of_the_trace(tmp_path: Path, take: str, where: list[Any], value: float | None) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text(TRACE)
    figure = {"trace": "true_c", "minus": "target_c", "take": take, "where": where}
    found = collect({"f": figure}, {}, trace)["f"]
    assert found == (None if value is None else pytest.approx(value, rel=1e-8))


@pytest.mark.parametrize(
    ("take", "average_s", "value"),
    [
        ("mean", None, (1 * 1 + 3 * 3) / 4),
        ("rms", 2.0, math.sqrt(((1 * 1 + 3 * 3) / 4) ** 2)),  # one interval has all weight, the other none
        ("p50", None, 3.0 - 2.0 * 0.5 / 2.0),  # weights 1 and 3: middles at 0.5 and 2.5 of 4
    ],
)
def test_means_and_percentiles_may_be_weighted(
    tmp_path: Path, take: str, average_s: float | None, value: float
) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("t_s,true_c,flow_mm3_s\n0,1,1\n1,3,3\n2,9,0\n3,nan,5\n")
    figure = {"trace": "true_c", "minus": "", "take": take, "where": [], "weight": "flow_mm3_s"}
    found = collect({"f": {**figure, "average_s": average_s}}, {}, trace)["f"]
    assert found == pytest.approx(value, rel=1e-8)


def test_the_amplitude_of_a_sine_is_found_beside_mean_and_others(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    rows = [(i / 50, 7.0 + 1.5 * math.sin(i / 5 + 1.0) + math.cos(i / 2)) for i in range(500)]
    trace.write_text("t_s,true_c\n" + "".join(f"{t},{c}\n" for t, c in rows))
    figure = {"trace": "true_c", "minus": "", "take": "sine", "where": [], "hz": 10.0 / (2.0 * math.pi)}
    assert collect({"f": {**figure, "per": 3.0}}, {}, trace)["f"] == pytest.approx(0.5, abs=0.01)


def test_a_figure_of_the_summary_is_a_number_a_count_or_nothing() -> None:
    summary = {"heater": {"targets": [{"reach_s": 1.5}], "rms": None}, "faults": ["a", "b"]}
    paths = {
        "a": "heater.targets.0.reach_s",
        "b": "heater.targets.1.reach_s",
        "c": "heater.rms",
        "d": "faults",
    }
    figures = {name: {"summary": path} for name, path in paths.items()}
    assert collect(figures, summary, None) == {"a": 1.5, "b": None, "c": None, "d": 2.0}


def test_limits_are_for_the_share_of_the_prints_they_name() -> None:
    rows: Rows = {str(n): row(x=float(n)) for n in range(10)} | {"z": row("printer shut down", x=None)}
    limits = [
        Limit("printed", min=0.9),
        Limit("printed", min=1.0),
        Limit("x", max=8.0, share=0.9),
        Limit("x", min=1.0),
    ]
    first, second, third, fourth = judge(limits, rows)
    assert (first.met, second.met) == (True, False)
    assert second.worst == ("z",)
    assert (third.share, third.met, third.worst[0]) == (0.9, True, "9")
    assert (fourth.met, fourth.worst[0]) == (False, "0")


def test_a_limit_may_be_for_a_variant_or_its_ratio_to_another() -> None:
    twins = [{"ours": "a", "theirs": "b"}, {"ours": "c", "theirs": "d"}]
    points = {key: {"variant": name} for twin in twins for name, key in twin.items()}
    prepared = Prepared({}, points, [], {key: twin for twin in twins for key in twin.values()})
    rows: Rows = {"a": row(x=1.0), "b": row(x=4.0), "c": row(x=3.0), "d": row("calibration failed", x=None)}
    limits = [
        Limit("x", max=3.0, variant="ours"),
        Limit("x", max=3.0, variant="theirs"),
        Limit("x", max=0.3, share=0.5, variant="ours", of="theirs"),
        Limit("x", max=0.2, share=0.5, variant="ours", of="theirs"),
        Limit("refused", max=0.25),
        Limit("tripped", max=0.0),
        Limit("refused", max=0.25, variant="theirs"),
    ]
    assert [v.met for v in judge(limits, rows, prepared)] == [True, False, True, False, True, True, False]


def test_a_printed_print_without_the_figure_is_not_within_its_limit() -> None:
    verdict = judge([Limit("x", max=1.0)], {"a": row(x=0.5), "b": row(x=None)})[0]
    assert (verdict.share, verdict.met, verdict.worst[0]) == (0.5, False, "b")


def test_a_study_without_a_good_print_meets_no_limit() -> None:
    assert not judge([Limit("x", max=1.0)], {"a": row("bad input", x=None)})[0].met


def test_sobol_indices_of_a_function_whose_indices_are_known() -> None:
    """Ishigami, a = 7, b = 0.1: first order 0.3139, 0.4424, 0; total 0.5576, 0.4424, 0.2437."""
    names = ["s.x", "s.y", "s.z"]
    parameters = [Parameter(n, "uniform", {"low": -math.pi, "high": math.pi}) for n in names]
    order, table, rows = [], {}, {}
    for number, point in enumerate(points(Plan("saltelli", 1024, 1), parameters, {})):
        x, y, z = (float(point[n]) for n in names)
        key = f"{number:06d}"
        order.append(key)
        table[key] = point
        rows[key] = row(f=math.sin(x) + 7.0 * math.sin(y) ** 2 + 0.1 * z**4 * math.sin(x))
    found = {one.parameter: one for one in influences(order, table, rows, ["f"], names, 1024)}
    for name, first, total in zip(names, (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437), strict=True):
        # the error of 1024 points of a Sobol sequence is about 0.01
        assert found[name].first == pytest.approx(first, abs=0.03)
        assert found[name].total == pytest.approx(total, abs=0.03)


def test_rank_correlation_does_not_ask_for_a_straight_line() -> None:
    table = {str(n): {"s.a": float(n), "s.b": "x" if n % 2 else "y"} for n in range(9)}
    rows = {key: row(f=math.exp(point["s.a"])) for key, point in table.items()}
    found = {one.parameter: one.rho for one in influences(list(table), table, rows, ["f"], ["s.a", "s.b"], 0)}
    assert found == {"s.a": pytest.approx(1.0), "s.b": None}


def test_the_key_of_a_print_is_what_determines_it_not_where_its_files_are() -> None:
    facts: dict[str, Any] = {
        "config": "a.cfg", "gcode": "a.gcode", "seed": 1, "overrides": (("s", "o", "1"),), "before": (),
        "until_s": None, "figures": {}, "version": "v", "inputs": ("c", "g"),
    }  # fmt: skip
    job = Job(**facts)
    assert Job(**facts | {"config": "b.cfg", "gcode": "b.gcode"}).key == job.key
    changes = {
        "seed": 2,
        "overrides": (),
        "before": ("SAVE_CONFIG",),
        "until_s": 1.0,
        "version": "w",
        "inputs": ("d", "g"),
    }
    assert len({Job(**facts | {name: value}).key for name, value in changes.items()} | {job.key}) == 7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": "of yesterday"}, "sources of Ferrite are not, or no longer"),
        (
            {"inputs": ("edited", "since")},
            "config/sim-induction.cfg or config/studies/disc.gcode is not, or no longer",
        ),
    ],
)
def test_a_worker_with_other_sources_or_files_refuses(changes: dict[str, Any], message: str) -> None:
    files = ("config/sim-induction.cfg", "config/studies/disc.gcode")
    facts = {"version": version(), "inputs": input_hashes(*files), **changes}
    with pytest.raises(WrongWorker, match=message):
        execute(Job(*files, 1, (), (), None, {}, **facts))


def test_a_copied_config_has_what_the_config_includes(tmp_path: Path) -> None:
    """SAVE_CONFIG does not write to options of included files."""
    (tmp_path / "parts").mkdir()
    config = tmp_path / "printer.cfg"
    config.write_text("[include parts/*.cfg]  # all\n[printer]\nkinematics: none\n")
    (tmp_path / "parts" / "b.cfg").write_text("[fan]\npin: PA1\n")
    (tmp_path / "parts" / "a.cfg").write_text("[include ../rest.inc]\n")
    (tmp_path / "rest.inc").write_text("[mcu]\nserial: x\n")
    (tmp_path / "copy").mkdir()
    copy = copy_config(config, tmp_path / "copy").read_text()
    lines = [line for line in copy.splitlines() if line]
    assert lines == ["[mcu]", "serial: x", "[fan]", "pin: PA1", "[printer]", "kinematics: none"]
