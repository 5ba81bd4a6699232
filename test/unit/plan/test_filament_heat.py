"""Analytic solutions against finite differences, which know nothing of erfc: the issue asks 0.1 degC."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_banded

from thermal.models import filament_heat
from thermal.plan import extrusion, weld
from thermal.plan.materials import MATERIALS

CHI = 1.5e-7  # ABS as printed in Horoshailo 2019
TOLERANCE_C = 0.1  # the limit; the grids below are fine enough for a third of it


def march(speed, length, cells, time, steps, start, source, left, h=None):
    """Backward differences in time, central in space; `left(t)` the surface, or loss v_x = h v."""
    x = np.linspace(0.0, length, cells + 1)
    dx, dt = x[1], time / steps
    v = start(x)
    far = CHI * dt / dx**2
    drift = speed * dt / (2 * dx)
    bands = np.zeros((3, cells + 1))
    bands[1] = 1 + 2 * far
    bands[0, 1:] = -far + drift
    bands[2, :-1] = -far - drift
    bands[1, -1], bands[2, -2] = 1.0, -1.0
    if h is None:
        bands[1, 0], bands[0, 1] = 1.0, 0.0
    else:  # ghost node: v[-1] = v[1] - 2 dx h v[0]
        bands[1, 0] = 1 + 2 * far + (far + drift) * 2 * dx * h
        bands[0, 1] = -2 * far
    slope = start(x)[-1] - start(x)[-2]
    for i in range(steps):
        rhs = v + source * dt
        rhs[-1] = slope
        if h is None:
            rhs[0] = left((i + 1) * dt)
        v = solve_banded((1, 1), bands, rhs)
    return x, v


@pytest.mark.parametrize("speed", [2e-4, 1e-3])
def test_surface_ramp_agrees_with_finite_differences(speed):
    x, v = march(speed, 8e-3, 1600, 2.0, 8000, lambda x: 25 + 2000 * x, 3.0, lambda t: 45 + 5 * t)
    exact = [filament_heat.surface_ramp(p, 2.0, speed, CHI, 25, 2000, 45, 5, 3) for p in x]
    assert np.max(np.abs(v - exact)[: len(x) // 2]) < TOLERANCE_C


@pytest.mark.parametrize("h", [500.0, 2e-4 / CHI, 4000.0])
def test_surface_loss_agrees_with_finite_differences(h):
    speed = 2e-4
    x, v = march(speed, 6e-3, 1500, 2.0, 8000, lambda x: 0 * x + 100.0, 0.0, None, h)
    exact = [filament_heat.surface_loss(p, 2.0, speed, CHI, 100.0, h) for p in x]
    assert np.max(np.abs(v - exact)[: len(x) // 2]) < TOLERANCE_C


def test_line_source_agrees_with_finite_differences_and_keeps_its_heat():
    nu, strength, t0, t1 = 1.0, 1e-3, 5.0, 10.0
    cells, radius = 1200, 12e-3
    dr = radius / cells
    r = (np.arange(cells) + 0.5) * dr
    faces = np.arange(cells + 1) * dr
    v = np.array([filament_heat.line_source(p, t0, CHI, strength, nu) for p in r])
    steps = 2000
    dt = (t1 - t0) / steps
    # radial drift u = 2 nu chi / r; flux through a face per radian: r u v - chi r v_r
    drift = np.full(cells + 1, 2 * nu * CHI)
    drift[0] = drift[-1] = 0.0
    conduct = CHI * faces / dr
    conduct[-1] = 0.0
    area = r * dr / dt
    bands = np.zeros((3, cells))
    bands[1] = area + conduct[1:] + conduct[:-1] + 0.5 * drift[1:] - 0.5 * drift[:-1]
    bands[0, 1:] = -conduct[1:-1] + 0.5 * drift[1:-1]
    bands[2, :-1] = -conduct[1:-1] - 0.5 * drift[1:-1]
    for _ in range(steps):
        v = solve_banded((1, 1), bands, area * v)
    exact = np.array([filament_heat.line_source(p, t1, CHI, strength, nu) for p in r])
    assert exact.max() > 15.0  # the comparison is about tens of degrees
    assert np.max(np.abs(v - exact)) < TOLERANCE_C
    assert np.sum(exact * 2 * math.pi * r * dr) == pytest.approx(strength, rel=1e-4)


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
def test_fourier_numbers_of_source_004(share, fourier):
    assert filament_heat.fourier_for_core(share) == pytest.approx(fourier, abs=6e-5)  # four printed digits


def test_wall_and_feed_are_inverse():
    wall = filament_heat.wall_for_core(220.0, 25.0, 1e-3, 0.875e-3, 10e-3, CHI)
    feed = filament_heat.feed_for_wall(wall, 220.0, 25.0, 0.875e-3, 10e-3, CHI)
    assert wall > 220.0
    assert feed == pytest.approx(1e-3, rel=1e-9)


def test_interface_of_equal_media_is_the_mean_and_of_unlike_ones_leans_to_the_effusive():
    assert weld.interface_c(200.0, 20.0) == 110.0  # HydraRaptor 2007's example
    assert weld.melt_for_interface(135.0, 20.0) == 250.0  # HDPE: the needed 250 degC of HydraRaptor 2007
    assert weld.interface_c(200.0, 20.0, 3.0, 1.0) == 155.0
    assert weld.interface_c(weld.melt_for_interface(150.0, 40.0, 700, 500), 40.0, 700, 500) == pytest.approx(
        150
    )
    assert weld.bonds(136.0, 135.0) and not weld.bonds(136.0, 135.0, margin_c=2.0)


def contact(hot_c, cold_c, hot, cold, cells=600, dx=5e-6, step_s=5e-4, steps=300):
    """Temperature of the face between two bodies, (k, rho, cp) each, at the end of each step: implicit finite
    differences of heat fluxes on one grid, which know of no effusivity.
    """
    conductivity = np.repeat([hot[0], cold[0]], cells)
    mass = np.repeat([hot[1] * hot[2], cold[1] * cold[2]], cells) * dx
    half = 0.5 * dx / conductivity  # thermal resistance from a cell's middle to its face
    link = 1.0 / (half[:-1] + half[1:])
    bands = np.zeros((3, 2 * cells))
    bands[1] = mass / step_s
    bands[1, :-1] += link
    bands[1, 1:] += link
    bands[0, 1:] = bands[2, :-1] = -link
    temps, faces = np.where(np.arange(2 * cells) < cells, float(hot_c), float(cold_c)), []
    for _ in range(steps):
        temps = solve_banded((1, 1), bands, mass / step_s * temps)
        flux = link[cells - 1] * (temps[cells - 1] - temps[cells])
        faces.append(temps[cells - 1] - flux * half[cells - 1])
    assert temps[[0, -1]] == pytest.approx([hot_c, cold_c], abs=1e-3)  # still half spaces
    return np.array(faces)


@pytest.mark.parametrize(
    ("hot", "cold"),
    [
        (MATERIALS["HDPE"], (0.25, 950.0, 2200.0)),  # itself: the mean
        (MATERIALS["PEI"], (0.13, 1240.0, 1800.0)),  # on PLA
        (MATERIALS["ABS"], (1.1, 2500.0, 800.0)),  # on a glass plate
        (MATERIALS["PLA"], (0.035, 30.0, 1400.0)),  # on foam board, which HydraRaptor 2007 deposited HDPE on
    ],
)
def test_contact_of_two_media_agrees_with_finite_differences(hot, cold):
    """Half spaces take the contact's temperature at once and keep it; HydraRaptor 2007 weighted by heat capacity."""
    hot_e = weld.effusivity(hot.conductivity_w_mk, hot.density_kg_m3, hot.heat_j_kgk)
    cold_e = weld.effusivity(*cold)
    medium = (hot.conductivity_w_mk, hot.density_kg_m3, hot.heat_j_kgk)
    faces = contact(200.0, 20.0, medium, cold)
    assert faces[50:] == pytest.approx(weld.interface_c(200.0, 20.0, hot_e, cold_e), abs=TOLERANCE_C)


def test_die_swell_of_source_002_and_its_fit():
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
