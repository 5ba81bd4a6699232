"""The plan in C does what its readable Python reference does, within its limits, at a bounded size."""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "klippy"))

from tempplan import Craft, Piece, TemperaturePlan
from thermal import deposit, nozzle_melt
from thermal.materials import MATERIALS
from thermal.plan import Planner, PlanPoint, wall_wanted
from thermal.records import FlowSegment

ABS = MATERIALS["ABS"]
LIMITS = nozzle_melt.NozzleLimits()
AROUND = deposit.Surroundings(bed_c=100.0, chamber_c=40.0)
BASE_C = 240.0


def line(start_s, duration_s, x0, y0, x1, y1, z=0.2, flow=4.0, wish=math.nan, base=BASE_C, fan=0.0):
    return Piece(start_s, start_s + duration_s, (x0, y0, z), (x1, y1, z), flow, 0.2, fan, wish, base)


ROWS = st.lists(
    st.tuples(
        st.floats(0.01, 2.0),  # duration s
        st.sampled_from([0.0, 0.0, 0.7]),  # gap before it, s
        st.floats(0.0, 30.0),  # flow
        st.floats(-50.0, 900.0) | st.just(math.nan),  # wanted melt, also absurd
        st.floats(0.0, 60.0),  # where to
        st.floats(0.0, 60.0),
    ),
    min_size=1,
    max_size=25,
)


def pieces_of(rows):
    now_s, x, y, pieces = 10.0, 0.0, 0.0, []
    for number, (duration_s, gap_s, flow, wish, x1, y1) in enumerate(rows):
        now_s += gap_s
        pieces.append(line(now_s, duration_s, x, y, x1, y1, 0.2 + 0.2 * (number // 6), flow, wish))
        now_s, x, y = now_s + duration_s, x1, y1
    return pieces


@settings(max_examples=150, deadline=None)
@given(ROWS, st.floats(170.0, 300.0), st.sampled_from([15.0, 30.0, 65.0]))
def test_the_ramps_are_those_of_the_reference(rows, start_c, power_w):
    """Same sums in the same order; 1e-6 degC leaves room for the compiler's exp."""
    limits = nozzle_melt.NozzleLimits(power_w=power_w)
    planner = Planner(limits)
    start_c = min(start_c, planner.ceiling_c)
    pieces = pieces_of(rows)
    plan = TemperaturePlan(limits, ABS, AROUND, Craft())
    wanted = plan.add(pieces)
    got = plan.make(pieces[0].start_s, start_c)
    melts = [
        melt if piece.flow_mm3_s > 0.0 else math.nan
        for piece, (_, melt, _) in zip(pieces, wanted, strict=True)
    ]
    segments = [FlowSegment(p.start_s, p.end_s, p.flow_mm3_s, 1.0) for p in pieces]
    walls = planner._walls(segments, melts, start_c)
    first = next((i for i, p in enumerate(pieces) if p.flow_mm3_s > 0.0), len(pieces))
    for i in range(first, len(pieces)):
        assert wanted[i][2] == pytest.approx(walls[i], abs=1e-9)
    if first:  # before the first extrusion the plan in C goes to the user's target, the reference stays
        return
    expected = planner.plan(segments, melts, start_c)
    assert len(got) == len(expected)
    for a, b in zip(got, expected, strict=True):
        assert a == pytest.approx(tuple(b), abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(ROWS)
def test_the_map_is_that_of_the_reference(rows):
    pieces = pieces_of(rows)
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=150.0))
    wanted = plan.add(pieces)
    laid = deposit.DepositMap(ABS, AROUND)
    odometer_mm = 0.0
    for piece, (substrate_c, melt_c, _) in zip(pieces, wanted, strict=True):
        length = math.dist(piece.start_mm[:2], piece.end_mm[:2])
        count = max(1, math.ceil(length / 2.0))
        if piece.flow_mm3_s <= 0.0:
            odometer_mm += length
            continue
        speed = length / (piece.end_s - piece.start_s)
        width = min(5.0, max(0.1, piece.flow_mm3_s / max(speed * 0.2, 1e-9)))
        met = []
        for i in range(count):
            along = (i + 0.5) / count
            at = tuple(a + along * (b - a) for a, b in zip(piece.start_mm, piece.end_mm, strict=True))
            time_s = piece.start_s + along * (piece.end_s - piece.start_s)
            odometer_mm += length / count
            met.append(laid.lay(at, time_s, melt_c, 0.2, odometer_mm, width, length / count))
        assert substrate_c == pytest.approx(sum(met) / count, abs=1e-6)
    assert plan.sizes()[0] == len(laid)


def test_a_cold_substrate_asks_for_a_hotter_melt_within_the_window():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=160.0))
    ((substrate_c, melt_c, _),) = plan.add([line(0.0, 0.5, 0, 0, 20, 0)])
    assert substrate_c == 100.0 and melt_c == pytest.approx(2 * 160.0 - 100.0)
    ((_, cooler_c, _),) = plan.add([line(0.5, 0.5, 20, 0.4, 0, 0.4)])  # beside the fresh road
    assert ABS.low_c <= cooler_c < melt_c
    hot = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=250.0))
    ((_, clamped_c, _),) = hot.add([line(0.0, 0.5, 0, 0, 20, 0)])
    assert clamped_c == ABS.high_c


def test_what_is_asked_for_by_name_wins_over_the_weld():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=160.0))
    ((_, melt_c, wall_c),) = plan.add([line(0.0, 0.5, 0, 0, 20, 0, wish=233.0)])
    assert melt_c == 233.0
    assert wall_c == pytest.approx(wall_wanted(LIMITS, 300.0, 233.0, 4.0))


def test_the_core_of_a_fast_filament_asks_for_a_hotter_wall():
    slow_flow, fast_flow = 1.0, 12.0
    limits = nozzle_melt.NozzleLimits(max_c=500.0)
    plan = TemperaturePlan(limits, ABS, AROUND, Craft(core=True, zone_mm=20.0))
    (_, _, slow_c), (_, _, fast_c) = plan.add(
        [
            line(0.0, 0.5, 0, 0, 2, 0, flow=slow_flow, wish=220.0),
            line(0.5, 0.5, 9, 9, 20, 9, flow=fast_flow, wish=220.0),
        ]
    )
    from thermal.filament_heat import wall_for_core

    radius_m = 0.875e-3
    feed_m_s = fast_flow * 1e-9 / (math.pi * radius_m**2)
    core_c = wall_for_core(ABS.flow_c, 25.0, feed_m_s, radius_m, 0.020, ABS.diffusivity_m2_s)
    exchange_c = wall_wanted(limits, 500.0, 220.0, fast_flow)
    assert fast_c == pytest.approx(min(500.0, max(core_c, exchange_c)), abs=0.5)  # the table's linear steps
    assert slow_c < fast_c


def test_replanning_in_steps_keeps_what_is_committed_and_every_limit():
    """As the printer does it: moves come in batches, the plan is made anew from a moment that lies ahead."""
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft())
    temp_c, planned = 240.0, {}
    for batch in range(40):
        start_s = 10.0 + 0.25 * batch
        wish = 215.0 if batch // 6 % 2 else 245.0
        plan.add([line(start_s, 0.25, batch, 0, batch + 1, 0, wish=wish)])
        commit_s = max(10.0, start_s - 1.75)
        temp_c = plan.at(commit_s, temp_c)
        points = [PlanPoint(*corner) for corner in plan.make(commit_s, temp_c)]
        assert all(a.time_s <= b.time_s for a, b in itertools.pairwise(points))
        tenths = [t / 10 for t in range(100, int(10 * commit_s) + 1)]
        for t in tenths:
            if t > commit_s - 1.9:
                planned.setdefault(t, plan.at(t, math.nan))
                assert plan.at(t, math.nan) == pytest.approx(planned[t], abs=1e-9)
        plan.finish(commit_s - 0.3)
    assert max(planned.values()) - min(planned.values()) > 15.0
    holder_c = planned[min(planned)]
    for (_, a), (_, b) in itertools.pairwise(sorted(planned.items())):  # 0.1 s each
        middle_c = 0.5 * (a + b)
        holder_k_s = LIMITS.holder_w_k * (middle_c - holder_c) / LIMITS.capacity.at(middle_c)
        # 0.2 K/s: the holder's and the melt's share change by that within a tenth of a second
        assert 10.0 * (b - a) <= nozzle_melt.heating_k_s(LIMITS, middle_c, 4.0) - holder_k_s + 0.2
        assert 10.0 * (b - a) >= -nozzle_melt.cooling_k_s(LIMITS, middle_c, 4.0) - holder_k_s - 0.2
        holder_c += 0.1 / LIMITS.holder_s * (middle_c - holder_c)


def test_a_million_moves_take_no_more_memory_than_their_area():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=150.0))
    for batch in range(200):
        start_s = 50.0 * batch
        plan.add(
            [
                line(
                    start_s + 0.05 * i,
                    0.05,
                    (i % 40) / 2,
                    i // 40,
                    (i % 40 + 1) / 2,
                    i // 40,
                    0.2 + 0.2 * (batch // 2),
                )
                for i in range(1000)
            ]
        )
        plan.make(start_s, 230.0)
        plan.finish(start_s + 49.0)
    columns, held = plan.sizes()
    assert columns <= 11 * 14 and held <= 1040
    books = plan.summary()
    assert books.pieces > 199_000 and books.length_mm == pytest.approx(0.5 * books.pieces)


def test_the_books_compare_with_one_fixed_temperature():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, Craft(interface_c=150.0))
    pieces = []
    for layer in range(30):
        for side in range(4):
            start_s = 20.0 * layer + 0.5 * side
            corners = [(0, 0), (20, 0), (20, 20), (0, 20), (0, 0)]
            pieces.append(line(start_s, 0.5, *corners[side], *corners[side + 1], 0.2 * (layer + 1)))
    plan.add(pieces)
    plan.make(0.0, 240.0)
    rows = plan.finish(1e6, rows=1000)
    assert len(rows) == len(pieces) == plan.summary().pieces
    books = plan.summary()
    assert books.length_mm == pytest.approx(30 * 80.0)
    assert books.spread_c[0] < 0.5 * books.spread_c[1]
    assert all(row.interface_c == pytest.approx(0.5 * (row.melt_c + row.substrate_c)) for row in rows)


def test_a_power_too_small_is_refused():
    with pytest.raises(ValueError, match="holds"):
        TemperaturePlan(nozzle_melt.NozzleLimits(power_w=2.0), ABS, AROUND, Craft())
