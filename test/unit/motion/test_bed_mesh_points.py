"""Where a bed mesh is probed, and what becomes of the heights."""

from __future__ import annotations

import math

import pytest

from extras.bed_mesh.points import MeshError, MeshShape, Region

SHAPE = MeshShape((35.0, 6.0), (240.0, 198.0), (5, 3))


def test_the_points_of_the_documentation() -> None:
    """Klipper's example: 5 x 3 points, to and fro."""
    places = SHAPE.plan().places()
    assert len(places) == 15
    assert [round(x, 1) for x, _ in places[:6]] == [35.0, 86.2, 137.5, 188.8, 240.0, 240.0]
    assert [y for _, y in places] == [6.0] * 5 + [102.0] * 5 + [198.0] * 5


def test_heights_come_back_in_rows_from_left_to_right() -> None:
    layout = SHAPE.plan()
    rows = SHAPE.rows(layout.cells, [100 * y + x for x, y in layout.places()])
    assert (
        rows[1] == sorted(rows[1]) and rows[0][0] == pytest.approx(635) and rows[2][4] == pytest.approx(20040)
    )


def test_a_faulty_region_is_probed_at_its_edges() -> None:
    """Klipper's example: of the four edge points one lies below the mesh."""
    region = Region((130.0, 0.0), (145.0, 40.0))
    layout = SHAPE.plan([region])
    (cell,) = [c for c in layout.cells if len(c.places) > 1]
    assert (cell.row, cell.column) == (0, 2)
    assert set(cell.places) == {(130.0, 6.0), (145.0, 6.0), (137.5, 40.0)}
    heights = [float(number) for number in range(len(layout.places()))]
    rows = SHAPE.rows(layout.cells, heights)
    assert rows[0] == [0, 1, 3, 5, 6]


def test_edges_are_probed_in_the_way_of_their_row() -> None:
    """As Klipper does: along x, of two of the same x the lower first; the second row runs from right to left."""
    for row, middle in ((0, 2), (1, 7)):
        x, y = SHAPE.plan().places()[middle]
        layout = SHAPE.plan([Region((x - 9.0, y - 5.0), (x + 8.0, y + 4.0))])
        (cell,) = [c for c in layout.cells if c.row == row and len(c.places) > 1]
        left, right = (x - 9.0, y), (x + 8.0, y)
        first, last = (left, right) if row == 0 else (right, left)
        edges = [first, (x, y - 5.0), (x, y + 4.0), last]
        assert list(cell.places) == [e for e in edges if SHAPE.holds(e)]


def test_a_region_that_covers_the_mesh_is_refused() -> None:
    with pytest.raises(MeshError, match="leaves no place"):
        SHAPE.plan([Region((0, 0), (300, 300))])


def test_a_round_bed_is_probed_within_its_circle() -> None:
    shape = MeshShape.round((-10.0, 5.0), 75.0, 5)
    layout = shape.plan()
    assert len(layout.places()) == 13  # of a 5 x 5 grid those within: 1 + 3 + 5 + 3 + 1
    assert all(math.dist(p, (-10, 5)) <= 75.001 for p in layout.places())
    rows = shape.rows(layout.cells, [float(k) for k in range(13)])
    assert rows[0] == [0.0] * 5
    # the second row runs from right to left; beyond its edge it is as at its edge
    assert rows[1] == [3.0, 3.0, 2.0, 1.0, 1.0]
    with pytest.raises(MeshError, match="odd"):
        MeshShape.round((0, 0), 75.0, 4).checked()


def test_a_reference_within_the_mesh_needs_no_point_of_its_own() -> None:
    assert SHAPE.plan(reference=(100, 100)).reference is None
    layout = SHAPE.plan(reference=(5, 5))
    assert layout.places()[-1] == (5, 5) and len(layout.places()) == 16
    with pytest.raises(MeshError, match="faulty region"):
        SHAPE.plan([Region((0, 0), (10, 10))], (5, 5))


def test_an_adapted_mesh_is_as_dense_as_the_whole_one() -> None:
    """Klipper's example: half as wide of 7 points: 4."""
    shape = MeshShape((25, 25), (125, 125), (7, 7), algorithm="bicubic").checked()
    small = shape.adapted([(50, 60), (90, 100)], 5)
    assert (small.low, small.high, small.counts) == ((45, 55), (95, 105), (4, 4))
    assert shape.adapted([(0, 0), (500, 500)], 0).counts == (7, 7)
    assert shape.adapted([(50, 50), (51, 51)], 0).algorithm == "lagrange"
    # one long and one short side: too long for lagrange, so the short one gets what bicubic needs
    assert MeshShape((0, 0), (100, 100), (9, 9), algorithm="bicubic").adapted(
        [(0, 50), (100, 60)], 0
    ).counts == (9, 4)
    with pytest.raises(MeshError, match="outside"):
        shape.adapted([(130, 130), (140, 140)], 0)


def test_an_adapted_round_mesh_covers_the_objects_and_stays_within() -> None:
    shape = MeshShape.round((0, 0), 100, 9, algorithm="bicubic")
    small = shape.adapted([(10, 10), (40, 30)], 0)
    assert small.origin == pytest.approx((25, 20)) and small.radius == pytest.approx(math.hypot(15, 10))
    assert small.counts[0] % 2 == 1
    outer = shape.adapted([(60, 0), (100, 20)], 0)
    assert math.hypot(*outer.origin) + outer.radius <= 100.001


def test_what_an_algorithm_cannot_do() -> None:
    assert MeshShape((0, 0), (9, 9), (3, 6), algorithm="bicubic").checked().algorithm == "lagrange"
    with pytest.raises(MeshError, match="use algorithm bicubic"):
        MeshShape((0, 0), (9, 9), (7, 5)).checked()
    assert MeshShape((0, 0), (9, 9), (20, 3), pps=(0, 0)).checked().counts == (20, 3)
    with pytest.raises(MeshError, match="below mesh_max"):
        MeshShape((9, 0), (9, 9), (3, 3)).checked()


def test_the_refined_surface_has_the_points_of_the_documentation() -> None:
    """5 x 3 probed, 2 and 3 between: 13 x 9."""
    shape = MeshShape((35, 6), (240, 198), (5, 3), pps=(2, 3), algorithm="bicubic").checked()
    surface = shape.surface([[0.0] * 5] * 3)
    assert len(surface.heights[0]) == 13 and len(surface.heights) == 9
