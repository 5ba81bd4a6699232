#!/usr/bin/env python3
"""Names every line and branch of the safety files (safety_files.py) that their own tests do not reach.

safety_coverage.py [NAME ...]: works on a copy of the tree, built without optimisation and with gcc's counters.
"""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from safety_files import SAFETY, Part, copy_tree, pytest_command, with_gcc_flags

# Nothing that adds branches of its own, nothing that folds any.
FLAGS = ("--coverage", "-O0", "-fno-lto", "-fno-sanitize=all", "-fprofile-update=atomic", "-Wno-error")


def _run(command: list[str], tree: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout[-4000:]}{done.stderr[-4000:]}")


def _counts(tree: Path, source: str) -> list[dict[str, Any]]:
    """gcc's counts of a source: a list of lines for each library it is in."""
    files = []
    for data in sorted(tree.rglob(f"*-{Path(source).stem}.gcda")):
        _run(["gcov", "--json-format", "--branch-probabilities", str(data)], data.parent, {})
        for report in data.parent.glob("*.gcov.json.gz"):
            files += json.loads(gzip.decompress(report.read_bytes()))["files"]
            report.unlink()
    return [
        line for file in files if (tree / file["file"]).resolve() == tree / source for line in file["lines"]
    ]


def _missed_c(tree: Path, part: Part) -> Iterator[str]:
    counts: dict[int, int] = defaultdict(int)
    branches: dict[int, list[int]] = {}
    for line in _counts(tree, part.source):
        if part.functions and line.get("function_name") not in part.functions:
            continue
        number = line["line_number"]
        counts[number] += line["count"]
        taken = [branch["count"] for branch in line["branches"]]
        before = branches.get(number, [0] * len(taken))
        branches[number] = [a + b for a, b in zip(before, taken, strict=True)]
    text = (tree / part.source).read_text().splitlines()
    if not counts:
        yield "nothing was counted"
    for number in sorted(counts):
        if not counts[number]:
            yield f"{number}: not reached: {text[number - 1].strip()}"
        elif not all(branches[number]):
            ways = f"{branches[number].count(0)} of {len(branches[number])} branches not taken"
            yield f"{number}: {ways}: {text[number - 1].strip()}"


def uncovered(names: tuple[str, ...] = tuple(SAFETY)) -> list[str]:
    """A line of text for each line or branch that no test reaches."""
    parts = [part for name in names for part in SAFETY[name]]
    found = []
    with tempfile.TemporaryDirectory() as folder:
        tree = copy_tree(Path(folder) / "tree").resolve()
        # Every call of gcc keeps its notes apart, and after the folder that it compiled in is gone.
        notes = tree / "out" / "notes"
        notes.mkdir(parents=True)
        environment = with_gcc_flags(Path(folder) / "bin", *FLAGS, f'-dumpdir "{notes}/$$-"')
        # Python first: what else it compiles is counted, too.
        for part in (p for p in parts if not p.is_c):
            report = Path(folder) / "trace"
            trace = str(Path(__file__).with_name("branch_trace.py"))
            _run(pytest_command(part.tests, trace, part.source, str(report)), tree, environment)
            found += [f"{part.source}:{text}" for text in report.read_text().splitlines()]
        tests = tuple(dict.fromkeys(test for part in parts if part.is_c for test in part.tests))
        _run(pytest_command(tests), tree, environment)
        for part in (p for p in parts if p.is_c):
            found += [f"{part.source}:{text}" for text in _missed_c(tree, part)]
    return found


def main() -> int:
    names = tuple(sys.argv[1:]) or tuple(SAFETY)
    if unknown := set(names) - set(SAFETY):
        sys.exit(
            f"safety_coverage: no such name: {', '.join(sorted(unknown))}; there are {', '.join(SAFETY)}"
        )
    found = uncovered(names)
    print("\n".join(found) or f"{', '.join(names)}: every line and branch is reached")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
