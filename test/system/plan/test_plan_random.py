"""Random G-code through the whole host: what the plan requests is always possible and always allowed.

`FERRITE_PLAN_SEEDS=200 pytest test/system/plan/test_plan_random.py` is the long soak (about 2 s a seed).
"""

from __future__ import annotations

import csv
import itertools
import math
import os
import random
from bisect import bisect_right
from pathlib import Path

import numpy as np
import pytest

from extras.temperature_plan import nozzle_limits
from plan_gcode import Writer
from plan_rig import Road, Watched, watch
from system.conftest import machine
from thermal.control.control_api import Reference
from thermal.models import melt_exchange

SEEDS = int(os.environ.get("FERRITE_PLAN_SEEDS", "4"))
THINGS = 45
MELT_C = (190.0, 240.0)  # of the config below
MORE = """
[gcode_arcs]
[exclude_object]
[pause_resume]
[delayed_gcode later]
gcode:
  RESUME
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
  BASE_PAUSE
  UPDATE_DELAYED_GCODE ID=later DURATION=4
"""
SECTION = """
[temperature_plan]
material: PLA
melt_min: 190
melt_max: 240
max_layer_pause: 0.5
features:
  external perimeter: 205
objects:
  CUBE: 235
layers:
  3-4: 222
"""
# The plan's limits may differ by this from those computed here. The plan takes its holder (10 s) at the planned
# temperature, here it is at the heater's reference; 14 degC of that are 1 K/s.
SLACK_K_S = 1.0
GRID_S = 0.05
JUMP_C = 0.05  # corners within 0.02 degC of a line are left out of both references


def printed(tmp_path: Path, body: str, section: str, wire: bool = False) -> Watched:
    config, gcode = machine(tmp_path, section + MORE), tmp_path / "part.gcode"
    gcode.write_text(body, encoding="utf-8")
    watched = watch(config, gcode, wire=wire)
    outcome = watched.outcome
    assert outcome is not None and outcome.status == 0, outcome
    assert outcome.reason == "printed to its end" and not outcome.summary["faults"], outcome
    assert not watched.tracebacks
    return watched


def check_ranges(watched: Watched, limits: melt_exchange.NozzleLimits) -> None:
    """Each reference by itself: in order of time, within the limits of an extruding nozzle and the user's targets."""
    targets = [
        entry.corners[0][1] for entry in watched.emitted if entry.by_user and entry.corners[0][1] > 0.0
    ]
    low_c = min(limits.min_extrude_c, *targets)
    high_c = max(melt_exchange.highest_c(limits), *targets)
    for entry in watched.emitted:
        if not entry.by_user:
            times, temps = zip(*entry.corners, strict=True)
            assert list(times) == sorted(times) and all(map(math.isfinite, (*times, *temps)))
            assert low_c - 1e-6 <= min(temps) <= max(temps) <= high_c + 1e-6


def max_flow(roads: list[Road], ends: list[float], from_s: float, to_s: float) -> float:
    """Greatest flow within this time."""
    at, found = bisect_right(ends, from_s), 0.0
    while at < len(roads) and roads[at].start_s < to_s:
        found = max(found, roads[at].flow_mm3_s)
        at += 1
    return found


def check_slopes(watched: Watched, limits: melt_exchange.NozzleLimits) -> int:
    """What the heater was asked to follow, from reference to reference; returns the places looked at."""
    roads = watched.roads
    ends, looked = [road.end_s for road in roads], 0
    holder_c, before_c = math.nan, math.nan
    last_s = watched.emitted[-1].now_s + 1.0
    for entry, until_s in zip(
        watched.emitted, [*(later.now_s for later in watched.emitted[1:]), last_s], strict=True
    ):
        asked = Reference.of(entry.corners)
        if not entry.by_user and not math.isnan(before_c):
            assert asked.at(entry.now_s) == pytest.approx(before_c, abs=JUMP_C)
        steps = max(1, math.ceil((until_s - entry.now_s) / GRID_S))
        edges = np.linspace(entry.now_s, until_s, steps + 1)
        for start_s, end_s in itertools.pairwise(map(float, edges)):
            a, b = asked.at(start_s), asked.at(end_s)
            holder_c = a if math.isnan(holder_c) else holder_c
            if not entry.by_user and end_s > start_s:
                looked += 1
                check_step(limits, roads, ends, (start_s, a), (end_s, b), holder_c)
            holder_c += (b - holder_c) * -math.expm1(-(end_s - start_s) / limits.holder_s)
            before_c = b
    return looked


def check_step(
    limits: melt_exchange.NozzleLimits,
    roads: list[Road],
    ends: list[float],
    start: tuple[float, float],
    end: tuple[float, float],
    holder_c: float,
) -> None:
    """No quicker up than the power allows without flow, no quicker down than losses, holder and melt."""
    (start_s, a), (end_s, b) = start, end
    flow = max_flow(roads, ends, start_s - GRID_S, end_s + GRID_S)
    # the rate of the whole step is bounded by that of its end where it is greatest
    cold_c, hot_c = min(a, b), max(a, b)
    held_k_s = limits.holder_w_k / limits.capacity.at(hot_c)
    slope = (b - a) / (end_s - start_s)
    up = melt_exchange.heating_k_s(limits, cold_c, 0.0) - held_k_s * (cold_c - holder_c)
    down = melt_exchange.cooling_k_s(limits, hot_c, flow) + held_k_s * (hot_c - holder_c)
    assert slope <= up + SLACK_K_S, (start_s, a, b, slope, up)
    assert slope >= -down - SLACK_K_S, (start_s, a, b, slope, down, flow)
    if flow > 0.0 and max_flow(roads, ends, start_s, end_s) > 0.0:
        assert cold_c >= limits.min_extrude_c - 1e-6


def check_rows(record: Path) -> int:
    """What was deposited: in order of time, wanted within the material's window."""
    with record.open(newline="") as stream:
        rows = [
            (float(r["start_s"]), float(r["end_s"]), float(r["wanted_melt_c"]))
            for r in csv.DictReader(stream)
        ]
    assert all(a[1] <= b[0] + 1e-9 for a, b in itertools.pairwise(rows))
    assert all(start_s < end_s and MELT_C[0] <= melt_c <= MELT_C[1] for start_s, end_s, melt_c in rows)
    return len(rows)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_file_makes_the_plan_ask_for_what_cannot_or_must_not_be(tmp_path: Path, seed: int) -> None:
    record = tmp_path / "rows.csv"
    body = Writer(random.Random(seed)).write(THINGS)
    watched = printed(tmp_path, body, f"{SECTION}record: {record}\n")
    heater = watched.planner.heater
    limits = nozzle_limits(watched.planner.settings, heater.parameters, heater.min_extrude_c)
    assert all(a.end_s <= b.start_s + 1e-9 for a, b in itertools.pairwise(watched.roads))
    check_ranges(watched, limits)
    places, rows = check_slopes(watched, limits), check_rows(record)
    assert "ENABLE=0" in body or (places > 50 and rows > 20)  # switched off, there may be nothing
    end_c = float(body.rpartition("M104 S")[2].split()[0])
    home = [entry for entry in watched.emitted if entry.corners[-1][1] > 0.0][
        -1
    ]  # then comes the end of the run
    assert home.by_user and home.corners[-1][1] == pytest.approx(end_c, abs=0.1)


@pytest.mark.parametrize("seed", range(100, 100 + max(1, SEEDS // 5)))
def test_a_disabled_plan_sends_the_same_bytes_as_none(tmp_path: Path, seed: int) -> None:
    """Whatever is in the file: also commands of the plan, which a printer without it does not know."""
    body = Writer(random.Random(seed)).write(THINGS // 2).replace("ENABLE=1", "ENABLE=0")
    none, disabled = (
        printed(tmp_path, body, section, wire=True) for section in ("", f"{SECTION}enable: no\n")
    )
    assert none.sent == disabled.sent
    planned = printed(tmp_path, body.replace("ENABLE=0", "ENABLE=1"), SECTION, wire=True)
    assert planned.sent != none.sent  # the comparison can fail
