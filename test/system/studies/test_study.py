"""Studies as a user runs them: tables that do not depend on the workers, kills that lose nothing, wrong files."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
import pytest

from system.conftest import CONFIG, ROOT

PROGRAM = [sys.executable, str(ROOT / "scripts" / "study.py")]
HOLD = "M104 S200\nG4 P3000\n"
LONG = "M104 S200\nG4 P3000000\n"  # fifty minutes: a minute of wall time and more
STUDY = """
config = "{config}"
files = ["{file}"]

[plan]
kind = "{kind}"
runs = 8

[parameters]
"simulator nozzle nozzle.mass_factor" = {{ dist = "uniform", low = 0.8, high = 1.2 }}
"simulator nozzle nozzle.noise_lsb" = {{ scale = "loguniform", low = 0.5, high = 4.0 }}

[figures]
peak_c = "heater.peak_c"
late_c = {{ trace = "true_c", minus = "target_c", take = "max_abs", where = "t_s > 3" }}

[limits]
late_c = {{ max = 3.0 }}
"""
GONE_S = 30.0  # the promise: no process is left after so long
STARTED_S = 60.0


def write_study(folder: Path, gcode: str = HOLD, kind: str = "sobol", old: str = "", new: str = "") -> Path:
    """study.toml with one text replaced by another, and its G-code."""
    (folder / "hold.gcode").write_text(gcode)
    text = STUDY.format(config=CONFIG, file="hold.gcode", kind=kind)
    assert old in text
    path = folder / "study.toml"
    path.write_text(text.replace(old, new) if old else text)
    return path


def without_parameters(path: Path) -> Path:
    """The same study without its distributions: a grid of one point."""
    text = re.sub(r'".*(mass_factor|noise_lsb)".*\n', "", path.read_text()).replace("runs = 8", "")
    path.write_text(text)
    return path


def study(path: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [*PROGRAM, str(path), "--out", str(out), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def start(path: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*PROGRAM, str(path), "--out", str(out), *options], text=True, stderr=subprocess.PIPE
    )


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    end = time.monotonic() + STARTED_S
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"waited {STARTED_S:.0f} s for {what}")


def journal(out: Path) -> list[str]:
    path = out / "journal.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def prints_below(process: psutil.Process) -> list[psutil.Process]:
    try:
        return [
            p for p in process.children(recursive=True) if "simulation.study.child" in " ".join(p.cmdline())
        ]
    except psutil.NoSuchProcess:
        return []


def assert_gone(processes: list[psutil.Process]) -> None:
    _, alive = psutil.wait_procs(processes, timeout=GONE_S)
    assert not [p for p in alive if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the finished study, by two workers of this computer."""
    folder = tmp_path_factory.mktemp("study")
    done = study(write_study(folder), folder / "out", "--workers", "2")
    assert done.returncode == 0, done.stderr
    return folder / "out"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, psutil.Process]]:
    """Address of a scheduler, and the process above its two workers."""
    folder = tmp_path_factory.mktemp("cluster")
    dask, file = Path(sys.executable).with_name("dask"), folder / "scheduler.json"
    log = (folder / "cluster.log").open("w")
    options: dict[str, Any] = {"cwd": ROOT, "stdout": log, "stderr": log}
    scheduler = subprocess.Popen(
        [dask, "scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", file], **options
    )
    workers = None
    try:
        wait_for(lambda: file.exists() and file.read_text().strip(), "the scheduler")
        address = json.loads(file.read_text())["address"]
        command = [dask, "worker", address, "--nworkers", "2", "--nthreads", "1", "--no-dashboard"]
        workers = subprocess.Popen(command, env={"PYTHONPATH": "klippy", "PATH": "/usr/bin:/bin"}, **options)
        yield address, psutil.Process(workers.pid)
    finally:
        below = psutil.Process(workers.pid).children(recursive=True) if workers else []
        for process in (workers, scheduler):
            if process is not None:
                process.terminate()
                process.wait(GONE_S)
        assert_gone(below)
        log.close()


def test_a_study_leaves_one_row_a_print_sorted_by_key_and_a_page(reference: Path) -> None:
    table = pq.read_table(reference / "results.parquet")
    assert table.num_rows == 8
    keys = table.column("key").to_pylist()
    assert keys == sorted(keys)
    assert set(table.column("status").to_pylist()) == {"printed"}
    assert max(table.column("late_c").to_pylist()) <= 3.0
    noise = table.column("simulator nozzle nozzle.noise_lsb").to_pylist()
    assert len(set(noise)) == 8 and min(noise) >= 0.5 and max(noise) <= 4.0  # times the preset's 1 LSB
    page = (reference / "index.html").read_text()
    links = re.findall(r'href="(runs/\w+/report.html)"', page)
    assert "mass_factor</span> = " in page
    assert links and all((reference / link).exists() for link in links)
    assert (reference / "failures.txt").read_text() == ""


def test_a_study_killed_in_the_middle_leaves_no_process_and_continues(
    tmp_path: Path, reference: Path
) -> None:
    """One worker in place of two, in two sittings: the same table, byte for byte."""
    path, out = write_study(tmp_path), tmp_path / "out"
    running = start(path, out, "--workers", "1")
    wait_for(lambda: len(journal(out)) >= 2, "the second print")
    below = psutil.Process(running.pid).children(recursive=True)
    running.send_signal(signal.SIGKILL)
    running.communicate()
    assert_gone(below)
    before = journal(out)
    assert len(before) < 8
    with (out / "journal.jsonl").open("a") as file:
        file.write('{"key": "cut sh')  # as a kill within a write leaves it
    assert study(path, out, "--workers", "1").returncode == 0
    after = journal(out)
    assert after[: len(before)] == before
    assert len({json.loads(line)["key"] for line in after if line.endswith("}")}) == 8 == len(after) - 1
    assert (out / "results.parquet").read_bytes() == (reference / "results.parquet").read_bytes()


def test_a_cluster_that_loses_a_worker_gives_the_same_table(
    tmp_path: Path, reference: Path, cluster: tuple[str, psutil.Process]
) -> None:
    address, workers = cluster
    path, out = write_study(tmp_path), tmp_path / "out"
    running = start(path, out, "--scheduler", address)
    victim = wait_for(lambda: journal(out) and prints_below(workers), "a print on a worker")[0]
    worker = victim.parent()
    assert worker is not None and worker.pid != workers.pid
    worker.kill()
    assert_gone([worker, victim])
    _, errors = running.communicate(timeout=300)
    assert running.returncode == 0, errors
    assert (out / "results.parquet").read_bytes() == (reference / "results.parquet").read_bytes()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_prints_on_a_cluster_end_with_their_study(
    tmp_path: Path, cluster: tuple[str, psutil.Process], how: signal.Signals
) -> None:
    address, workers = cluster
    running = start(write_study(tmp_path, LONG), tmp_path / "out", "--scheduler", address)
    prints = wait_for(lambda: len(prints_below(workers)) == 2 and prints_below(workers), "two prints")
    running.send_signal(how)
    running.communicate(timeout=GONE_S)
    assert running.returncode == (-signal.SIGKILL if how == signal.SIGKILL else 130)
    assert_gone(prints)
    assert not prints_below(workers), "the next tasks start no print"


def test_ctrl_c_ends_a_study_with_one_line(tmp_path: Path) -> None:
    """It reaches the workers, too, as in a terminal; that is no reason for their traces."""
    command = [*PROGRAM, str(write_study(tmp_path, LONG)), "--out", str(tmp_path / "out"), "--workers", "1"]
    running = subprocess.Popen(command, text=True, stderr=subprocess.PIPE, start_new_session=True)
    above = psutil.Process(running.pid)
    # There is a journal after the config has been read, which takes a process like a print's.
    started = tmp_path / "out" / "journal.jsonl"
    wait_for(lambda: started.exists() and prints_below(above), "a print")
    below = above.children(recursive=True)
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=GONE_S)
    assert (running.returncode, errors) == (130, "study: interrupted; the same command continues\n")
    assert_gone(below)
    assert pq.read_table(tmp_path / "out" / "results.parquet").num_rows == 0


def test_failed_prints_are_rows_with_a_command_that_repeats_them(tmp_path: Path) -> None:
    """A signal that is lost shuts the printer down: that limit is not met, the study ends well."""
    faults = '"simulator nozzle nozzle.fault" = [0, 5]\n\n[figures]'
    path = without_parameters(write_study(tmp_path, kind="grid", old="[figures]", new=faults))
    out = tmp_path / "out"
    done = study(path, out, "--workers", "1")
    assert done.returncode == 1, done.stderr
    assert "printed: min 1: NOT MET, 50 % of the prints" in done.stdout
    rows = {
        row["simulator nozzle nozzle.fault"]: row
        for row in pq.read_table(out / "results.parquet").to_pylist()
    }
    assert rows[0.0]["status"] == "printed"
    assert rows[5.0]["status"] == "printer shut down" and "nozzle" in rows[5.0]["reason"]
    command = (out / "failures.txt").read_text().splitlines()[-1].split()
    assert command[-1] == rows[5.0]["key"]
    again = subprocess.run(
        [sys.executable, ROOT / command[0], *command[1:]], check=False, capture_output=True, text=True
    )
    assert again.stdout.startswith(f"printer shut down: {rows[5.0]['reason']}"), again.stderr
    assert (out / "runs" / rows[5.0]["key"] / "host.log").stat().st_size > 0


def test_calibrations_before_the_print_change_the_config_it_runs_on(tmp_path: Path) -> None:
    before = 'before = ["PID_CALIBRATE HEATER=heater_bed TARGET=40 WAIT=1", "SAVE_CONFIG"]\nfiles = '
    path = without_parameters(write_study(tmp_path, kind="grid", old="files = ", new=before))
    shipped = CONFIG.read_bytes()
    done = study(path, tmp_path / "out", "--workers", "1")
    assert done.returncode == 0, done.stderr + done.stdout
    key = json.loads(journal(tmp_path / "out")[0])["key"]
    log = (tmp_path / "out" / "runs" / key / "host.log").read_text()
    gains = [float(text) for text in re.findall(r"^pid_kp = (.*)$", log, re.MULTILINE)]
    assert gains and 60.0 not in gains  # 60 is the config's
    assert CONFIG.read_bytes() == shipped


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass_factor", "mass_facto", "line 10: parameters.\"simulator nozzle nozzle.mass_facto\": section "
         "[simulator nozzle nozzle] has no option 'mass_facto'. Did you mean 'mass_factor' or"),
        ("nozzle nozzle.mass", "nozzle nozle.mass", "has no section [simulator nozzle nozle]. Did you mean"),
        ("high = 1.2", "high = 9.0", "is outside of the range of this parameter, 0.2 to 5."),
        ('"heater.peak_c"', '"heater.peek_c"', "line 14: figures.peak_c: the summary has no 'peek_c' there. Did you"),
        ("true_c", "true", "figures.late_c: the trace has no column 'true'. Did you mean 'true_c'"),
        ("hold.gcode", "held.gcode", "line 3: files: there is no file "),
    ],
)  # fmt: skip
def test_a_name_that_does_not_exist_is_refused_before_anything_prints(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    done = study(write_study(tmp_path, old=old, new=new), tmp_path / "out")
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "out").exists()
