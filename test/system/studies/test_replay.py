"""Recorded runs: a print, a fault, and the same decided again by scripts/replay.py."""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from conftest import ROOT, Run, Simulate
from simulation import replay
from thermal.recording import plain, rerun, stored

HEAT = "M104 S220\nTEMPERATURE_WAIT SENSOR=extruder MINIMUM=219\nG4 P500\nM104 S0\nG4 P300\n"
WHOLE = "induction_heater nozzle.record_file=whole.run"


def heat_up(simulate: Simulate, *settings: str, gcode: str = HEAT) -> tuple[Run, Path]:
    run = simulate(gcode, settings=settings)
    return run, run.log.parent


def decide_again(*arguments: Path | str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "replay.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("control", ["model", "pid", "watermark"])
def test_a_recorded_print_is_decided_again_bit_for_bit(simulate: Simulate, control: str) -> None:
    run, folder = heat_up(simulate, WHOLE, f"induction_heater nozzle.control={control}")
    assert run.status == 0, run.stderr
    again = decide_again(folder / "whole.run", "--plot", folder, "--json", folder / "figures.json")
    assert again.returncode == 0, again.stdout + again.stderr
    figures = json.loads((folder / "figures.json").read_text())["whole"]
    assert figures["answers"] > 300 and figures["commands"] > 50 and figures["highest_c"] > 215.0
    assert (folder / "whole.png").stat().st_size > 5000


def test_another_law_shows_as_what_moved(simulate: Simulate) -> None:
    _, folder = heat_up(simulate, WHOLE)
    frames = list(stored.read(folder / "whole.run"))
    header = frames[0].json()
    header["parameters"]["loss"]["conductance_w_k"] *= 1.2
    header["parameters"]["control"]["parameters"]["disturbance_w"] *= 5.0
    changed = folder / "changed.run"
    with changed.open("wb") as stream:
        writer = stored.Writer(stream)
        writer.write(stored.json_frame("H", header))
        for frame in frames[1:]:
            if frame.kind != "P":
                writer.write(stored.packed(frame.kind, frame.payload))
        writer.close()
    again = decide_again(changed)
    assert again.returncode == 1
    run, _ = replay.replayed(changed)
    assert 0.01 < run.figures()["power_max_w"] < 40.0


def test_a_fault_leaves_the_seconds_before_it_and_is_found_again(simulate: Simulate) -> None:
    weak, kept = "simulator nozzle nozzle.efficiency_factor=0.02", "induction_heater nozzle.record_seconds=20"
    run, folder = heat_up(simulate, weak, kept)
    assert run.status == 3
    file = folder / "induction-nozzle-fault.run"
    again = decide_again(file)
    assert again.returncode == 0, again.stdout + again.stderr
    found, _ = replay.replayed(file)
    assert found.fault[0] and found.fault[0] == found.fault[1] and found.fault[0] in run.stderr
    assert found.fault_s[0] == found.fault_s[1]


def test_the_guard_of_the_mcu_judges_the_recorded_blocks(simulate: Simulate) -> None:
    """A table whose limit lies below 220 degC trips on the blocks of a print that the real one let pass."""
    _, folder = heat_up(simulate, WHOLE)
    frames = list(stored.read(folder / "whole.run"))
    _, guard = replay.replayed(folder / "whole.run")
    assert not guard.trip
    strict = replay.Guard({**frames[0].json(), "guard": [[2012, 216, 380]]})
    for frame in frames:
        if frame.kind == "b":
            strict.take(rerun.blocks_of(frame.payload[8:]))
    assert strict.trip == "too high" and strict.trip_s > 1.0


def test_a_simulated_print_keeps_nothing_unless_asked(simulate: Simulate) -> None:
    run, folder = heat_up(simulate, "simulator nozzle nozzle.fault=1")
    assert run.status == 3 and not list(folder.glob("*.run"))


def test_a_record_by_command_goes_on_for_its_time_and_a_second_one_waits(simulate: Simulate) -> None:
    _, folder = heat_up(simulate, gcode="INDUCTION_RECORD FILE=hand.run DURATION=1\n" + HEAT)
    found, _ = replay.replayed(folder / "hand.run")
    assert found.is_same() and 0.9 < found.again[-1].now_s - found.again[0].now_s < 1.3
    run, _ = heat_up(simulate, gcode="INDUCTION_RECORD\nINDUCTION_RECORD\n")
    assert "is being written already" in run.log.read_text()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"G28\nG1 X0\n", "no recorded run"),
        (b"", "no recorded run"),
        (stored.MAGIC + b"rubbish", "damaged"),
        (stored.MAGIC + zlib.compress(stored.packed("t", bytes(8))), "has no header"),
        (stored.MAGIC + zlib.compress(b"H\xff\xff\xff\x7f"), "damaged"),
    ],
)
def test_what_is_no_run_is_refused_in_a_line(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "some.run"
    file.write_bytes(content)
    again = decide_again(file)
    assert again.returncode == 2 and said in again.stderr and "Traceback" not in again.stderr


def test_a_file_that_breaks_off_is_read_up_to_there(simulate: Simulate) -> None:
    _, folder = heat_up(simulate, WHOLE)
    data = (folder / "whole.run").read_bytes()
    (folder / "half.run").write_bytes(data[: len(data) // 2])
    whole, _ = replay.replayed(folder / "whole.run")
    half, _ = replay.replayed(folder / "half.run")
    assert half.is_same() and 0.2 < len(half.again) / len(whole.again) < 0.8


def test_a_run_of_another_version_keeps_defaults_for_what_it_does_not_know(simulate: Simulate) -> None:
    _, folder = heat_up(simulate, WHOLE)
    parameters = next(iter(stored.read(folder / "whole.run"))).json()["parameters"]
    parameters["supervise"]["from_the_future"] = 3.0
    del parameters["supervise"]["silence_s"]
    assert plain.restored(parameters).supervise.silence_s == 1.0
    with pytest.raises(plain.UnknownType, match="no such law"):
        plain.restored({"law": "no such law"})
