#!/usr/bin/env python3
"""Changes the safety files in one small place at a time (mutate.py) and runs their tests against each change.

mutants.py [NAME ...]     (make mutants FILE=guard; without FILE all of them)

A change that no test notices has survived. Either a test is missing, or test/data/mutants_survivors.toml argues why it
may. Exit status 1 if a survivor is not in that list, or one of the list is no longer there.
"""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mutate import Mutation, mutations
from safety_files import GCC, ROOT, SAFETY, Part, copy_tree, pytest_command, with_gcc_flags

SURVIVORS = ROOT / "test" / "data" / "mutants_survivors.toml"
WORKERS = max(2, os.cpu_count() or 2)
PATIENCE = 6.0  # a test run that takes so many times what it takes without a change hangs ...
PATIENCE_MIN_S = 30.0  # ... and after so long at the soonest
# What the harnesses' warnings would refuse is a change all the same.
FLAGS = ("-Wno-error",)
INCLUDES = ("-Isrc", "-Isrc/simulator", "-Iklippy")
VERDICTS = ("killed", "timeout", "survived", "same code", "does not build")

Key = tuple[str, str, str, int]  # file, line before, line after, which of several alike


@dataclass(frozen=True)
class Result:
    part: Part
    mutation: Mutation
    verdict: str

    @property
    def key(self) -> Key:
        return (self.part.source, *self.mutation.key)


class Bench:
    """A copy of the tree in which one change after the other is tried."""

    def __init__(self, folder: Path) -> None:
        self.tree = copy_tree(folder / "tree")
        self.environment = with_gcc_flags(folder / "bin", *FLAGS)
        self.limits_s: dict[Part, float] = {}
        self.objects: dict[Part, bytes | None] = {}

    def prepare(self, part: Part) -> None:
        """Without a change the tests pass; how long they take then."""
        if part in self.limits_s:
            return
        self._passes(part, 600.0)  # builds what is missing
        since = time.monotonic()
        if not self._passes(part, 600.0):
            sys.exit(f"mutants: {' '.join(part.tests)} fail without any change")
        self.limits_s[part] = max(PATIENCE_MIN_S, PATIENCE * (time.monotonic() - since))
        self.objects[part] = self._object(part) if part.is_c else None

    def judge(self, part: Part, mutation: Mutation) -> str:
        source = self.tree / part.source
        text = source.read_text()
        source.write_text(mutation.text)
        try:
            if part.is_c:
                code = self._object(part)
                if code is None:
                    return "does not build"
                if code == self.objects[part]:
                    return "same code"
            passes = self._passes(part, self.limits_s[part])
            return "timeout" if passes is None else "survived" if passes else "killed"
        finally:
            source.write_text(text)

    def _object(self, part: Part) -> bytes | None:
        """What gcc makes of the file, None if it refuses it."""
        command = [GCC, "-std=gnu11", "-O2", "-w", "-c", *INCLUDES, part.source, "-o", "mutant.o"]
        done = subprocess.run(command, cwd=self.tree, capture_output=True, check=False)
        return None if done.returncode else (self.tree / "mutant.o").read_bytes()

    def _passes(self, part: Part, limit_s: float) -> bool | None:
        """None: not within the time."""
        with subprocess.Popen(
            pytest_command(part.tests, "-m", "pytest", "-p", "no:cacheprovider"),
            cwd=self.tree,
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        ) as run:
            try:
                return run.wait(limit_s) == 0
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                return None


def run(names: tuple[str, ...]) -> list[Result]:
    """Every change of these files, judged by as many benches as there are processors."""
    waiting: queue.Queue[tuple[Part, Mutation]] = queue.Queue()
    for part in (part for name in names for part in SAFETY[name]):
        for mutation in mutations((ROOT / part.source).read_text(), part.is_c, part.functions):
            waiting.put((part, mutation))
    total, results, failures = waiting.qsize(), [], []

    def work(folder: Path) -> None:
        try:
            bench = Bench(folder)
            while True:
                part, mutation = waiting.get_nowait()
                bench.prepare(part)
                results.append(Result(part, mutation, bench.judge(part, mutation)))
                if sys.stderr.isatty():
                    print(f"\r{len(results)} of {total}", end="", file=sys.stderr, flush=True)
        except queue.Empty:
            pass
        except BaseException as e:
            failures.append(e)

    (ROOT / "out").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="mutants-", dir=ROOT / "out") as folder:
        threads = [threading.Thread(target=work, args=(Path(folder) / str(n),)) for n in range(WORKERS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]
    return results


def read_argued(path: Path = SURVIVORS) -> dict[Key, str]:
    """Survivors that may, and why."""
    entries = tomllib.loads(path.read_text()).get("survivor", [])
    return {(e["file"], e["line"], e["mutant"], e.get("nth", 1)): e["reason"] for e in entries}


def entry(result: Result) -> str:
    """As the list has it, the reason left open."""
    before, after, nth = result.mutation.key
    lines = [f"file = '{result.part.source}'", f"line = '{before}'", f"mutant = '{after}'"]
    return "\n".join(["[[survivor]]", *lines, *([f"nth = {nth}"] if nth > 1 else []), 'reason = ""'])


def table(results: list[Result]) -> str:
    """A row a file: how many of each verdict."""
    counts = Counter((result.part.source, result.verdict) for result in results)
    sources = dict.fromkeys(result.part.source for result in results)
    width = max(len(source) for source in sources)
    rows = [" " * width + "".join(f"{verdict:>16}" for verdict in VERDICTS)]
    rows += [f"{s:{width}}" + "".join(f"{counts[s, v]:16}" for v in VERDICTS) for s in sources]
    return "\n".join(rows)


def complaints(results: list[Result], argued: dict[Key, str]) -> list[str]:
    """Survivors nobody argued for, and arguments for what does not survive."""
    survivors = {result.key: result for result in results if result.verdict == "survived"}
    sources = {result.part.source for result in results}
    found = [
        f"survived, at line {r.mutation.line}:\n{entry(r)}" for k, r in survivors.items() if k not in argued
    ]
    gone = [key for key in argued if key[0] in sources and key not in survivors]
    return found + [f"listed, but no survivor: {key[0]}: {key[1]}  =>  {key[2]}" for key in gone]


def main() -> int:
    names = tuple(sys.argv[1:]) or tuple(SAFETY)
    if unknown := set(names) - set(SAFETY):
        sys.exit(f"mutants: no such file: {', '.join(sorted(unknown))}; there are {', '.join(SAFETY)}")
    results = run(names)
    order = {part.source: n for n, part in enumerate(p for name in names for p in SAFETY[name])}
    results.sort(key=lambda result: (order[result.part.source], result.mutation.line))
    found = complaints(results, read_argued())
    print(table(results))
    print("\n\n".join(["", *found]) if found else "every survivor is argued for")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
