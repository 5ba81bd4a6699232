"""Which melt temperature a place is asked to have, by what slicers and users call it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from thermal.plan.requests import (
    Comment,
    Range,
    Requests,
    RequestTable,
    read_comment,
    read_names,
    read_ranges,
)


@pytest.mark.parametrize(
    ("line", "feature"),
    [
        (";TYPE:External perimeter", "external perimeter"),  # PrusaSlicer, SuperSlicer
        (";TYPE:Solid infill", "solid infill"),
        ("; FEATURE: Outer wall", "external perimeter"),  # Bambu Studio
        (";TYPE:Inner wall", "perimeter"),  # OrcaSlicer
        (";TYPE:WALL-OUTER", "external perimeter"),  # Cura
        (";TYPE:SKIN", "solid infill"),
        (";TYPE:Something new", "something new"),
    ],
)
def test_features_of_the_slicers_have_one_name_each(line: str, feature: str) -> None:
    assert read_comment(line) == Comment("feature", feature)


@pytest.mark.parametrize("line", [";LAYER_CHANGE", "; CHANGE_LAYER", ";LAYER:12", ";LAYER:-3"])
def test_layer_marks(line: str) -> None:
    assert read_comment(line) == Comment("layer")


def test_heights_and_what_says_nothing() -> None:
    assert read_comment(";HEIGHT:0.2") == Comment("height", value=0.2)
    assert read_comment("; LAYER_HEIGHT: 0.28") == Comment("height", value=0.28)
    for line in ("; hello", ";Z:3.2", ";HEIGHT:tall", ";HEIGHT:0", ";HEIGHT:1.2.3", ";", ";LAYER_COUNT:40"):
        assert read_comment(line) is None


TABLE = RequestTable(
    {"external perimeter": 215.0},
    {"PART_A": 225.0},
    (Range(1, 1, 230.0), Range(5, 9, 210.0)),
    (Range(10.0, 20.0, 205.0),),
)


def test_the_first_that_speaks_wins() -> None:
    def request(state: Requests, layer: int = 3, z_mm: float = 1.0) -> float:
        return state.request_c(TABLE, 0.0, layer, z_mm)

    plain = Requests()
    assert math.isnan(request(plain))
    assert request(plain, z_mm=15.0) == 205.0
    assert request(plain, layer=5, z_mm=15.0) == 210.0
    wall = plain.comment(Comment("feature", "external perimeter"))
    assert request(wall, layer=5, z_mm=15.0) == 215.0
    assert request(wall.inside("part_a")) == 225.0  # names of objects are not case sensitive
    assert request(wall.inside("part_a").explicitly(240.0)) == 240.0
    assert request(wall.inside("part_a").explicitly(math.nan)) == 225.0


def test_layers_named_by_the_slicer_count_before_those_seen() -> None:
    state = Requests()
    for _ in range(5):
        state = state.comment(Comment("layer"))
    assert state.request_c(TABLE, 0.0, 1, 0.2) == 210.0


def test_an_explicit_request_ends_where_its_command_says() -> None:
    for until, ender in (
        ("layer", lambda s: s.comment(Comment("layer"))),
        ("feature", lambda s: s.comment(Comment("feature", "infill"))),
        ("object", lambda s: s.inside("b")),
    ):
        state = Requests().inside("a").explicitly(222.0, until)
        assert state.request_c(RequestTable(), 0.0, 1, 0.0) == 222.0
        others = [state.comment(Comment("height", value=0.1)), state.inside("a")]
        assert all(s.explicit_c == 222.0 for s in others)
        assert math.isnan(ender(state).explicit_c)
    timed = Requests(since_s=10.0, explicit_c=222.0, duration_s=5.0)
    assert timed.request_c(RequestTable(), 14.9, 1, 0.0) == 222.0
    assert math.isnan(timed.request_c(RequestTable(), 15.1, 1, 0.0))


def test_tables_of_the_config() -> None:
    assert read_names("\nperimeter: 215\n a b : 220.5\n") == {"perimeter": 215.0, "a b": 220.5}
    assert read_ranges("1: 230\n5-9: 210") == (Range(1, 1, 230.0), Range(5, 9, 210.0))
    for reader, text in (
        (read_names, "perimeter 215"),
        (read_names, "perimeter: warm"),
        (read_names, ": 215"),
        (read_ranges, "1-x: 215"),
        (read_ranges, "9-5: 215"),
        (read_ranges, "5: nan"),
    ):
        with pytest.raises(ValueError, match=text.strip().split("\n")[0].split(":")[0] or "form"):
            reader(text)


def test_a_mark_matters_only_if_the_table_asks_for_something_there() -> None:
    inside = Requests().comment(read_comment(";TYPE:Solid infill")).inside("box")  # type: ignore[arg-type]
    next_layer = inside.comment(read_comment(";LAYER_CHANGE"))  # type: ignore[arg-type]
    nothing, layers = RequestTable(), RequestTable(layers=(Range(3, 5, 210.0),))
    assert Requests().asks(nothing) == inside.asks(nothing) == next_layer.asks(nothing)
    assert inside.asks(layers) != next_layer.asks(layers)
    for table in (RequestTable({"solid infill": 230.0}), RequestTable(objects={"BOX": 220.0})):
        assert Requests().asks(table) != inside.asks(table) == next_layer.asks(table)
    for other in (inside.explicitly(230.0), inside.comment(read_comment(";HEIGHT:0.3"))):  # type: ignore[arg-type]
        assert inside.asks(nothing) != other.asks(nothing)
    assert inside.asks(nothing) != replace(inside, speed_factor=0.5).asks(nothing)
    assert inside.explicitly(230.0).asks(nothing) != inside.explicitly(230.0, duration_s=5.0).asks(nothing)


def test_all_that_is_asked_for_can_be_gone_through() -> None:
    """The check of temperatures misses none."""
    assert list(TABLE.entries()) == [
        ("features", "external perimeter", 215.0),
        ("objects", "PART_A", 225.0),
        ("layers", "1-1", 230.0),
        ("layers", "5-9", 210.0),
        ("heights", "10-20", 205.0),
    ]
