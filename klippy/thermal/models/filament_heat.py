"""Heat in a moving filament: Horoshailo 2019's equations 6, 9 and 15 as in Carslaw 1959, and the wall
temperature at which the core of the filament melts.

The medium moves along x with `speed_m_s`: v_t + U v_x = chi v_xx + source. The printed equations have six
misprints (among them the exponent e^(Ux/chi), the boundary b t, and the missing 1/t of equation 15); these are
the corrected forms. exp(Ux/chi) erfc((x+Ut)/2s) overflows term by term, so it is taken as
exp(-((x-Ut)/2s)^2) erfcx(...), which is the same number; s = sqrt(chi t).
SI units: m, s, m2/s; temperatures in degC (or as differences).
"""

from __future__ import annotations

import math

ROOT_COUNT = 20  # exp(-z20^2 * MIN_FOURIER) is below 1e-16: no further term counts
MIN_FOURIER = 0.01  # below it the core has seen less than 1e-9 of the wall's step
SINGULAR = 1e-4  # relative distance from chi h = U at which equation 9 is 0/0


def erfcx(z: float) -> float:
    """exp(z^2) erfc(z); beyond z = 25 the asymptotic series, good to 1e-8 there."""
    if z < 25.0:
        return math.exp(z * z) * math.erfc(z)
    q = 0.5 / (z * z)
    return (1.0 - q + 3.0 * q * q) / (z * math.sqrt(math.pi))


def _advected(gauss: float, z: float, exponent: float) -> float:
    """exp(exponent) erfc(z) where exponent - z^2 = -gauss^2."""
    if z > 0.0:
        return math.exp(-gauss * gauss) * erfcx(z)
    return math.exp(exponent) * math.erfc(z)


def surface_ramp(
    x_m: float,
    time_s: float,
    speed_m_s: float,
    chi_m2_s: float,
    start_c: float,
    start_slope_c_m: float,
    wall_c: float,
    wall_rate_c_s: float,
    source_c_s: float,
) -> float:
    """Equation 6: start V0 + a x, surface x = 0 at V1 + b t, uniform source (chi A0/K, in K/s)."""
    base = start_c + start_slope_c_m * x_m
    if time_s <= 0.0:
        return base
    width = 2.0 * math.sqrt(chi_m2_s * time_s)
    run = speed_m_s * time_s
    gauss = (x_m - run) / width
    behind = math.erfc(gauss)
    ahead = _advected(gauss, (x_m + run) / width, speed_m_s * x_m / chi_m2_s)
    step = 0.5 * (wall_c - start_c) * (behind + ahead)
    drive = (wall_rate_c_s + start_slope_c_m * speed_m_s - source_c_s) / (2.0 * speed_m_s)
    ramp = drive * ((x_m + run) * ahead + (run - x_m) * behind)
    return base + (source_c_s - start_slope_c_m * speed_m_s) * time_s + step + ramp


def surface_loss(
    x_m: float, time_s: float, speed_m_s: float, chi_m2_s: float, start_c: float, h_per_m: float
) -> float:
    """Equation 9: start V0 above the surroundings, loss v_x = h v at x = 0 (h in 1/m, printed as k)."""
    if time_s <= 0.0:
        return start_c
    exchange = chi_m2_s * h_per_m
    if abs(exchange - speed_m_s) < 0.5 * SINGULAR * speed_m_s:  # removable: the mean of both sides
        sides = [speed_m_s / chi_m2_s * (1.0 + e) for e in (SINGULAR, -SINGULAR)]
        return 0.5 * sum(surface_loss(x_m, time_s, speed_m_s, chi_m2_s, start_c, h) for h in sides)
    width = 2.0 * math.sqrt(chi_m2_s * time_s)
    run = speed_m_s * time_s
    gauss = (x_m - run) / width
    ahead = _advected(gauss, (x_m + run) / width, speed_m_s * x_m / chi_m2_s)
    lossy = _advected(
        gauss,
        (x_m + (2.0 * exchange - speed_m_s) * time_s) / width,
        h_per_m * x_m - h_per_m * time_s * (speed_m_s - exchange),
    )
    spread = exchange - speed_m_s
    cooled = 0.5 * (math.erfc(gauss) + exchange / spread * ahead)
    return start_c * (1.0 - cooled + (2.0 * exchange - speed_m_s) / (2.0 * spread) * lossy)


def line_source(r_m: float, time_s: float, chi_m2_s: float, strength_c_m2: float, nu: float) -> float:
    """Equation 15: heat released at once on a line from which material flows outward, nu = m/(4 pi chi rho).

    The integral over the plane is `strength_c_m2` at all times, which the printed form (1/t missing) breaks.
    """
    s = r_m * r_m / (4.0 * chi_m2_s * time_s)
    if s == 0.0:
        shape = 1.0 if nu == 0.0 else 0.0
    else:
        shape = math.exp(nu * math.log(s) - s - math.lgamma(nu + 1.0))
    return strength_c_m2 / (4.0 * math.pi * chi_m2_s * time_s) * shape


def _bessel(order: int, x: float) -> float:
    """J0 or J1 by the trapezoidal rule on Bessel's integral, which converges exponentially."""
    count = 128
    angles = (math.pi * (i + 0.5) / count for i in range(count))
    return sum(math.cos(order * a - x * math.sin(a)) for a in angles) / count


def _core_terms() -> tuple[tuple[float, float], ...]:
    """(z^2, 2/(z J1(z))) for the first zeros z of J0."""
    terms = []
    for i in range(ROOT_COUNT):
        z = (i + 0.75) * math.pi
        for _ in range(6):
            z += _bessel(0, z) / _bessel(1, z)
        terms.append((z * z, 2.0 / (z * _bessel(1, z))))
    return tuple(terms)


CORE_TERMS = _core_terms()


def core_fraction(fourier: float) -> float:
    """theta_c(Fo): share of the wall's step that has reached the axis of a cylinder, 0..1."""
    if fourier < MIN_FOURIER:
        return 0.0
    return min(1.0, max(0.0, 1.0 - sum(a * math.exp(-z2 * fourier) for z2, a in CORE_TERMS)))


def fourier_for_core(fraction: float) -> float:
    """The Fourier number at which theta_c reaches `fraction` (0 < fraction < 1), by bisection."""
    if not 0.0 < fraction < 1.0:
        raise ValueError(
            f"The share of the wall's step at the core must lie between 0 and 1, not {fraction}."
        )
    low, high = MIN_FOURIER, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if core_fraction(middle) < fraction else (low, middle)
    return 0.5 * (low + high)


def wall_for_core(
    melt_c: float, inlet_c: float, feed_m_s: float, radius_m: float, length_m: float, chi_m2_s: float
) -> float:
    """Wall temperature at which the core leaves a hot zone at `melt_c`; inf if no wall is hot enough."""
    if feed_m_s <= 0.0:
        return melt_c
    share = core_fraction(chi_m2_s * length_m / (feed_m_s * radius_m * radius_m))
    return inlet_c + (melt_c - inlet_c) / share if share > 0.0 else math.inf


def feed_for_wall(
    wall_c: float, melt_c: float, inlet_c: float, radius_m: float, length_m: float, chi_m2_s: float
) -> float:
    """Highest feed speed (m/s) at which a wall of `wall_c` still melts the core; 0 if it never does."""
    if wall_c <= melt_c:
        return 0.0
    fourier = fourier_for_core((melt_c - inlet_c) / (wall_c - inlet_c))
    return chi_m2_s * length_m / (fourier * radius_m * radius_m)
