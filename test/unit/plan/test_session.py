"""One session of the temperature plan without a printer: moves and marks in, references out; time is an argument."""

from __future__ import annotations

import math
from typing import Any

import pytest

from lookahead import LookAheadQueue, Move
from thermal.models.melt_exchange import NozzleLimits
from thermal.plan.deposit import Surroundings
from thermal.plan.materials import MATERIALS
from thermal.plan.planner import PlanOptions
from thermal.plan.requests import Comment, RequestTable
from thermal.plan.session import COMMIT_S, PlanSettings, Session, Turn

TABLE = RequestTable(features={"perimeter": 240.0, "infill": 225.0})
SETTINGS = PlanSettings(
    material=MATERIALS["ABS"],
    surroundings=Surroundings(bed_c=100.0, chamber_c=40.0),
    options=PlanOptions(),
    table=TABLE,
    slowest=0.2,
    longest_pause_s=0.0,
)
ROAD_S = 2.0


class Head:
    """As much of a toolhead as a look-ahead needs. Roads of 40 mm at 20 mm/s to and fro, each on a Y of its own."""

    max_velocity, max_accel, max_accel_to_decel, junction_deviation = 200.0, 3000.0, 1500.0, 0.01
    extra_axes: tuple[Any, ...] = ()
    printer = None

    def __init__(self, session: Session, time_s: float = 10.0) -> None:
        self.session, self.time_s, self.count = session, time_s, 0
        self._queue = LookAheadQueue(self)

    def calc_junction(self, before: Move, move: Move) -> float:
        return move.max_cruise_v2

    def get_max_velocity(self) -> tuple[float, float]:
        return self.max_velocity, self.max_accel

    def roads(self, count: int) -> bool:
        """Plan so many and give them out. True: it is worth another plan."""
        for _ in range(count):
            x, y, z, e = 40.0 * (self.count % 2), 0.45 * (self.count // 2), 0.3, 1.6 * self.count
            self.count += 1
            move = Move(self, (x, y, z, e), (40.0 - x, y, z, e + 1.6), 40.0 / ROAD_S)
            self._queue.add_move(move, self)
        planned = self._queue.plan()
        due = self.session.moves(self._queue.row, planned, self.time_s, 0.0)
        for move in self._queue.take(planned):
            self.time_s += move.accel_t + move.cruise_t + move.decel_t
        return due


def begun(**more: Any) -> tuple[Session, Head]:
    """A session whose user has set 235 degC."""
    session = Session(SETTINGS, NozzleLimits(), **more)
    session.follow(None, 235.0, 9.0)
    return session, Head(session)


def comment(session: Session, name: str, since_s: float) -> None:
    """The slicer names a feature; what is queued ends at `since_s`."""
    state = session.requested.state.comment(Comment("feature", name))
    if session.note(state):
        session.hold(state, since_s)


def test_moves_make_a_reference_that_begins_at_the_users_target() -> None:
    session, head = begun()
    assert not session.work(9.0).replanned
    assert head.roads(3)
    turn = session.work(9.5)
    assert turn.replanned and turn.reference is session.lead.reference
    assert turn.reference.at(9.5) == 235.0
    assert session.lead.end_s == pytest.approx(head.time_s)


def test_a_named_feature_holds_from_its_mark_on() -> None:
    session, head = begun(keeps_rows=True)
    comment(session, "perimeter", head.time_s)
    head.roads(4)
    middle_s = head.time_s
    comment(session, "infill", middle_s)
    head.roads(4)
    session.work(9.5)
    session.record(math.inf)
    rows = session.take_rows()
    assert {row.wanted_melt_c for row in rows if row.start_s < middle_s - 1e-6} == {240.0}
    assert {row.wanted_melt_c for row in rows if row.start_s > middle_s - 1e-6} == {225.0}
    assert session.take_rows() == []


def test_a_state_that_asks_for_the_same_is_no_news() -> None:
    session, _ = begun()
    state = session.requested.state
    assert not session.note(state.explicitly(math.nan))
    assert session.note(state.explicitly(230.0)) and not session.note(state.explicitly(230.0))


def test_nothing_is_planned_without_a_target_and_what_is_over_is_forgotten() -> None:
    session = Session(SETTINGS, NozzleLimits())
    session.follow(None, 0.0, 9.0)
    head = Head(session)
    head.roads(3)
    assert session.work(9.5).reference is None and session.path.facts().waiting == 3
    assert session.work(10.0 + 2.5 * ROAD_S).reference is None and session.path.facts().waiting == 1


def test_a_target_of_the_users_ends_the_plan_and_off_drops_what_lies_ahead() -> None:
    session, head = begun()
    head.roads(3)
    own = session.work(9.5).reference
    session.follow(own, 236.0, 10.0)  # what the heater shows while it follows the plan
    assert session.lead.reference is own and session.target.base_c == 235.0
    session.follow(own, 0.0, 11.0)
    assert session.lead.reference is None and session.lead.end_s == 11.0 and session.target.base_c == 0.0
    session.follow(None, 228.0, 12.0)
    assert session.target.base_c == 228.0 and session.path.facts().waiting == 0


def test_the_users_target_in_mid_path_moves_the_plan_from_the_commit_time_on() -> None:
    session, head = begun()
    assert session.move_target(225.0, 9.5) is None  # no path is under way: the heater's own affair
    head.roads(6)
    before = session.work(9.5).reference
    assert before is not None and session.move_target(235.0, 12.0) == Turn()  # as it is already
    turn = session.move_target(225.0, 12.0)
    assert turn is not None and turn.reference is not None
    assert turn.reference.at(12.0 + COMMIT_S) == pytest.approx(before.at(12.0 + COMMIT_S), abs=0.05)
    assert turn.reference.at(20.0) == pytest.approx(before.at(20.0) - 10.0, abs=1.0)


def test_at_the_end_of_the_path_the_nozzle_goes_back_and_is_released() -> None:
    session, head = begun()
    comment(session, "perimeter", head.time_s)
    head.roads(3)
    hot = session.work(9.5).reference
    assert hot is not None and hot.at(head.time_s) > 237.0
    now_s, turn = head.time_s, Turn()
    for _ in range(200):
        now_s += 0.25
        turn = session.work(now_s)
        if turn.released:
            break
    assert turn.released and turn.reference is not None and session.lead.reference is None
    assert turn.reference.at(now_s) == pytest.approx(235.0, abs=0.1)


def test_another_print_begins_on_an_empty_bed_and_is_led_on_by_the_one_before() -> None:
    session, head = begun()
    comment(session, "perimeter", head.time_s)
    head.roads(3)
    before = session.work(9.5).reference
    assert before is not None
    session.record(math.inf)
    assert session.plan.summary().pieces > 0
    session.begin(NozzleLimits(), 15.0)
    session.forget_requests()
    assert session.plan.summary().pieces == 0 and session.requested.state.feature == ""
    next_head = Head(session, 20.0)
    next_head.roads(2)
    turn = session.work(15.0)
    assert turn.reference is not None and turn.reference.at(15.0 + COMMIT_S) == pytest.approx(
        before.at(15.2), abs=0.05
    )
