"""How slowly hot layers are deposited: the needed age agrees with the map, and the speed factor follows it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

import deposit_reference
from thermal.models import melt_exchange
from thermal.plan import deposit, layer_time
from thermal.plan.materials import MATERIALS
from thermal.plan.planner import Piece, PlanOptions, TemperaturePlan

ABS = MATERIALS["ABS"]
AROUND = deposit.Surroundings(bed_c=100.0, chamber_c=40.0)
INTERFACE_C = 150.0


def tower_c(age_s: float, thick_mm: float, filled: float) -> float:
    """What the hundredth layer meets in the map."""
    deposited = deposit_reference.DepositMap(ABS, AROUND)
    met = 0.0
    for n in range(100):
        at = (1.0, 1.0, thick_mm * (n + 1))
        melt_c, length_mm = ABS.low_c + layer_time.ROOM_C, filled * 4.0 / 0.45
        met = deposited.deposit(at, age_s * n, melt_c, thick_mm, 100.0 * n, 0.45, length_mm)
    return met


@pytest.mark.parametrize(("thick_mm", "filled"), [(0.15, 0.225), (0.2, 0.225), (0.2, 1.0), (0.3, 0.5)])
def test_a_tower_deposited_at_the_needed_age_is_as_warm_as_the_weld_bears(
    thick_mm: float, filled: float
) -> None:
    """Never hotter, and no more than 15 degC cooler: the balance takes the stack as a fin without layers, which loses
    less than the map's, so it errs to the slow side.
    """
    side = 2.0 * (1.0 - filled) / 0.45
    place = layer_time.Place(100 * thick_mm, thick_mm, 0.0, side)
    age_s = layer_time.needed_age_s(ABS, AROUND, place, INTERFACE_C)
    goal_c = 2.0 * INTERFACE_C - ABS.low_c - layer_time.ROOM_C
    assert goal_c - 15.0 < tower_c(age_s, thick_mm, filled) < goal_c + 3.0
    assert tower_c(0.4 * age_s, thick_mm, filled) > goal_c + 12.0  # quicker is too hot


def test_nothing_is_waited_for_that_waiting_does_not_bring() -> None:
    """Near a hot bed the goal is never below the bed's own surroundings: the age stays finite and short enough."""
    place = layer_time.Place(0.4, 0.2, 0.0)
    assert layer_time.needed_age_s(ABS, AROUND, place, 120.0) < 100.0
    assert (
        layer_time.needed_age_s(ABS, AROUND, place, 400.0) == 0.0
    )  # a weld that wants more than the coolest melt


def test_the_speed_fits_the_extrusion_into_what_travel_leaves_of_the_age() -> None:
    ages = layer_time.Ages(100.0, 100.0 * 3.0, 100.0 * 2.0, 100.0 * 2.0)  # 2 s of extrusion, 1 s of travel
    found = layer_time.next_speed(layer_time.LayerSpeed(), ages, 6.0, 0.1, 0.0)
    assert found == layer_time.LayerSpeed(pytest.approx(2.0 / 5.0), 0.0)
    slow = layer_time.Ages(100.0, 100.0 * 6.0, 100.0 * 5.0, 100.0 * 2.0)  # that layer, deposited so
    assert layer_time.next_speed(found, slow, 6.0, 0.1, 0.0) == found
    assert (
        layer_time.next_speed(found, slow, 2.5, 0.1, 0.0) == layer_time.LayerSpeed()
    )  # a wide layer: full speed again


def test_what_is_missing_at_the_slowest_speed_is_waited_for() -> None:
    ages = layer_time.Ages(100.0, 100.0 * 2.0, 100.0 * 2.0, 100.0 * 2.0)
    found = layer_time.next_speed(layer_time.LayerSpeed(), ages, 10.0, 0.5, 60.0)
    assert found == layer_time.LayerSpeed(0.5, pytest.approx(6.0))
    waited = layer_time.Ages(100.0, 100.0 * 10.0, 100.0 * 4.0, 100.0 * 2.0)  # the pause is no travel
    assert layer_time.next_speed(found, waited, 10.0, 0.5, 60.0) == layer_time.LayerSpeed(
        0.5, pytest.approx(6.0)
    )
    assert layer_time.next_speed(layer_time.LayerSpeed(), ages, 10.0, 0.5, 1.5).pause_s == 1.5


def test_the_plan_counts_ages_of_what_lies_below_only() -> None:
    plan = TemperaturePlan(melt_exchange.NozzleLimits(), ABS, AROUND, PlanOptions(interface_c=INTERFACE_C))

    def side(layer: int, start_s: float, request_c: float = math.nan, speed: float = 1.0) -> Piece:
        z = 0.2 * (layer + 1)
        return Piece(
            start_s, start_s + 1.0, (1.0, 1.0, z), (21.0, 1.0, z), 4.0, 0.2, 0.0, request_c, 240.0, speed
        )

    plan.add([side(0, 0.0)])
    assert plan.ages().above_mm == 0.0  # on the bed
    plan.add([side(1, 4.0, speed=0.5)])
    ages = plan.ages()
    assert ages.above_mm == pytest.approx(20.0)
    assert ages.age_s / 20.0 == pytest.approx(4.0) and ages.depositing_s / 20.0 == pytest.approx(1.0)
    assert ages.full_speed_s / 20.0 == pytest.approx(0.75)  # half of it deposited at half the speed
    plan.add([side(2, 8.0, request_c=230.0), side(9, 9.0)])
    assert plan.ages() == ages  # asked for by name; and nothing right below


PLA, COOL = MATERIALS["PLA"], deposit.Surroundings()
FOUND = PlanOptions(interface_c=75.0, follow_mm=60000.0)  # the print has to find what it holds


def rings_s(options: PlanOptions, layers: int) -> tuple[float, TemperaturePlan]:
    """(Seconds that rings of 12 mm radius take, three beside each other in each layer, slowed; their plan)."""
    plan = TemperaturePlan(melt_exchange.NozzleLimits(), PLA, COOL, options)
    speeds, now_s = layer_time.LayerSpeeds(0.2, 0.0), 0.0
    for layer in range(layers):
        z_mm = 0.25 * (layer + 1)
        place = layer_time.Place(z_mm, 0.25, 0.0)
        factor = speeds.layer(plan.ages(), plan.speed_interface_c, PLA, COOL, place).factor
        for radius_mm in (12.0, 11.55, 11.1):
            corners = [
                (60.0 + radius_mm * math.cos(0.3 * i), 60.0 + radius_mm * math.sin(0.3 * i), z_mm)
                for i in range(22)
            ]
            for start, end in itertools.pairwise(corners):
                end_s = now_s + math.dist(start, end) / (40.0 * factor)
                flow = 40.0 * factor * 0.45 * 0.25
                plan.add([Piece(now_s, end_s, start, end, flow, 0.25, 0.0, math.nan, 215.0, factor)])
                now_s = end_s
    return now_s, plan


def test_a_small_part_is_not_slowed_down_for_what_only_a_tall_one_would_need() -> None:
    """12 layers, 3 mm: the interface is a first guess of what comes far above the bed (129 degC); the true one is 142.
    A print that has to find it takes little longer than one that is given it. Without the bed's allowance it would be
    twice as long. What is slowed down is counted."""
    own_s = rings_s(replace(FOUND, interface_c=None), 12)[0]
    sent_s = rings_s(replace(FOUND, interface_c=142.0, follow_mm=0.0), 12)[0]
    found_s, plan = rings_s(FOUND, 12)
    assert own_s < sent_s < found_s < 1.3 * sent_s
    assert plan.summary().slowed_s == pytest.approx(found_s - own_s, abs=0.01)


def test_away_from_the_bed_the_speed_is_that_of_the_interface_which_is_held() -> None:
    near, far = rings_s(FOUND, 2)[1], rings_s(FOUND, 60)[1]  # 0.5 mm and 15 mm
    assert near.speed_interface_c > near.interface_c + 10.0
    assert (
        near.speed_interface_c <= near.summary().band_c[1]
    )  # what the hottest melt can hold on the coldest path
    assert far.speed_interface_c == pytest.approx(far.interface_c, abs=0.2)
    given = rings_s(replace(FOUND, interface_c=135.0, follow_mm=0.0), 2)[1]
    assert given.speed_interface_c == given.interface_c == 135.0  # a user's own value has no allowance
