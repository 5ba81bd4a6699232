"""Heat in the filament against finite differences, die swell and ooze against printed figures."""

import math

import numpy as np
import pytest
from scipy import special
from scipy.linalg import solve_banded

from thermal.models import filament_heat
from thermal.plan import extrusion


def test_core_fraction_agrees_with_finite_differences():
    cells = 400
    dr = 1.0 / cells
    r = (np.arange(cells) + 0.5) * dr
    faces = np.arange(cells + 1) * dr
    dt = 5e-5
    conduct = faces / dr
    conduct[-1] *= 2  # the wall is half a cell away
    area = r * dr / dt
    bands = np.zeros((3, cells))
    bands[1] = area + conduct[1:] + conduct[:-1]
    bands[0, 1:] = bands[2, :-1] = -conduct[1:-1]
    v = np.zeros(cells)
    for i in range(1, 12001):
        rhs = area * v
        rhs[-1] += conduct[-1]
        v = solve_banded((1, 1), bands, rhs)
        if i % 2000 == 0:  # a 200 K step: 0.1 degC is 5e-4
            assert filament_heat.core_fraction(i * dt) == pytest.approx(v[0], abs=5e-4)


@pytest.mark.parametrize(
    ("share", "fourier"), [(0.5, 0.2005), (0.8, 0.3598), (0.9, 0.4796), (0.95, 0.5995), (0.99, 0.8778)]
)
def test_core_fractions_are_those_that_are_printed(share: float, fourier: float) -> None:
    assert filament_heat.core_fraction(fourier) == pytest.approx(share, abs=1.5e-4)  # four digits of fourier


def test_the_table_holds_the_zeros_of_the_bessel_function() -> None:
    zeros = special.jn_zeros(0, len(filament_heat.CORE_TERMS))
    shares = 2.0 / (zeros * special.j1(zeros))
    assert pytest.approx(np.column_stack((zeros, shares)), abs=1e-9) == filament_heat.CORE_TERMS


def test_die_swell_of_hydraraptor_2007_and_its_fit():
    swell = extrusion.DieSwell(0.93, 0.09)  # 3 mm/s out: 1.2 mm
    feed = 3.0 * 1.2**2 / 3.0**2
    assert extrusion.exit_diameter(swell, feed, 3.0) == pytest.approx(1.2, abs=1e-9)
    feeds = [0.2, 0.5, 1.0, 2.0]
    fitted = extrusion.fit_die_swell(feeds, [extrusion.exit_diameter(swell, f, 3.0) for f in feeds], 3.0)
    assert (fitted.hole_mm, fitted.gain_s) == pytest.approx((0.93, 0.09), rel=1e-9)
    with pytest.raises(ValueError, match="two different speeds"):
        extrusion.fit_die_swell([1.0, 1.0], [1.0, 1.1], 3.0)


def test_strands_that_do_not_swell_and_strands_that_cannot_be():
    flat = extrusion.fit_die_swell([1.0, 2.0, 4.0], [0.42, 0.42, 0.41], 1.75)  # 0.01 mm is what calipers err
    assert flat == extrusion.DieSwell(pytest.approx(1.25 / 3.0), 0.0)
    with pytest.raises(ValueError, match="thinner as the speed rises"):
        extrusion.fit_die_swell([1.0, 2.0, 4.0], [0.50, 0.48, 0.44], 1.75)
    with pytest.raises(ValueError, match="widths are in mm"):
        extrusion.fit_die_swell([1.0, 2.0, 4.0], [450.0, 480.0, 520.0], 1.75)


def test_ooze_grows_to_its_total_and_a_cold_interval_adds_to_it():
    overrun = extrusion.Overrun(12.0, 3.0)
    assert extrusion.oozed_mm(overrun, 0.0) == 0.0
    assert extrusion.oozed_mm(overrun, 3.0) == pytest.approx(12.0 * (1 - math.exp(-1)))
    assert extrusion.oozed_mm(overrun, 300.0) == pytest.approx(12.0)
    cold = extrusion.Overrun(4.0, 3.0, reheat_mm=15.0)  # HydraRaptor 2007
    assert extrusion.oozed_mm(cold, 300.0, reheated=True) == pytest.approx(19.0)
