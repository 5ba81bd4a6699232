"""From a study to its jobs: the config is loaded once, so that wrong names are found before anything prints."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from configtext import ConfigError, read_main

from ..world import parameter_tables
from .figures import columns_of
from .formula import FormulaError, evaluate
from .job import Job, WrongWorker, input_hashes, portable, run_child, version
from .sampling import Parameter, draws_of, points
from .studyfile import FORMULAS, VARIANT, Study, near

PLANTS = {"simulator nozzle": "nozzle", "simulator load": "load"}
SAMPLE = "sample:"
Options = Mapping[str, Mapping[str, str]]  # section → option → value


@dataclass(frozen=True, slots=True)
class Prepared:
    """`order`: keys in the order of the plan, once for each file, seed and variant; `points`: key → parameters;
    `twins`: key → the same point, file and seed with each variant.
    """

    jobs: dict[str, Job]
    points: dict[str, dict[str, Any]]
    order: list[str]
    twins: dict[str, dict[str, str]] = field(default_factory=dict)


def prepare(study: Study, sample: Callable[[str], Path]) -> Prepared:
    """`sample`: path of a sample file by its name. Raises StudyError."""
    description = _describe(study, {})
    if description["exit_status"] != 0:
        raise study.error(("config",), description["reason"])
    options = _with_plants(description["settings"])
    _check_figures(study, description)
    base = {p.name: _base(study, p, options) for p in study.parameters if p.relative}
    try:
        all_points = list(points(study.plan, study.parameters, base))
        figures = {name: dict(figure) for name, figure in study.figures.items()}
        _with_draws(figures, all_points[0])
    except FormulaError as e:
        raise study.error(("parameters",), f"{e}.") from None
    _check_names(study, options, all_points[0])
    _check_ranges(study, all_points)
    files = [_file(study, name, sample) for name in study.files]
    prepared = Prepared({}, {}, [])
    sources = version()
    for path in files:
        config, file = portable(study.config), portable(path)
        inputs = _hashes(study, config, file)
        for seed in study.seeds:
            twins: list[dict[str, str]] = [{} for _ in all_points]
            for variant, (number, point) in itertools.product(study.variants or [""], enumerate(all_points)):
                overrides = _overrides(study, {**point, **study.variants.get(variant, {})})
                before = study.befores.get(variant, study.before)
                job = Job(
                    config,
                    file,
                    seed,
                    overrides,
                    before,
                    study.until_s,
                    _with_draws(figures, point),
                    sources,
                    inputs,
                )
                prepared.jobs[job.key] = job
                prepared.points[job.key] = {VARIANT: variant, **point} if variant else point
                prepared.order.append(job.key)
                twins[number][variant] = job.key
                prepared.twins[job.key] = twins[number]
    return prepared


def _with_draws(figures: Mapping[str, dict[str, Any]], point: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Figures with the values that their formulas have at this point."""
    draws = draws_of(point)
    return {
        name: figure
        | {key: evaluate(f"{{{str(figure[key]).strip('{}')}}}", draws) for key in FORMULAS if figure.get(key)}
        for name, figure in figures.items()
    }


def _describe(study: Study, point: Mapping[str, Any]) -> dict[str, Any]:
    """What the host says of the config, with the parameters of one point."""
    with tempfile.TemporaryDirectory(prefix="ferrite-study-") as name:
        folder = Path(name)
        gcode = folder / "nothing.gcode"
        gcode.write_text("G4 P1\n", encoding="utf-8")
        task = {"config": str(study.config), "gcode": str(gcode), "seed": 1, "describe": True}
        return run_child({**task, "overrides": _overrides(study, point)}, folder)


def _overrides(study: Study, point: Mapping[str, Any]) -> tuple[tuple[str, str, str], ...]:
    found = []
    sets = {parameter.name: parameter.sets for parameter in study.parameters if parameter.sets}
    options = [pair for name, value in point.items() for pair in _options(sets, name, value)]
    for name, value in options:
        section, _, option = name.rpartition(".")
        if not section:  # a draw
            continue
        text = f"{value:.9g}" if isinstance(value, float) else str(value)
        found.append((section.strip(), option.strip().lower(), text))
    return tuple(found)


def _options(sets: Mapping[str, Any], name: str, value: Any) -> list[tuple[str, Any]]:
    return list(sets[name][value].items()) if name in sets else [(name, value)]


def _hashes(study: Study, config: str, file: str) -> tuple[str, str]:
    try:
        return input_hashes(config, file)
    except WrongWorker as e:
        raise study.error(("config",), str(e)) from None


def _file(study: Study, name: str, sample: Callable[[str], Path]) -> Path:
    if name.startswith(SAMPLE):
        try:
            return sample(name.removeprefix(SAMPLE))
        except Exception as e:
            raise study.error(("files",), f"{e}.") from None
    path = study.path.parent / name
    if not path.is_file():
        raise study.error(("files",), f"there is no file {path}.")
    return path.resolve()


# --- names and ranges ---


def _with_plants(settings: Options) -> dict[str, dict[str, str]]:
    """The options that the host has read, and those of the simulated plants with the values of their presets."""
    options = {section: dict(values) for section, values in settings.items()}
    for section, values in options.items():
        table = _plant(section)
        if table:
            bed = section.split()[-1] in ("bed", "heater_bed")
            preset = values.get("preset") or values.get("kind") or ("bed" if bed else "hotend")
            rows = parameter_tables()[table]
            options[section] = {name: f"{row.presets[preset]:.9g}" for name, row in rows.items()} | values
    return options


def _plant(section: str) -> str | None:
    return PLANTS.get(" ".join(section.split()[:2]))


def _base(study: Study, parameter: Parameter, options: Options) -> float:
    """The config's own value."""
    section, _, option = parameter.name.rpartition(".")
    value = options.get(section.strip().lower(), {}).get(option.strip().lower())
    if value is None:
        raise _unknown(study, parameter.name, options)
    try:
        return float(value)
    except ValueError:
        text = f"'scale' multiplies a number; the config has {value!r}."
        raise study.error(("parameters", parameter.name), text) from None


def _unknown(study: Study, name: str, options: Options, keys: tuple[str, ...] = ()) -> Exception:
    section, _, option = name.rpartition(".")
    known = options.get(section.strip().lower())
    if known is None:
        text = f"the config {study.config.name} has no section [{section}].{near(section, options)}"
    else:
        text = f"section [{section}] has no option '{option}'.{near(option, known)}"
    return study.error(keys or ("parameters", name), text)


def _check_names(study: Study, options: Options, point: Mapping[str, Any]) -> None:
    """An option that the config of the file did not read may be one with these parameters: the host decides."""
    config_sections = _sections(study)
    for name, changes in (study.variants or {"": {}}).items():
        names = [p.name for p in study.parameters if "." in p.name]
        keys: dict[str, tuple[str, ...]] = {parameter: ("parameters", parameter) for parameter in names}
        in_sets = {
            option for p in study.parameters for options_of in p.sets.values() for option in options_of
        }
        keys |= {parameter: ("variants", name, parameter) for parameter in changes}
        for parameter in (*keys, *in_sets):
            if parameter.rpartition(".")[0].strip() not in config_sections:
                raise _unknown(study, parameter, options, keys.get(parameter, ()))
        answer = _describe(study, {**point, **changes})
        if answer["exit_status"] == 0:
            continue
        for parameter, place in keys.items():
            section, _, option = parameter.rpartition(".")
            if option.strip().lower() not in options.get(section.strip().lower(), {}):
                raise _unknown(study, parameter, options, place)
        where = ("variants", name) if name else ("parameters",)
        raise study.error(where, f"with the first point: {answer['reason']}")


def _sections(study: Study) -> set[str]:
    try:
        return set(read_main(str(study.config))[0].sections)
    except ConfigError as e:
        raise study.error(("config",), str(e)) from None


def _check_ranges(study: Study, all_points: list[dict[str, Any]]) -> None:
    """Of the parameters of a simulated plant, whose ranges are known."""
    for parameter in study.parameters:
        section, _, option = parameter.name.rpartition(".")
        row = parameter_tables().get(_plant(section) or "", {}).get(option.strip().lower())
        for point in all_points if row else ():
            value = point[parameter.name]
            if row and isinstance(value, int | float) and not row.min <= value <= row.max:
                text = f"{value:g} is outside of the range of this parameter, {row.min:g} to {row.max:g}."
                raise study.error(("parameters", parameter.name), text)


def _check_figures(study: Study, description: Mapping[str, Any]) -> None:
    columns = description["columns"]
    for name, figure in study.figures.items():
        for column in columns_of({name: figure}):
            if column not in columns:
                text = f"the trace has no column '{column}'.{near(column, columns)}"
                raise study.error(("figures", name), text)
        value: Any = description["summary"]
        for key in figure.get("summary", "").split(".") if "summary" in figure else ():
            if not isinstance(value, Mapping):
                break
            if key not in value:
                text = f"the summary has no '{key}' there.{near(key, value) or ' It has ' + ', '.join(value)}"
                raise study.error(("figures", name), text)
            value = value[key]
