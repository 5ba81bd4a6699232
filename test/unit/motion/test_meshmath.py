"""Planes, surfaces through a grid, and how a path follows them."""

from __future__ import annotations

import math
import random

import pytest

from extras.probing.surface_fit import (
    Fade,
    Surface,
    bicubic_weights,
    fit_plane,
    fit_twisted,
    lagrange_weights,
    on_a_line,
    refine,
    solve,
    split_line,
)

EXACT = 1e-9  # rounding only


def grid(count_x: int, count_y: int, height) -> list[list[float]]:
    return [[height(c, r) for c in range(count_x)] for r in range(count_y)]


# ---- planes --------------------------------------------------------------------------------------------------


def test_a_plane_through_its_own_points_is_found() -> None:
    rng = random.Random(1)
    for count in (3, 4, 9):
        points = [(rng.uniform(0, 300), rng.uniform(0, 300)) for _ in range(count)]
        plane = fit_plane(points, [0.3 - 0.002 * x + 0.001 * y for x, y in points])
        assert (plane.height, plane.slope_x, plane.slope_y) == pytest.approx((0.3, -0.002, 0.001), abs=EXACT)


def test_two_points_give_the_plane_that_is_level_across() -> None:
    plane = fit_plane([(0, 100), (200, 100)], [1.0, 3.0])
    assert plane.z(50, 0) == pytest.approx(1.5) and plane.z(50, 777) == pytest.approx(1.5)


def test_through_points_on_a_line_goes_the_plane_that_is_level_across() -> None:
    points, heights = [(0, 0), (10, 20), (20, 40), (30, 60)], [0.0, 1.5, 1.5, 3.0]
    plane = fit_plane(points, heights)
    # along the line the regression of heights over t = 0, 1, 2, 3: slope 0.9 a step
    assert plane.z(30, 60) - plane.z(0, 0) == pytest.approx(2.7)
    assert plane.z(20, -10) == pytest.approx(plane.z(0, 0))  # (20, -10) is square to the line
    assert on_a_line(points) and not on_a_line([*points, (5, 0)])
    with pytest.raises(ValueError, match="one place"):
        fit_plane([(5, 5), (5, 5)], [0.0, 1.0])


def test_least_squares_leaves_no_plane_in_the_rest() -> None:
    rng = random.Random(2)
    points = [(rng.uniform(0, 300), rng.uniform(0, 300)) for _ in range(12)]
    heights = [rng.gauss(0, 0.1) for _ in points]
    plane = fit_plane(points, heights)
    rest = [h - plane.z(*p) for p, h in zip(points, heights, strict=True)]
    for factor in ([1.0] * 12, [p[0] for p in points], [p[1] for p in points]):
        assert math.fsum(f * r for f, r in zip(factor, rest, strict=True)) == pytest.approx(0.0, abs=1e-9)


def test_a_twisted_surface_goes_through_four_points() -> None:
    points, heights = [(50, 25), (50, 225), (250, 225), (250, 25)], [0.0, 0.4, -0.2, 0.7]
    surface = fit_twisted(points, heights)
    assert [surface(*p) for p in points] == pytest.approx(heights, abs=EXACT)
    # along its edges it is straight
    assert surface(150, 25) == pytest.approx(0.35) and surface(250, 425) == pytest.approx(-1.1)


def test_equations_without_a_solution_are_refused() -> None:
    assert solve([[2.0, 1.0], [1.0, 3.0]], [5.0, 10.0], 1e-12) == pytest.approx([1.0, 3.0])
    with pytest.raises(ValueError, match="no surface"):
        solve([[1.0, 2.0], [2.0, 4.0]], [1.0, 2.0], 1e-12)


# ---- interpolation -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "weights", [lagrange_weights(5, 3), bicubic_weights(5, 3, 0.2), bicubic_weights(5, 3, 0.7)]
)
def test_interpolation_keeps_the_probed_points_and_what_is_level(weights: list[list[float]]) -> None:
    assert len(weights) == 4 * 4 + 1
    for node in range(5):
        assert weights[4 * node] == pytest.approx([float(k == node) for k in range(5)], abs=EXACT)
    assert [sum(row) for row in weights] == pytest.approx([1.0] * 17)


def test_lagrange_is_exact_for_polynomials() -> None:
    values = [k**4 - 3 * k**2 + k for k in range(5)]
    for number, row in enumerate(lagrange_weights(5, 3)):
        x = number / 4
        assert sum(w * v for w, v in zip(row, values, strict=True)) == pytest.approx(x**4 - 3 * x**2 + x)


def test_bicubic_with_tension_one_half_is_exact_for_inner_parabolas() -> None:
    """Slope = 0.5 * (next - previous) is that of a parabola; at the ends there is no next."""
    values = [k * k for k in range(6)]
    for number, row in enumerate(bicubic_weights(6, 3, 0.5)):
        x = number / 4
        if 1 <= x <= 4:
            assert sum(w * v for w, v in zip(row, values, strict=True)) == pytest.approx(x * x)


def test_bicubic_slope_grows_with_the_tension() -> None:
    values = [0.0, 0.0, 1.0, 1.0]
    rise = []
    for tension in (0.0, 0.2, 0.5):
        rows = bicubic_weights(4, 99, tension)
        z = [sum(w * v for w, v in zip(row, values, strict=True)) for row in rows]
        rise.append((z[101] - z[100]) * 100)
    # from the definition: tension * (1 - 0); a hundredth of a segment on, to the curvature
    assert rise == pytest.approx([0.0, 0.2, 0.5], abs=0.03)


def test_no_extra_points_leave_the_probed_grid() -> None:
    rows = grid(4, 3, lambda c, r: 0.1 * c - 0.2 * r * r)
    assert refine(rows, lagrange_weights(4, 0), lagrange_weights(3, 0)) == rows


def test_a_surface_is_bilinear_and_ends_at_its_edge() -> None:
    surface = Surface((10, 20), (30, 60), grid(3, 3, lambda c, r: 1.0 * c + 10.0 * r + 2.0 * c * r))
    assert surface.z(15, 30) == pytest.approx(0.5 + 5 + 0.5)
    assert surface.z(30, 60) == surface.z(99, 99) == pytest.approx(30.0)
    assert surface.z(-5, 40) == surface.z(10, 40) == pytest.approx(10.0)
    assert surface.range() == (0.0, 30.0) and surface.mean() == pytest.approx(13.0)
    assert surface.raised(-1.0).z(15, 30) == pytest.approx(5.0)
    assert surface.holds(10, 60) and not surface.holds(9.9, 60)


# ---- fade and path -------------------------------------------------------------------------------------------


def corrected(fade: Fade, z: float, surface_z: float, shift: float = 0.0) -> float:
    """z of a path at height z over a level bed."""
    surface = Surface((0, 0), (9, 9), [[surface_z] * 2] * 2)
    surface.follow(fade, (0.0, 0.0, shift), 5.0, 0.025)
    return split_line(surface, [3, 3, z, 0], [3, 3, z, 0])[0][2]


def test_fading_is_undone_exactly_at_every_height() -> None:
    rng = random.Random(3)
    fade = Fade(1.0, 6.0, 0.2)
    for _ in range(500):
        z, surface_z, shift = rng.uniform(-1, 9), rng.uniform(-1, 1), rng.uniform(-0.5, 0.5)
        assert fade.undo(corrected(fade, z, surface_z, shift), surface_z, shift) == pytest.approx(z, abs=1e-9)


def test_fading_keeps_all_below_and_only_the_target_above() -> None:
    fade = Fade(1.0, 6.0, 0.2)
    assert corrected(fade, 1.0, 0.7) == pytest.approx(1.7)
    assert corrected(fade, 3.5, 0.7) == pytest.approx(3.95)
    assert corrected(fade, 6.0, 0.7) == pytest.approx(6.2)
    assert corrected(fade, 50, 0.7) == pytest.approx(50.2)
    assert corrected(Fade(), 500, 0.7) == pytest.approx(500.7) and Fade().undo(500.7, 0.7) == pytest.approx(
        500
    )
    assert fade.allows(-4.7, 5.1) and not fade.allows(-4.7, 5.3) and not fade.allows(-4.9, 0.0)


def bed(height, fade: Fade | None = None, check: float = 5.0, max_change: float = 0.025) -> Surface:
    """A bed of 200 x 100 mm with places at every mm."""
    surface = Surface((0, 0), (200, 100), grid(201, 101, height))
    surface.follow(fade or Fade(), (0.0, 0.0, 0.0), check, max_change)
    return surface


def test_a_level_path_over_a_level_bed_is_one_piece() -> None:
    corners = split_line(bed(lambda x, y: 0.3), [0, 0, 1, 0], [200, 50, 1, 9])
    assert corners == [[200, 50, 1.3, 9]]


def test_a_path_is_cut_where_the_correction_has_changed() -> None:
    corners = split_line(bed(lambda x, y: 0.01 * x, max_change=0.19), [0, 0, 1, 0, 5], [100, 0, 1, 10, 0])
    assert [c[0] for c in corners] == pytest.approx([20, 40, 60, 80, 100])
    for x, _, z, e, further in corners:
        assert z == pytest.approx(1 + 0.01 * x) and e == pytest.approx(0.1 * x)
        assert further == pytest.approx(5 - 0.05 * x)


def test_no_place_of_a_path_is_off_by_more_than_asked() -> None:
    """Between corners the path is straight; the surface bends by max_change at most within a piece, and once more over
    check_distance, which is not looked into."""

    def hill(x: float, y: float) -> float:
        return 0.5 * math.exp(-((x - 60) ** 2 + (y - 40) ** 2) / 900)

    start, end, max_change = [0.0, 0.0, 2.0, 0.0], [120.0, 90.0, 2.0, 0.0], 0.025
    surface = bed(hill, check=3.0, max_change=max_change)
    path = [[0.0, 0.0, 2.0 + hill(0, 0), 0.0], *split_line(surface, start, end)]
    steepest = 0.5 * math.sqrt(2 / 900) * math.exp(-0.5)
    for share in (k / 1000 for k in range(1001)):
        x, y = 120 * share, 90 * share
        low = max(k for k in range(len(path) - 1) if path[k][0] <= x + EXACT)
        a, b = path[low], path[low + 1]
        z = a[2] + (b[2] - a[2]) * (x - a[0]) / (b[0] - a[0])
        assert abs(z - 2 - hill(x, y)) <= max_change + 3.0 * steepest


def test_a_move_straight_up_is_corrected_once() -> None:
    surface = bed(lambda x, y: 0.4, Fade(1.0, 5.0, 0.0))
    assert split_line(surface, [3, 3, 1, 0], [3, 3, 3, 0]) == [[3, 3, pytest.approx(3.2), 0]]
