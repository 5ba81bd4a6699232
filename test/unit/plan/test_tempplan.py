"""The plan in C does what its readable Python reference does, within its limits, at a bounded size."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import deposit_reference
from thermal.control.control_api import Reference
from thermal.models import filament_heat, melt_exchange
from thermal.plan import deposit, weld
from thermal.plan.materials import MATERIALS
from thermal.plan.planner import Piece, PlanOptions, TemperaturePlan
from thermal.plan.set_points import NODE_S, Planner, PlanPoint, Want, wall_wanted
from thermal.records import FlowSegment

ABS = MATERIALS["ABS"]
LIMITS = melt_exchange.NozzleLimits()
AROUND = deposit.Surroundings(bed_c=100.0, chamber_c=40.0)
BASE_C = 240.0


def line(start_s, duration_s, x0, y0, x1, y1, z=0.2, flow=4.0, request=math.nan, base=BASE_C, fan=0.0):
    return Piece(start_s, start_s + duration_s, (x0, y0, z), (x1, y1, z), flow, 0.2, fan, request, base)


ROWS = st.lists(
    st.tuples(
        st.floats(0.01, 2.0),  # duration s
        st.sampled_from([0.0, 0.0, 0.7]),  # gap before it, s
        st.floats(0.0, 30.0),  # flow
        st.floats(-50.0, 900.0) | st.just(math.nan),  # wanted melt, also absurd
        st.integers(0, 6000).map(lambda v: v / 100),  # where to, hundredths of mm
        st.integers(0, 6000).map(lambda v: v / 100),
    ),
    min_size=1,
    max_size=25,
)


def pieces_of(rows):
    now_s, x, y, pieces = 10.0, 0.0, 0.0, []
    for number, (duration_s, gap_s, flow, request, x1, y1) in enumerate(rows):
        now_s += gap_s
        pieces.append(line(now_s, duration_s, x, y, x1, y1, 0.2 + 0.2 * (number // 6), flow, request))
        now_s, x, y = now_s + duration_s, x1, y1
    return pieces


def both_ramps(rows, start_c, power_w, interface_c):
    """(times, the helper's temperatures, the reference's corners) of the same path."""
    limits = melt_exchange.NozzleLimits(power_w=power_w)
    planner = Planner(limits, (ABS.low_c, ABS.high_c), 0.3)
    start_c = min(start_c, planner.ceiling_c)
    pieces = pieces_of(rows)
    plan = TemperaturePlan(limits, ABS, AROUND, PlanOptions(interface_c=interface_c, smooth_s=0.3))
    added = plan.add(pieces)
    wants = []
    for piece, (substrate_c, melt_c, wall_c) in zip(pieces, added, strict=True):
        free_c = 2.0 * interface_c - substrate_c if interface_c and math.isnan(piece.request_c) else math.nan
        wants.append(Want(melt_c if piece.flow_mm3_s > 0.0 else math.nan, free_c, piece.request_c))
        if piece.flow_mm3_s > 0.0:
            assert wall_c == pytest.approx(
                wall_wanted(limits, planner.ceiling_c, melt_c, piece.flow_mm3_s), abs=1e-9
            )
    segments = [
        FlowSegment(p.start_s, p.end_s, p.flow_mm3_s, math.dist(p.start_mm[:2], p.end_mm[:2])) for p in pieces
    ]
    got = plan.make(pieces[0].start_s, start_c)
    times = np.linspace(pieces[0].start_s, pieces[-1].end_s, 500)
    assert got[0][0] == times[0] and got[-1][0] == pytest.approx(times[-1], abs=1e-9)
    return times, at(times, got), planner.plan(segments, wants, start_c)


@pytest.mark.parametrize("seed", range(40))
def test_the_ramps_are_those_of_the_reference(seed):
    """Same temperatures at every moment. Losses are tables of whole degrees, and a rounding error away lies the next
    entry: of 400 such paths one half differs by less than 0.002 degC, none by more than 0.06."""
    choose = random.Random(seed)
    rows = [
        (
            choose.uniform(0.01, 2.0),
            choose.choice([0.0, 0.0, 0.7]),
            choose.uniform(0.0, 30.0),
            choose.choice([math.nan, choose.uniform(-50.0, 900.0), choose.uniform(200.0, 280.0)]),
            choose.randint(0, 6000) / 100,
            choose.randint(0, 6000) / 100,
        )
        for _ in range(choose.randint(1, 25))
    ]
    power_w, interface_c = choose.choice([15.0, 30.0, 65.0]), choose.choice([None, 130.0, 155.0])
    times, got_c, expected = both_ramps(rows, choose.uniform(170.0, 300.0), power_w, interface_c)
    assert got_c == pytest.approx(at(times, expected), abs=0.1)


@settings(max_examples=150, deadline=None)
@given(
    ROWS, st.floats(170.0, 300.0), st.sampled_from([15.0, 30.0, 65.0]), st.sampled_from([None, 130.0, 155.0])
)
def test_the_ramps_of_any_path_are_those_of_the_reference_to_a_node(rows, start_c, power_w, interface_c):
    """0.3 degC, at that moment or within a node of it: where next to nothing is deposited two climbs cost alike, and a
    rounding error decides which node the path takes."""
    times, got_c, expected = both_ramps(rows, start_c, power_w, interface_c)
    shifts_s = (-NODE_S, -0.5 * NODE_S, 0.0, 0.5 * NODE_S, NODE_S)
    near = np.array([at(times + shift_s, expected) for shift_s in shifts_s])
    assert np.all(got_c <= near.max(axis=0) + 0.3)
    assert np.all(got_c >= near.min(axis=0) - 0.3)


def at(times, corners):
    return np.interp(times, [time_s for time_s, _ in corners], [temp_c for _, temp_c in corners])


@pytest.mark.parametrize("heights_mm", [(), (0.2, 0.4, 0.6, 3.0, 0.4)])  # in the second parts are taken off
@settings(max_examples=100, deadline=None)
@given(rows=ROWS)
def test_the_map_is_that_of_the_reference(heights_mm, rows):
    pieces = pieces_of(rows)
    if heights_mm:
        heights = itertools.cycle(heights_mm)
        pieces = [
            p._replace(start_mm=(*p.start_mm[:2], z), end_mm=(*p.end_mm[:2], z))
            for p, z in zip(pieces, heights, strict=False)
        ]
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=150.0))
    wanted = plan.add(pieces)
    deposited = deposit_reference.DepositMap(ABS, AROUND)
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
            met.append(deposited.deposit(at, time_s, melt_c, 0.2, odometer_mm, width, length / count))
        assert substrate_c == pytest.approx(sum(met) / count, abs=1e-6)
    assert plan.sizes()[0] == len(deposited)


def test_a_cold_substrate_asks_for_a_hotter_melt_within_the_window():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=160.0))
    ((substrate_c, melt_c, _),) = plan.add([line(0.0, 0.5, 0, 0, 20, 0)])
    assert substrate_c == 100.0 and melt_c == pytest.approx(2 * 160.0 - 100.0)
    ((_, cooler_c, _),) = plan.add([line(0.5, 0.5, 20, 0.4, 0, 0.4)])  # beside the fresh road
    assert ABS.low_c <= cooler_c < melt_c
    hot = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=250.0))
    ((_, clamped_c, _),) = hot.add([line(0.0, 0.5, 0, 0, 20, 0)])
    assert clamped_c == ABS.high_c


def test_what_is_asked_for_by_name_wins_over_the_weld():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=160.0))
    ((_, melt_c, wall_c),) = plan.add([line(0.0, 0.5, 0, 0, 20, 0, request=233.0)])
    assert melt_c == 233.0
    assert wall_c == pytest.approx(wall_wanted(LIMITS, 300.0, 233.0, 4.0))


def test_the_core_of_a_fast_filament_asks_for_a_hotter_wall():
    slow_flow, fast_flow = 1.0, 12.0
    limits = melt_exchange.NozzleLimits(max_c=500.0)
    plan = TemperaturePlan(limits, ABS, AROUND, PlanOptions(core=True, zone_mm=20.0))
    (_, _, slow_c), (_, _, fast_c) = plan.add(
        [
            line(0.0, 0.5, 0, 0, 2, 0, flow=slow_flow, request=220.0),
            line(0.5, 0.5, 9, 9, 20, 9, flow=fast_flow, request=220.0),
        ]
    )
    radius_m = 0.875e-3
    feed_m_s = fast_flow * 1e-9 / (math.pi * radius_m**2)
    fourier = ABS.diffusivity_m2_s * 0.020 / (feed_m_s * radius_m**2)
    core_c = 25.0 + (ABS.flow_c - 25.0) / filament_heat.core_fraction(fourier)
    exchange_c = wall_wanted(limits, 500.0, 220.0, fast_flow)
    assert fast_c == pytest.approx(min(500.0, max(core_c, exchange_c)), abs=0.5)  # the table's linear steps
    assert slow_c < fast_c


def test_replanning_in_steps_keeps_what_is_committed_and_every_limit():
    """As the printer does it: moves come in batches, the plan is made anew from a moment that lies ahead."""
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions())
    temp_c, planned = 240.0, {}
    for batch in range(40):
        start_s = 10.0 + 0.25 * batch
        request = 215.0 if batch // 6 % 2 else 245.0
        plan.add([line(start_s, 0.25, batch, 0, batch + 1, 0, request=request)])
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
        assert 10.0 * (b - a) <= melt_exchange.heating_k_s(LIMITS, middle_c, 4.0) - holder_k_s + 0.2
        assert 10.0 * (b - a) >= -melt_exchange.cooling_k_s(LIMITS, middle_c, 4.0) - holder_k_s - 0.2
        holder_c += 0.1 / LIMITS.holder_s * (middle_c - holder_c)


def test_a_million_moves_take_no_more_memory_than_their_area():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=150.0))
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
    totals = plan.summary()
    assert totals.pieces > 199_000 and totals.length_mm == pytest.approx(0.5 * totals.pieces)


def test_the_totals_compare_with_one_fixed_temperature():
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=150.0))
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
    totals = plan.summary()
    assert totals.length_mm == pytest.approx(30 * 80.0)
    assert totals.spread_c[0] < 0.5 * totals.spread_c[1]
    assert all(row.interface_c == pytest.approx(0.5 * (row.melt_c + row.substrate_c)) for row in rows)


def test_the_held_interface_is_what_the_window_reaches_on_both_ends_of_the_path():
    assert weld.held_c(150.0, (140.0, 160.0), 130.0) == 150.0  # the user's own
    assert weld.held_c(135.0, (140.0, 160.0), 130.0) == 140.0
    assert weld.held_c(170.0, (140.0, 160.0), 130.0) == 160.0
    assert weld.held_c(150.0, (180.0, 164.0), 130.0) == 172.0  # too narrow: the middle
    assert weld.held_c(150.0, (100.0, 120.0), 130.0) == 130.0  # never below what bonds
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=130.0, follow_mm=60000.0))
    plan.add([line(0.5 * i, 0.5, 0, 4 * i, 20, 4 * i) for i in range(40)])  # all of it on the bed of 100 degC
    band_c = plan.summary().band_c
    assert band_c == pytest.approx((0.5 * (ABS.low_c + 100.0), 0.5 * (ABS.high_c + 100.0)), abs=0.5)
    melt_c = 25.0 + (BASE_C - 25.0) * LIMITS.exchange.share(4.0)
    guess_c = 0.5 * (melt_c + 40.0 + 0.1 * (melt_c - 40.0))  # on a layer's rest over the chamber of 40 degC
    assert guess_c - 0.5 < plan.interface_c < guess_c + 5.0  # and a little of the bed below


def test_a_power_too_small_is_refused():
    with pytest.raises(ValueError, match="holds"):
        TemperaturePlan(melt_exchange.NozzleLimits(power_w=2.0), ABS, AROUND, PlanOptions())


@settings(max_examples=60, deadline=None)
@given(ROWS, st.floats(170.0, 290.0), st.sampled_from([0.005, 0.02, 1.0]))
def test_a_thinned_plan_stays_near_the_plan_and_is_nowhere_steeper(rows, start_c, within_c):
    pieces = pieces_of(rows)
    plans = [TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions(interface_c=150.0)) for _ in range(2)]
    for plan in plans:
        plan.add(pieces)
    whole = Reference.of(plans[0].make(pieces[0].start_s, start_c))
    thinned = plans[1].ahead(pieces[0].start_s, start_c, within_c)
    assert thinned is not None and set(thinned.times_s) <= set(whole.times_s)
    assert (thinned.times_s[0], thinned.times_s[-1]) == (whole.times_s[0], whole.times_s[-1])
    for time_s, temp_c in zip(whole.times_s, whole.temps_c, strict=True):
        assert thinned.at(time_s) == pytest.approx(temp_c, abs=within_c + 1e-9)
    corners = list(zip(whole.times_s, whole.temps_c, strict=True))
    for (t0, a), (t1, b) in itertools.pairwise(zip(thinned.times_s, thinned.temps_c, strict=True)):
        passed = [
            (d - c) / (u - t) for (t, c), (u, d) in itertools.pairwise(corners) if u > t and u > t0 and t < t1
        ]
        assert t1 == t0 or min(passed) - 1e-6 <= (b - a) / (t1 - t0) <= max(passed) + 1e-6


def test_a_plan_from_nowhere_is_none():
    """As of a nozzle that has not been led to where it begins."""
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions())
    plan.add([line(10.0, 1.0, 0, 0, 20, 0, request=240.0)])
    assert plan.ahead(10.0, math.nan, 0.02) is None
    assert plan.ahead(10.0, 240.0, 0.02) is not None


def test_the_way_home_is_part_of_what_was_planned():
    """A plan that begins again after it starts from there, and its holder has been there."""
    plan = TemperaturePlan(LIMITS, ABS, AROUND, PlanOptions())
    plan.add([line(10.0, 1.0, 0, 0, 20, 0, request=240.0)])
    plan.make(10.0, 240.0)
    plan.finish(12.0)
    warm_c = plan.holder_c(12.0, 240.0)
    way = melt_exchange.idle_way(LIMITS, 12.0, plan.at(12.0, 240.0), warm_c, 200.0)
    plan.lead(way)
    assert plan.at(way[-1][0] + 30.0, 0.0) == 200.0
    for (t0, a), (t1, b) in itertools.pairwise(
        way
    ):  # no quicker than losses allow, and a holder that stays behind
        held_k_s = LIMITS.holder_w_k * max(0.0, a - warm_c) / LIMITS.capacity.at(a)
        assert 0.0 < (a - b) / (t1 - t0) <= melt_exchange.cooling_k_s(LIMITS, a, 0.0) + held_k_s
    assert way[-1][0] - 12.0 > (240.0 - 200.0) / melt_exchange.cooling_k_s(LIMITS, 240.0, 0.0)
    plan.add([line(way[-1][0] + 5.0, 1.0, 20, 0, 40, 0, request=230.0)])
    again = plan.make(way[-1][0] + 4.0, 200.0)
    assert all(
        temp_c == pytest.approx(200.0, abs=1e-6) for time_s, temp_c in again if time_s <= way[-1][0] + 4.0
    )
    cooled_c = plan.holder_c(way[-1][0] + 4.0, 200.0)
    assert 200.0 < cooled_c < warm_c
