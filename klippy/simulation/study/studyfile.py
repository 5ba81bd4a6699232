"""The study file: TOML to a `Study`, and errors with key, line and what would be right."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from .sampling import DISTRIBUTIONS, KINDS, Parameter, Plan

FIGURE_NAME = re.compile(r"[a-z][a-z0-9_]*")
TAKES = ("min", "max", "range", "mean", "rms", "max_abs", "last", "seconds", "sine")
FORMULAS = ("add", "per", "hz")  # of a figure: a number, or arithmetic with the draws in braces
PERCENTILE = re.compile(r"p\d{1,2}(_abs)?")
CONDITION = re.compile(
    r"\s*(\w+(?:\s*-\s*\w+)?|abs\(\w+(?:\s*-\s*\w+)?\))\s*(<=|>=|<|>)\s*(-?[\d.]+(?:e-?\d+)?)\s*"
)
PRINTED = "printed"  # the limit on the share of prints that end well
# Limits on the share of prints that ended in a way; all prints count.
ENDINGS = {
    PRINTED: ("printed",),
    "tripped": ("printer shut down",),
    "refused": ("calibration failed", "bad input"),  # also a config with what a calibration saved
}
VARIANT = "variant"
SMALL = ("runs", "seeds", "files", "variants", "until_s", "reports")

_KEY = r"""(?:"[^"]*"|'[^']*'|[\w-]+)"""
_DOTTED = rf"{_KEY}(?:\s*\.\s*{_KEY})*"
_HEADER = re.compile(rf"\s*\[\s*({_DOTTED})\s*\]")
_ASSIGNED = re.compile(rf"\s*({_DOTTED})\s*=")


class StudyError(Exception):
    """The study file is wrong, or the study cannot go on; the text is for people."""


@dataclass(frozen=True, slots=True)
class Limit:
    """Bounds of a figure, and the share of the prints that has to be within them. `variant`: "" counts all; `of`: the
    figure is divided by that of this variant at the same point.
    """

    figure: str
    min: float | None = None
    max: float | None = None
    share: float = 1.0
    variant: str = ""
    of: str = ""


@dataclass(frozen=True, slots=True)
class Study:
    """What a study file asks for. `figures`: name → specification, as simulation.study.figures reads it; `variants`:
    name → parameters with one value each, every point of the plan is printed with each; `befores`: their own steps
    before the print.
    """

    path: Path
    title: str
    config: Path
    files: tuple[str, ...]  # as written: a path, or sample:NAME
    before: tuple[str, ...]
    seeds: tuple[int, ...]
    until_s: float | None
    reports: int
    plan: Plan
    parameters: tuple[Parameter, ...]
    variants: Mapping[str, Mapping[str, Any]]
    befores: Mapping[str, tuple[str, ...]]
    figures: Mapping[str, Mapping[str, Any]]
    limits: tuple[Limit, ...]
    lines: Mapping[tuple[str, ...], int] = field(default_factory=dict)

    def error(self, keys: tuple[str, ...], text: str) -> StudyError:
        """An error at a key of the file, or at the nearest table around it."""
        return error(self.path, self.lines, keys, text)


def error(path: Path, lines: Mapping[tuple[str, ...], int], keys: tuple[str, ...], text: str) -> StudyError:
    """`file, line N: key: text`; the line of a key within an inline table is that of the table."""
    line = next((lines[keys[:n]] for n in range(len(keys), 0, -1) if keys[:n] in lines), 0)
    name = ".".join(key if re.fullmatch(r"[\w-]+", key) else f'"{key}"' for key in keys)
    place = f"{path.name}, line {line}" if line else path.name
    return StudyError(": ".join(part for part in (place, name, text) if part))


def near(word: str, known: Iterable[str]) -> str:
    """' Did you mean ...?' or nothing."""
    close = difflib.get_close_matches(word, list(known), n=3, cutoff=0.6)
    return f" Did you mean {' or '.join(repr(name) for name in close)}?" if close else ""


def find_lines(text: str) -> dict[tuple[str, ...], int]:
    """The line of each table header and each key that begins a line; tomllib keeps none."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, assigned = _HEADER.match(line), _ASSIGNED.match(line)
        if header:
            table = _split(header[1])
            lines.setdefault(table, number)
        elif assigned:
            lines.setdefault((*table, *_split(assigned[1])), number)
    return lines


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(key.strip("\"'") for key in re.findall(_KEY, dotted))


class _Table:
    """One table of the file: keys are taken, and what nobody takes is refused."""

    def __init__(
        self, path: Path, lines: Mapping[tuple[str, ...], int], keys: tuple[str, ...], values: Any
    ) -> None:
        self._path, self._lines, self._keys = path, lines, keys
        if not isinstance(values, dict):
            raise error(path, lines, keys, f"this has to be a table, not {values!r}.")
        self.values: dict[str, Any] = dict(values)
        self._known: list[str] = []

    def error(self, key: str, text: str) -> StudyError:
        return error(self._path, self._lines, (*self._keys, *([key] if key else [])), text)

    def table(self, key: str) -> _Table:
        self._known.append(key)
        return _Table(self._path, self._lines, (*self._keys, key), self.values.pop(key, {}))

    def take(self, key: str, default: Any = None) -> Any:
        self._known.append(key)
        return self.values.pop(key, default)

    def need(self, key: str, what: str) -> Any:
        if key not in self.values:
            close = difflib.get_close_matches(key, self.values, n=1)
            hint = f" There is a '{close[0]}'." if close else ""
            raise self.error("", f"the key '{key}' is missing; it is {what}.{hint}")
        return self.take(key)

    def number(self, key: str, default: float | None = None) -> float | None:
        value = self.take(key, default)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise self.error(key, f"this has to be a number, not {value!r}.")
        return None if value is None else float(value)

    def whole(self, key: str, default: int, low: int = 0) -> int:
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise self.error(key, f"this has to be a whole number from {low} on, not {value!r}.")
        return value

    def text(self, key: str, value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise self.error(key, f"this has to be text in quotes, not {value!r}.")
        return value

    def list_of(self, key: str, kind: type, what: str, default: list[Any]) -> list[Any]:
        value = self.take(key, default)
        good = isinstance(value, list) and all(isinstance(v, kind) and not isinstance(v, bool) for v in value)
        if not good:
            raise self.error(key, f"this has to be a list of {what} in brackets, not {value!r}.")
        return list(value)

    def before(self, default: tuple[str, ...]) -> tuple[str, ...]:
        lines = tuple(self.list_of("before", str, "lines of G-code", list(default)))
        if lines and lines[-1].strip().upper() != "SAVE_CONFIG":
            raise self.error(
                "before", "the last line has to be SAVE_CONFIG: the print starts from what it saved."
            )
        return lines

    def finish(self, known: Sequence[str] = ()) -> None:
        for key in self.values:
            hint = near(key, known or self._known) or f" Known here: {', '.join(known or self._known)}."
            raise self.error(key, f"there is no such key.{hint}")


def read_study(path: Path, small: bool = False, runs: int | None = None) -> Study:
    """`small`: with what [small] changes; `runs`: so many points. Raises StudyError."""
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text)
    except OSError as e:
        raise StudyError(f"There is no study file {path}: {e.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise StudyError(f"{path.name} is no TOML file: {e}.") from None
    lines = find_lines(text)
    top = _Table(path, lines, (), values)
    chosen = _make_smaller(top, small, runs)
    written = top.text("config", top.need("config", "the printer.cfg with simulator sections"))
    config = (path.parent / written).resolve()
    if not config.is_file():
        raise top.error("config", f"there is no file {config}.")
    if "files" not in top.values:
        top.need("files", 'a list of one G-code file or more, as ["part.gcode"]')
    files = top.list_of("files", str, "G-code files", [])
    if not files:
        raise top.error("files", "this names no G-code file.")
    before = top.before(())
    figures = _read_figures(top.table("figures"))
    variants, befores = _read_variants(top.table("variants"), before)
    study = Study(
        path=path,
        title=top.text("title", top.take("title", path.stem)),
        config=config,
        files=tuple(files),
        before=before,
        seeds=tuple(top.list_of("seeds", int, "whole numbers", [1])) or (1,),
        until_s=top.number("until_s"),
        reports=top.whole("reports", 1),
        plan=_read_plan(top.table("plan")),
        parameters=(*_read_draws(top.table("draws")), *_read_parameters(top.table("parameters"))),
        variants=variants,
        befores=befores,
        figures=figures,
        limits=tuple(_read_limits(top.table("limits"), figures, variants)),
        lines=lines,
    )
    top.finish()
    _check_plan(study)
    if chosen is None:
        return study
    limits = tuple(limit for limit in study.limits if {limit.variant, limit.of} <= {"", *chosen})
    return replace(study, variants={name: variants[name] for name in chosen}, limits=limits)


def _make_smaller(top: _Table, small: bool, runs: int | None) -> list[str] | None:
    """Replace what [small] and the command line say of the study's size; the variants of a small one, None: all."""
    less = top.table("small")
    changes = {key: less.take(key) for key in SMALL if key in less.values}
    less.finish(SMALL)
    known = top.values.get("variants", {})
    for name in changes.get("variants") or []:
        if name not in known:
            raise less.error("variants", f"there is no variant {name!r}.{near(name, known)}")
    changes = changes if small else {}
    if runs is not None:
        changes["runs"] = runs
    if "runs" in changes:
        top.values.setdefault("plan", {})["runs"] = changes.pop("runs")
    chosen: list[str] | None = changes.pop("variants", None)
    top.values.update(changes)
    return chosen


def _read_variants(
    table: _Table, before: tuple[str, ...]
) -> tuple[dict[str, dict[str, Any]], dict[str, tuple[str, ...]]]:
    variants: dict[str, dict[str, Any]] = {}
    befores: dict[str, tuple[str, ...]] = {}
    for name in list(table.values):
        one = table.table(name)
        variants[name] = {}
        befores[name] = one.before(before)
        for key in list(one.values):
            _need_option(one, key)
            variants[name][key] = one.take(key)
            if isinstance(variants[name][key], list | dict):
                raise one.error(key, "a variant has one value for each of its parameters.")
    return variants, befores


def _need_option(table: _Table, name: str) -> None:
    section, dot, option = name.rpartition(".")
    if not dot or not section.strip() or not option.strip():
        raise table.error(name, 'a parameter is "section.option", in quotes, as "extruder.pressure_advance".')


def _read_plan(table: _Table) -> Plan:
    kind = table.take("kind", "grid")
    if kind not in KINDS:
        raise table.error("kind", f"{kind!r} is no plan; plans are {', '.join(KINDS)}.")
    plan = Plan(kind, table.whole("runs", 0), table.whole("seed", 1))
    table.finish()
    if kind == "grid" and plan.runs:
        raise table.error("runs", "a grid has the points of its parameters; leave this key out.")
    if kind != "grid" and not plan.runs:
        raise table.error("", f"the key 'runs' is missing; it is the number of points of the plan {kind!r}.")
    if kind in ("sobol", "saltelli") and plan.runs & (plan.runs - 1):
        power = 1 << plan.runs.bit_length()
        raise table.error(
            "runs", f"a Sobol sequence is balanced for powers of two; take {power // 2} or {power}."
        )
    return plan


def _read_parameters(table: _Table) -> Iterable[Parameter]:
    for name in list(table.values):
        value = table.values[name]
        if "." not in name and isinstance(value, dict) and all(isinstance(v, dict) for v in value.values()):
            yield _read_sets(name, table.table(name))
            continue
        _need_option(table, name)
        value = table.values[name]
        if isinstance(value, list):
            value = table.values[name] = {"dist": "choice", "values": value}
        if isinstance(value, str) and "{" in value:
            table.take(name)
            yield Parameter(name, "formula", {"formula": value})
            continue
        if not isinstance(value, dict):
            table.take(name)
            yield Parameter(name, "constant", {"values": [value]})
            continue
        yield _read_distribution(name, table.table(name))


def _read_draws(table: _Table) -> Iterable[Parameter]:
    for name in list(table.values):
        if not name.isidentifier():
            raise table.error(name, "a draw has a name of letters, digits and _.")
        if isinstance(table.values[name], list):
            table.values[name] = {"dist": "choice", "values": table.values[name]}
        if not isinstance(table.values[name], dict):
            raise table.error(name, "a draw is a distribution or a list of values.")
        draw = _read_distribution(name, table.table(name))
        if draw.relative:
            raise table.error(name, "a draw has no value in the config that 'scale' could multiply.")
        yield draw


def _read_sets(name: str, table: _Table) -> Parameter:
    """Sets of options under one name each: name → "section.option" → value."""
    sets: dict[str, Mapping[str, Any]] = {}
    for one in list(table.values):
        sets[one] = table.table(one).values
        for option, value in sets[one].items():
            if "." not in option or isinstance(value, list | dict):
                raise table.error(one, f'a set has "section.option" = value; {option!r} is none.')
    if not sets:
        raise table.error("", "this has to have a set of options or more.")
    return Parameter(name, "choice", {"values": list(sets)}, sets=sets)


def _read_distribution(name: str, table: _Table) -> Parameter:
    relative = "scale" in table.values
    if relative == ("dist" in table.values):
        raise table.error(
            "", 'this needs either dist = "..." or, times the value of the config, scale = "...".'
        )
    word = "scale" if relative else "dist"
    kind = table.take(word)
    if kind not in DISTRIBUTIONS:
        raise table.error(word, f"{kind!r} is no distribution; there are {', '.join(DISTRIBUTIONS)}.")
    needed, optional = DISTRIBUTIONS[kind]
    arguments: dict[str, Any] = {}
    for key in (*needed, *optional):
        if key == "values":
            arguments[key] = table.take(key)
            if not isinstance(arguments[key], list) or not arguments[key]:
                raise table.error(key, "this has to be a list with one value or more.")
        else:
            value = table.number(key)
            if value is None and key in needed:
                raise table.error(
                    "", f"the distribution {kind!r} needs {', '.join(needed)}; {key!r} is missing."
                )
            arguments[key] = value
    steps = table.whole("steps", 0)
    table.finish()
    low, high = arguments.get("low"), arguments.get("high")
    if low is not None and high is not None and not low < high:
        raise table.error("low", f"low has to be below high; {low:g} and {high:g} are not.")
    if kind == "loguniform" and not arguments["low"] > 0.0:
        raise table.error("low", "a loguniform distribution begins above zero.")
    if kind == "normal" and not arguments["sd"] > 0.0:
        raise table.error("sd", "a standard deviation is above zero.")
    return Parameter(name, kind, arguments, relative, steps)


def _check_plan(study: Study) -> None:
    """What a parameter needs or may not have in this kind of plan."""
    for parameter in study.parameters:
        keys = ("parameters", parameter.name)
        if parameter.kind in ("choice", "constant", "formula"):
            if parameter.steps:
                raise study.error(keys, "a choice has the steps of its values; leave 'steps' out.")
        elif study.plan.kind == "grid" and parameter.steps < 2:
            raise study.error(keys, "in a grid a distribution needs steps = 2 or more, or a list of values.")
        elif study.plan.kind == "grid" and None in (parameter.arguments["low"], parameter.arguments["high"]):
            raise study.error(
                keys, "in a grid a normal distribution needs low and high, its first and last step."
            )
        elif study.plan.kind != "grid" and parameter.steps:
            raise study.error(keys, f"'steps' is for a grid; the plan is {study.plan.kind!r}.")
    if study.plan.kind != "grid" and not any(p.varies for p in study.parameters):
        raise study.error(("plan", "kind"), f"{study.plan.kind!r} needs a parameter with a distribution.")


def _read_figures(table: _Table) -> dict[str, dict[str, Any]]:
    figures: dict[str, dict[str, Any]] = {}
    for name in list(table.values):
        if not FIGURE_NAME.fullmatch(name) or name in ENDINGS:
            taken = ", ".join(ENDINGS)
            raise table.error(
                name, f"a figure has a name of small letters, digits and _, and not of {taken}."
            )
        if isinstance(table.values[name], str):
            figures[name] = {"summary": table.take(name)}
            continue
        one = table.table(name)
        column = one.text("trace", one.need("trace", "the column of the trace the figure is made of"))
        take = one.need("take", f"one of {', '.join(TAKES)}, or a percentile as p95")
        if take not in TAKES and not PERCENTILE.fullmatch(str(take)):
            known = ", ".join(TAKES)
            raise one.error(
                "take", f"{take!r} is not known; there are {known}, p01 to p99 and p01_abs to p99_abs."
            )
        average_s, weight = one.number("average_s"), one.take("weight", "")
        figures[name] = {"trace": column, "take": take, "minus": one.take("minus", ""), "where": []}
        figures[name] |= {"average_s": average_s, "weight": weight}
        less = one.take("less", "")
        if less and less not in figures:
            raise one.error("less", f"no figure before this one is {less!r}.{near(str(less), figures)}")
        figures[name] |= {"less": less, **{key: one.take(key, "") for key in FORMULAS}}
        if (take == "sine") != bool(figures[name]["hz"]):
            raise one.error("hz", "take = 'sine' needs hz, the frequency; nothing else has one.")
        where = one.take("where", "")
        for condition in str(where).split(" and ") if where else ():
            match = CONDITION.fullmatch(condition)
            if match is None:
                raise one.error("where", f'{condition!r} is no condition; one is as "flow_mm3_s > 0.5".')
            figures[name]["where"].append([match[1], match[2], float(match[3])])
        one.finish()
    if not figures:
        raise table.error("", "the study collects nothing; name one figure or more.")
    return figures


def _read_limits(table: _Table, figures: Mapping[str, Any], variants: Mapping[str, Any]) -> Iterable[Limit]:
    if PRINTED not in table.values:
        yield Limit(PRINTED, min=1.0)
    for name in list(table.values):
        if name not in figures and name not in ENDINGS:
            raise table.error(name, f"[figures] has no such figure.{near(name, [*figures, *ENDINGS])}")
        several = table.values[name] if isinstance(table.values[name], list) else [table.values[name]]
        for value in several:
            table.values[name] = value
            yield _read_limit(table, name, variants)


def _read_limit(table: _Table, name: str, variants: Mapping[str, Any]) -> Limit:
    one = table.table(name)
    bounds = one.number("min"), one.number("max"), one.number("share", 1.0) or 0.0
    limit = Limit(name, *bounds, one.take(VARIANT, ""), one.take("of", ""))
    one.finish()
    for variant in (limit.variant, limit.of):
        if variant and variant not in variants:
            raise table.error(name, f"there is no variant {variant!r}.{near(variant, variants)}")
    if limit.min is None and limit.max is None:
        raise table.error(name, "a limit has min, max or both, as { max = 1.0 }.")
    if not 0.0 < limit.share <= 1.0:
        raise table.error(name, "share is the part of the prints within the limit, above 0 and up to 1.")
    return limit
