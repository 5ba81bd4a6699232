"""A study from its file to its table and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .analysis import Verdict, influences, judge
from .job import execute, version
from .page import Content, render
from .prepare import Prepared
from .results import Journal, Rows, write_failures, write_table
from .studyfile import ENDINGS, Study

MET, NOT_MET = 0, 1
REPORT, NO_REPORT = "report.html", "no_report.txt"  # what repeating a print leaves last
OnProgress = Callable[[int, int], None]  # finished prints, all prints


@dataclass(frozen=True, slots=True)
class Finished:
    """`rows`: of this study's prints; `failed`: how many did not end well."""

    rows: Rows
    verdicts: list[Verdict]
    failed: int

    @property
    def status(self) -> int:
        """Exit status of study.py."""
        return MET if all(verdict.met for verdict in self.verdicts) else NOT_MET


def run_study(
    study: Study,
    prepared: Prepared,
    folder: Path,
    command: str,
    cluster: tuple[str | None, int | None],
    on_progress: OnProgress,
) -> Finished:
    """`command`: that of the study, for failures.txt; `cluster`: address of a scheduler, or number of workers."""
    folder.mkdir(parents=True, exist_ok=True)
    journal = Journal(folder)
    try:
        missing = [job for key, job in prepared.jobs.items() if key not in journal.rows]
        total = len(prepared.jobs)
        done = total - len(missing)
        on_progress(done, total)

        def on_result(result: Mapping[str, Any]) -> None:
            nonlocal done
            done += 1
            journal.add(result)
            on_progress(done, total)

        try:
            if missing:
                from .engine import connect, run_jobs

                with connect(*cluster) as client:
                    run_jobs(client, missing, on_result)
        finally:  # of an interrupted study too: what there is
            rows = {key: journal.rows[key] for key in prepared.jobs if key in journal.rows}
            write_table(folder / "results.parquet", prepared.jobs, prepared.points, rows)
            failed = write_failures(folder / "failures.txt", prepared.jobs, rows, command)
    finally:
        journal.close()
    verdicts = judge(study.limits, rows, prepared)
    reports = _write_reports(study, prepared, folder, verdicts)
    _write_page(study, prepared, folder, rows, verdicts, reports)
    return Finished(rows, verdicts, failed)


def repeat(prepared: Prepared, key: str, folder: Path) -> dict[str, Any]:
    """One print again, with trace, summary, log and report in runs/KEY of the folder."""
    keep = folder / "runs" / key
    keep.mkdir(parents=True, exist_ok=True)
    job = prepared.jobs[key]
    result = execute(job, keep.resolve())
    from simulation.report import ReportError, write_report

    try:
        write_report(keep / "trace.csv", keep / "summary.json", job.gcode, html=keep / REPORT)
    except ReportError as e:
        (keep / NO_REPORT).write_text(f"{e}\n", encoding="utf-8")
    return result


def _write_reports(
    study: Study, prepared: Prepared, folder: Path, verdicts: Sequence[Verdict]
) -> frozenset[str]:
    """Of the worst prints of each limit."""
    wanted = [key for verdict in verdicts for key in verdict.worst[: study.reports]]
    for key in dict.fromkeys(wanted):
        if not any((folder / "runs" / key / name).exists() for name in (REPORT, NO_REPORT)):
            repeat(prepared, key, folder)
    return frozenset(key for key in prepared.jobs if (folder / "runs" / key / REPORT).exists())


def _write_page(
    study: Study,
    prepared: Prepared,
    folder: Path,
    rows: Rows,
    verdicts: Sequence[Verdict],
    reports: frozenset[str],
) -> None:
    varied = [p.name for p in study.parameters if p.varies]
    base = study.plan.runs if study.plan.kind == "saltelli" else 0
    found = influences(prepared.order, prepared.points, rows, list(study.figures), varied, base)
    content = Content(
        study.title, version(), prepared.points, rows, list(study.figures), verdicts, found, reports
    )
    (folder / "index.html").write_text(render(content), encoding="utf-8")


def summary_lines(finished: Finished) -> list[str]:
    """Limits in words."""
    lines = []
    for verdict in finished.verdicts:
        limit = verdict.limit
        bounds = [f"min {limit.min:g}"] if limit.min is not None else []
        bounds += [f"max {limit.max:g}"] if limit.max is not None else []
        need = "" if limit.figure in ENDINGS else f" of {100 * limit.share:g} % required"
        name = limit.figure + (f" ({limit.variant})" if limit.variant else "")
        name += f" over that of {limit.of}" if limit.of else ""
        state = "met" if verdict.met else "NOT MET"
        lines.append(f"{name}: {', '.join(bounds)}: {state}, {100 * verdict.share:.4g} % of the prints{need}")
    return lines
