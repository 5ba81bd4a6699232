"""The prints of a study on dask workers: of this computer, or of a cluster.

    jobs ─► a window of tasks ─► scheduler ─► worker: run_task ─► child process, one a print
                 ▲                                  │ ends its print when the task is cancelled
    on_result ◄──┴──────────────────────────────────┘

Only a window of tasks is known to the scheduler, so memory does not grow with the study. Workers of this computer end
with this process: dask's nannies hold a pipe to each, and each print ends with its worker.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import islice
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from .job import CRASHED, Job, WrongWorker
from .studyfile import StudyError

TASKS_A_THREAD = 3  # in the window: one runs, two wait
MIN_WINDOW = 8
RETRIES = 3  # of a print that was killed from outside
CONNECT_S = 20.0


def make_task() -> Callable[[dict[str, Any]], dict[str, Any]]:
    """One print, on a worker. A function within a function goes there by value: the scheduler needs no Ferrite."""

    def run_task(facts: dict[str, Any]) -> dict[str, Any]:
        from distributed import get_worker
        from distributed.worker import thread_state

        from simulation.study.job import Job, execute

        tasks, key = get_worker().state.tasks, thread_state.key
        return execute(Job(**facts), wanted=lambda: key in tasks and tasks[key].state == "executing")

    return run_task


@contextmanager
def connect(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """A client of that scheduler, or of a cluster of this computer that ends with the context."""
    # Workers only wait for processes: nothing to sample a hundred times a second, nothing to measure or to log.
    quiet = {"distributed.worker.profile.enabled": False, "distributed.logging.distributed": "error"}
    with dask.config.set(quiet):
        if scheduler:
            try:
                client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
            except (OSError, ValueError) as e:
                raise StudyError(f"There is no scheduler at {scheduler}: {e}") from None
            with client:
                yield client
            return
        count = workers or os.cpu_count() or 1
        options = {"n_workers": count, "threads_per_worker": 1, "dashboard_address": ":0"}
        # Ctrl-C in a terminal reaches every process of the group: the workers inherit that they ignore it.
        interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            cluster = LocalCluster(silence_logs=logging.CRITICAL, **options)
        finally:
            signal.signal(signal.SIGINT, interrupt)
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client


def run_jobs(client: Client, jobs: Sequence[Job], on_result: Callable[[dict[str, Any]], None]) -> None:
    """All jobs, in any order. Raises StudyError if a worker cannot take part."""
    waiting = iter(jobs)
    running: dict[str, Job] = {}
    task = make_task()

    def submit() -> list[Any]:
        window = max(MIN_WINDOW, TASKS_A_THREAD * sum(client.nthreads().values()))
        futures = []
        for job in islice(waiting, window - len(running)):
            name = f"print-{job.key}"
            running[name] = job
            futures.append(client.submit(task, asdict(job), key=name, retries=RETRIES))
        return futures

    completed = as_completed(submit(), loop=client.loop)
    for future in completed:
        on_result(_result(future, running.pop(future.key)))
        future.release()
        for another in submit():
            completed.add(another)


def _result(future: Any, job: Job) -> dict[str, Any]:
    try:
        result: dict[str, Any] = future.result()
        return result
    except (KilledWorker, InterruptedError):
        row = {"status": CRASHED, "reason": "killed from outside, again and again", "figures": {}}
        return {"key": job.key, "row": row, "seen": {}}
    except WrongWorker as e:
        raise StudyError(f"A worker cannot take part: {e}") from None
    except ModuleNotFoundError as e:
        raise StudyError(f"A worker cannot take part: {e}. Start it with PYTHONPATH=klippy.") from None
    except Exception as e:
        raise StudyError(f"A worker failed ({type(e).__name__}: {e}).") from e
