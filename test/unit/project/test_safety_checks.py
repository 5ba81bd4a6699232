"""The programs that judge the safety files' tests find what they are there to find."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from branch_trace import Tracer
from mutants import Result, complaints, entry, read_argued
from mutate import Mutation, mutations
from safety_files import ROOT, SAFETY, Part

C_FILE = """\
#include "limit.h" /* a < b */
#define BOUND 3
static int kept(int x) { return x; }

int
limit(int *p, int x)
{
    // x < 1
    if (x < BOUND && !p)
        return 0;
    p[0] =
        x - 1;
    puts("a < b");
    return *p ? 1 : -x;
}

int
other(int x)
{
    struct pair p = {.a = x, .b = {.c = 0}};
    return x + 7u;
}
"""
PYTHON_FILE = """\
def limit(x: int | None, text="a < b") -> bool:  # a < b
    seen = 0.5
    if x is None or not x <= 2:
        return False
    print(
        text,
    )
    return x * seen > 0
"""


def changes(text: str, is_c: bool, functions: tuple[str, ...] = ()) -> set[tuple[str, str]]:
    return {(m.before, m.after) for m in mutations(text, is_c, functions)}


def test_each_operator_bound_condition_and_statement_of_c_is_changed_and_no_comment() -> None:
    condition = "if (x < BOUND && !p)"
    assert changes(C_FILE, True, ("limit",)) == {
        *((condition, c) for c in ("if (!(x < BOUND && !p))", "if (x < BOUND || !p)", "if (x < BOUND && p)")),
        *((condition, f"if (x {op} BOUND && !p)") for op in ("<=", ">=")),
        *((condition, f"if (x < (BOUND {sign} 1) && !p)") for sign in "+-"),
        ("return 0;", "return 1;"),
        ("p[0] =", "p[1] ="),
        ("p[0] = x - 1;", ";"),
        *(("x - 1;", f"x {rest};") for rest in ("+ 1", "- 2", "- 0")),
        ('puts("a < b");', ";"),
        *(
            ("return *p ? 1 : -x;", f"return *p {rest};")
            for rest in ("== 0 ? 1 : -x", "? 2 : -x", "? 0 : -x")
        ),
        ("return *p ? 1 : -x;", "return *p ? 1 : x;"),
        ("limit(int *p, int x)", "limit(int /p, int x)"),  # does not compile: the compiler says so
    }


def test_without_named_functions_all_of_a_file_is_changed() -> None:
    assert {("return x + 7u;", "return x - 7u;"), ("return x + 7u;", "return x + 8u;")} <= changes(
        C_FILE, True
    )


def test_a_change_stands_in_the_text_where_its_line_says() -> None:
    for mutation in mutations(C_FILE, True):
        before, after = C_FILE.splitlines(), mutation.text.splitlines()
        assert before[: mutation.line - 1] == after[: mutation.line - 1]
        assert before[mutation.line - 1] != after[mutation.line - 1]


def test_each_operator_condition_and_statement_of_python_is_changed_and_no_annotation() -> None:
    condition = "if x is None or not x <= 2:"
    turned = ("is None and not x <= 2", "is None or x <= 2", "is None or not x < 2", "is None or not x > 2")
    assert changes(PYTHON_FILE, False) == {
        *(("seen = 0.5", after) for after in ("pass", "seen = 0.55", "seen = 0.45")),
        *((condition, f"if x {after}:") for after in turned),
        *((condition, f"if x is None or not x <= {n}:") for n in (1, 3)),
        (condition, "if not (x is None or not x <= 2):"),
        ("return False", "return True"),
        ("print( text, )", "pass"),
        *(
            ("return x * seen > 0", f"return x {rest}")
            for rest in ("/ seen > 0", "* seen >= 0", "* seen <= 0")
        ),
        ("return x * seen > 0", "return x * seen > 1"),
    }


def test_a_survivor_needs_an_argument_and_an_argument_a_survivor() -> None:
    part = Part("src/x.c", ())
    found = [Result(part, Mutation(n, f"line {n}", "", ""), "survived") for n in (1, 2)]
    found.append(Result(part, Mutation(3, "line 3", "", ""), "killed"))
    argued = {result.key: "because" for result in found[:1]}
    (unargued,) = complaints(found, argued)
    assert "line 2" in unargued and "[[survivor]]" in unargued
    (gone,) = complaints(found, {result.key: "because" for result in found})
    assert "no survivor" in gone and "line 3" in gone
    elsewhere = {("src/y.c", "line", "", 1): "not looked at in this run"}
    assert complaints(found, argued | elsewhere | {found[1].key: "so"}) == []


def test_what_is_printed_of_a_survivor_is_what_the_list_needs(tmp_path: Path) -> None:
    result = Result(Part("src/x.c", ()), Mutation(1, 'if (a && "b")', 'if (a || "b")', "", 2), "survived")
    path = tmp_path / "list.toml"
    path.write_text(entry(result))
    assert read_argued(path) == {result.key: ""}


def test_every_listed_survivor_is_a_change_of_the_files_as_they_are_with_a_reason() -> None:
    parts = [part for parts in SAFETY.values() for part in parts]
    possible = {
        (part.source, *mutation.key)
        for part in parts
        for mutation in mutations((ROOT / part.source).read_text(), part.is_c, part.functions)
    }
    argued = read_argued()
    assert set(argued) <= possible
    assert all(len(reason.split()) > 3 for reason in argued.values())


@pytest.mark.parametrize(
    ("calls", "missed"),
    [
        ("f(1); f(-1); f(9)", []),
        ("f(1); f(9)", ["2: goes one way only: if x < 0 or x > 5:"]),
        ("f(1)", ["2: goes one way only: if x < 0 or x > 5:", "3: not reached: return 0"]),
        ("", ["2: not reached: if x < 0 or x > 5:", "3: not reached: return 0", "4: not reached: return x"]),
    ],
)
def test_lines_and_halves_of_conditions_that_were_not_reached_are_named(
    calls: str, missed: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "piece.py"
    path.write_text("def f(x):\n    if x < 0 or x > 5:\n        return 0\n    return x\n")
    tracer, names = Tracer(path), {}
    before = sys.gettrace()
    sys.settrace(tracer)
    exec(compile(path.read_text(), str(path), "exec"), names)
    exec(calls, names)
    sys.settrace(before)
    assert list(tracer.missed()) == missed
