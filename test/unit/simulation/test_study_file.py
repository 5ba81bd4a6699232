"""A study file: what is wrong in it and in which line, and the points its plan makes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from simulation.study.formula import FormulaError, evaluate
from simulation.study.sampling import Parameter, Plan, points, shares
from simulation.study.studyfile import Study, StudyError, read_study

ROOT = Path(__file__).resolve().parents[3]
RMS = '"heater.settled_rms_error_c"'
GOOD = """
config = "printer.cfg"
files = ["part.gcode"]

[plan]
kind = "lhs"
runs = 8

[parameters]
"extruder.pressure_advance" = { dist = "uniform", low = 0.0, high = 0.1 }
"simulator mcu.drop" = 0.001

[figures]
rms_c = "heater.settled_rms_error_c"

[limits]
rms_c = { max = 1.0 }
"""


def read(folder: Path, text: str) -> Study:
    (folder / "printer.cfg").write_text("[printer]\n")
    path = folder / "try.toml"
    path.write_text(text)
    return read_study(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[plan]", "[plan", "try.toml is no TOML file: "),
        ("files =", "file =", "try.toml: the key 'files' is missing; it is a list of one G-code file or more"),
        ('["part.gcode"]', "[]", "line 3: files: this names no G-code file."),
        ("\n[plan]", "sead = 1\n[plan]", "line 4: sead: there is no such key. Did you mean 'seeds'?"),
        ('"printer.cfg"', '"other.cfg"', "line 2: config: there is no file "),
        ('"lhs"', '"halton"', "line 6: plan.kind: 'halton' is no plan; plans are grid, lhs, sobol, saltelli."),
        ("runs = 8", "runs = -1", "line 7: plan.runs: this has to be a whole number from 0 on, not -1."),
        ("runs = 8", "", "line 5: plan: the key 'runs' is missing"),
        ('"lhs"\nruns = 8', '"sobol"\nruns = 9', "plan.runs: a Sobol sequence is balanced for powers of two; take 8"),
        ('"lhs"\nruns = 8', '"grid"', 'line 9: parameters."extruder.pressure_advance": in a grid a distribution needs'),
        ('"extruder.pressure', '"pressure', 'line 10: parameters.pressure_advance: a parameter is "section.option"'),
        ("uniform", "unifrom", "line 10: parameters.\"extruder.pressure_advance\".dist: 'unifrom' is no distribution"),
        ("high = 0.1", "high = -0.1", "low has to be below high; 0 and -0.1 are not."),
        (", high = 0.1", "", "the distribution 'uniform' needs low, high; 'high' is missing."),
        ("high = 0.1", 'high = "x"', "this has to be a number, not 'x'."),
        ('"uniform"', '"loguniform"', "a loguniform distribution begins above zero."),
        ('dist = "uniform", ', "", 'this needs either dist = "..." or, times the value of the config, scale = "..."'),
        ("rms_c = {", "rmsc = {", "line 17: limits.rmsc: [figures] has no such figure. Did you mean 'rms_c'?"),
        ("max = 1.0", "maximum = 1.0", "limits.rms_c.maximum: there is no such key."),
        ("max = 1.0", "max = 1.0, share = 2.0", "share is the part of the prints within the limit"),
        (RMS, '{ trace = "true_c", take = "worst" }', "'worst' is not known; there are min, max"),
        (RMS, '{ trace = "true_c", take = "max", where = "t_s = 3" }', "'t_s = 3' is no condition"),
        ("files =", 'before = ["G28"]\nfiles =', "line 3: before: the last line has to be SAVE_CONFIG"),
        ("max = 1.0", 'max = 1.0, variant = "b"', "line 17: limits.rms_c: there is no variant 'b'."),
        ("[limits]", "[variants.a]\nspeed = 1\n[limits]", 'line 17: variants.a.speed: a parameter is "section.option"'),
        ("[limits]", '[variants.a]\n"b.c" = [1]\n[limits]', "a variant has one value for each of its parameters."),
        ("[limits]", '[small]\nvariants = ["a"]\n[limits]', "small.variants: there is no variant 'a'."),
        ("[limits]", "[small]\nrun = 1\n[limits]", "small.run: there is no such key. Did you mean 'runs'?"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_with_line_and_what_would_be_right(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in GOOD
    with pytest.raises(StudyError) as caught:
        read(tmp_path, GOOD.replace(old, new, 1))
    assert message in str(caught.value)


def test_a_small_form_replaces_the_size_and_drops_limits_of_what_it_leaves_out(tmp_path: Path) -> None:
    text = GOOD.replace(
        "rms_c = { max = 1.0 }", 'rms_c = [{ max = 1.0, variant = "a" }, { max = 2.0, variant = "b" }]'
    )
    text += '[small]\nruns = 2\nvariants = ["b"]\n[variants.a]\n"b.c" = 1\n[variants.b]\n"b.c" = 2\n'
    assert len(read(tmp_path, text).limits) == 3
    small = read_study(tmp_path / "try.toml", small=True)
    assert (small.plan.runs, list(small.variants)) == (2, ["b"])
    assert [(limit.figure, limit.variant) for limit in small.limits] == [("printed", ""), ("rms_c", "b")]
    assert read_study(tmp_path / "try.toml", runs=5).plan.runs == 5


def test_printed_has_a_limit_though_the_file_has_none(tmp_path: Path) -> None:
    limits = read(tmp_path, GOOD).limits
    assert [(limit.figure, limit.min, limit.max) for limit in limits] == [
        ("printed", 1.0, None),
        ("rms_c", None, 1.0),
    ]


@pytest.mark.parametrize(
    "path", sorted((ROOT / "config" / "studies").glob("*.toml")), ids=lambda path: path.stem
)
def test_the_studies_that_come_with_ferrite_can_be_read(path: Path) -> None:
    assert read_study(path).limits


def test_every_study_is_linked_by_a_page_with_its_figures() -> None:
    pages = (ROOT / "docs" / "theory").glob("*.md")
    linked = {name for page in pages for name in re.findall(r"config/studies/(\w+\.toml)", page.read_text())}
    assert linked == {path.name for path in (ROOT / "config" / "studies").glob("*.toml")}


def test_the_example_of_the_reference_can_be_read(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "reference" / "Study_Files.md").read_text(encoding="utf-8")
    example = page.partition("```toml\n")[2].partition("```")[0]
    assert len(read(tmp_path, example.replace("../sim-induction.cfg", "printer.cfg")).parameters) == 2


def test_a_latin_hypercube_has_one_point_in_each_eighth_of_each_parameter() -> None:
    parameters = [
        Parameter("a.b", "uniform", {"low": 10.0, "high": 18.0}),
        Parameter("a.c", "normal", NORMAL),
    ]
    table = list(points(Plan("lhs", 8, 3), parameters, {}))
    assert sorted(int(float(point["a.b"])) for point in table) == list(range(10, 18))
    assert table == list(points(Plan("lhs", 8, 3), parameters, {}))
    assert table != list(points(Plan("lhs", 8, 4), parameters, {}))


NORMAL = {"mean": 5.0, "sd": 2.0, "low": 2.0, "high": 9.0}


@pytest.mark.parametrize(
    ("parameter", "quarter", "median"),
    [
        (Parameter("a.b", "uniform", {"low": 1.0, "high": 3.0}), 1.5, 2.0),
        (Parameter("a.b", "loguniform", {"low": 0.01, "high": 100.0}), 0.1, 1.0),
        (Parameter("a.b", "normal", {"mean": 5.0, "sd": 2.0, "low": None, "high": None}), 3.65102, 5.0),
        # between -1.5 and 2 standard deviations: 0.066807 + share * 0.910443 of the whole
        (Parameter("a.b", "normal", NORMAL), 3.91895, 5.1105),
        (Parameter("a.b", "choice", {"values": ["x", "y", "z"]}), "x", "y"),
    ],
)
def test_shares_of_a_distribution_lie_below_its_values(
    parameter: Parameter, quarter: float | str, median: float | str
) -> None:
    for share, value in ((0.25, quarter), (0.5, median)):
        found = parameter.value(share)
        assert found == (value if isinstance(value, str) else pytest.approx(value, rel=1e-4))


def test_a_grid_has_every_combination_ends_included() -> None:
    parameters = [
        Parameter("a.b", "uniform", {"low": 0.0, "high": 1.0}, steps=3),
        Parameter("a.c", "choice", {"values": ["x", "y"]}),
        Parameter("a.d", "constant", {"values": [7]}),
    ]
    table = [tuple(point.values()) for point in points(Plan("grid", 0, 1), parameters, {})]
    assert table == [(b, c, 7) for b in (0.0, 0.5, 1.0) for c in ("x", "y")]


def test_a_relative_parameter_is_times_the_value_of_the_config() -> None:
    parameter = Parameter("a.b", "uniform", {"low": 0.5, "high": 0.7}, relative=True, steps=2)
    assert [p["a.b"] for p in points(Plan("grid", 0, 1), [parameter], {"a.b": 40.0})] == [20.0, 28.0]


def test_saltelli_exchanges_one_column_at_a_time() -> None:
    parameters = [Parameter(f"a.{name}", "uniform", {"low": 0.0, "high": 1.0}) for name in "xyz"]
    a, b, *mixed = np.array(list(shares(Plan("saltelli", 4, 1), parameters))).reshape(5, 4, 3)
    for column, rows in enumerate(mixed):
        assert (rows[:, column] == b[:, column]).all()
        others = [other for other in range(3) if other != column]
        assert (rows[:, others] == a[:, others]).all()


DRAWS = '[draws]\nv = { dist = "uniform", low = 20, high = 30 }\nd = [1, 2]\n[limits]'


def test_values_are_made_of_draws(tmp_path: Path) -> None:
    text = GOOD.replace("[limits]", DRAWS).replace("0.001", '"0:{v}, 60:{-v * (d + 1) ** 2 / 4}"')
    study = read(tmp_path, text)
    for point in points(study.plan, study.parameters, {}):
        v, d = float(point["v"]), float(point["d"])
        first, second = str(point["simulator mcu.drop"]).split(", 60:")
        assert float(first.removeprefix("0:")) == pytest.approx(v)
        assert float(second) == pytest.approx(-v * (d + 1.0) ** 2 / 4.0)
        assert 20.0 <= v <= 30.0


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("{w}", "there is no draw 'w'; there are v"),
        ("{v +}", "'v +' is no arithmetic"),
        ("{v / 0}", "'v / 0' has no value"),
        ("{open('x')}", "numbers, draws, + - * / ** and parentheses"),
        ("{v.real}", "numbers, draws, + - * / ** and parentheses"),
    ],
)
def test_a_formula_is_arithmetic_of_draws_and_nothing_else(formula: str, message: str) -> None:
    with pytest.raises(FormulaError, match=re.escape(message)):
        evaluate(formula, {"v": 1.0})


def test_a_formula_of_braces_alone_is_a_number() -> None:
    assert evaluate("{2 * v}", {"v": 1.5}) == 3.0
    assert evaluate("0:{2 * v}", {"v": 1.5}) == "0:3"


SETS = GOOD.replace(
    "[figures]",
    """
[parameters.machine]
plain = {}
heavy = { "simulator nozzle nozzle.mass_factor" = 1.3, "extruder.nozzle_diameter" = 0.6 }

[figures]""",
)


def test_a_parameter_may_be_a_choice_of_sets_of_options(tmp_path: Path) -> None:
    machine = read(tmp_path, SETS).parameters[-1]
    assert machine.arguments["values"] == ["plain", "heavy"]
    assert machine.sets["heavy"] == {
        "simulator nozzle nozzle.mass_factor": 1.3,
        "extruder.nozzle_diameter": 0.6,
    }


def test_a_set_of_something_else_than_options_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r'a set has "section\.option" = value'):
        read(tmp_path, SETS.replace("extruder.nozzle_diameter", "diameter"))
