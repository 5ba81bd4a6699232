"""Fitting the eddy-current thermometer: from recorded (temperature, phase, error) points to a law.

Offline code (numpy and scipy); nothing here runs during a print.  The chain is that of Oskolkov et al.,
Sensors 2021, 21(7), 2561, sections 3.1-3.2:

    error(t) at one power --reduce_curve--> corners --fit_heating_curve--> quadratic "ideal heating curve"
        --scale_to_reference--> temperature(t) --> (temperature, phase, error) points --fit_*--> a law

Three laws can be fitted.  With T the temperature in degC, n the phase in ticks and p = (n / 45000)**2 the
power fraction:

    eq5   error = C + A*T + B*n + AB*T*n + BB*n**2 + ABB*T*n**2           (the paper's equation 5)
    exp   error = a*T*exp(-b*p) + c + d*p
    tank  error = g*psi + c + d*exp(-m*p),  tan(psi) = ((T - t0)*S(u) + delta)/w

`tank` is the phase of the LCL tank's coil current, its inductance linear in T and saturating with the field
(laws.py has the derivation). A few powers cannot determine nine numbers, so that fit is held to the design
values of the tank by weak priors (TANK_PRIOR): a direction the data say nothing about stays there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from thermal.sensing.laws import PSI_MAX_RAD

Array = NDArray[np.float64]

PHASE_FULL_TICKS = 45000.0
CONFIDENCE = 0.95  # the paper's F-test, section 3.2: alpha = 0.05


class FitError(ValueError):
    """The data cannot support the fit that was asked for; the text says why."""


@dataclass(frozen=True, slots=True)
class Points:
    """Calibration points, one row each.

    temp_c, phase_ticks and error have shape (n,); error is in signal units.
    """

    temp_c: Array
    phase_ticks: Array
    error: Array

    def __post_init__(self) -> None:
        if not (self.temp_c.shape == self.phase_ticks.shape == self.error.shape):
            raise FitError("temperature, phase and error must have one value each per point")
        if not all(np.isfinite(a).all() for a in (self.temp_c, self.phase_ticks, self.error)):
            raise FitError("a calibration point holds a value that is not a finite number")

    def __len__(self) -> int:
        return int(self.temp_c.size)

    @property
    def power(self) -> Array:
        """Power fraction p = (phase / 45000)**2, shape (n,)."""
        return power_of_ticks(self.phase_ticks)

    def where(self, mask: NDArray[np.bool_]) -> Points:
        return Points(self.temp_c[mask], self.phase_ticks[mask], self.error[mask])


@dataclass(frozen=True, slots=True)
class Coefficient:
    """One fitted number: estimate, standard error, and their ratio t."""

    name: str
    estimate: float
    std_error: float

    @property
    def t(self) -> float:
        return self.estimate / self.std_error if self.std_error > 0 else float("inf")


@dataclass(frozen=True, slots=True)
class Regression:
    """A fit by least squares with the statistics of the paper's Table 2 and section 3.2.

    residual_sd is in the units of the dependent variable (sum of squares over n - k).
    """

    law: str
    coefficients: tuple[Coefficient, ...]
    n_points: int
    residual_sd: float
    max_residual: float
    r: float
    f: float
    f_critical: float

    @property
    def significant(self) -> bool:
        return self.f > self.f_critical

    def values(self) -> dict[str, float]:
        return {c.name: c.estimate for c in self.coefficients}


@dataclass(frozen=True, slots=True)
class HeatingCurve:
    """Quadratic q2*t**2 + q1*t + q0 through a heating run at one power; t in s from `start_s` to `end_s`."""

    q2: float
    q1: float
    q0: float
    r_squared: float
    start_s: float
    end_s: float

    def __call__(self, t_s: Array) -> Array:
        return np.asarray(np.polyval([self.q2, self.q1, self.q0], t_s), dtype=float)


def power_of_ticks(phase_ticks: Array) -> Array:
    """Power fraction of a phase (Table 1 and Table 2 agree on the square, and on nothing else)."""
    return np.asarray((np.asarray(phase_ticks, dtype=float) / PHASE_FULL_TICKS) ** 2)


def ticks_of_power(power_fraction: Array) -> Array:
    return np.asarray(PHASE_FULL_TICKS * np.sqrt(np.asarray(power_fraction, dtype=float)))


# ---------------------------------------------------------------------------------- curve reduction


def reduce_curve(x: Array, y: Array, tolerance: float) -> NDArray[np.intp]:
    """Ramer-Douglas-Peucker reduction; returns the indices kept, ascending, always both ends.

    `tolerance` is the largest vertical distance (units of y) a dropped point may have from the polyline:
    x is time and y a signal, so the perpendicular distance of the geometric version would mix units.
    """
    if x.size != y.size or x.size < 2:
        raise FitError("a curve needs at least two points to be reduced")
    keep = np.zeros(x.size, dtype=bool)
    keep[[0, -1]] = True
    spans = [(0, x.size - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        inner = slice(first + 1, last)
        chord = np.interp(x[inner], [x[first], x[last]], [y[first], y[last]])
        distance = np.abs(y[inner] - chord)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            split = first + 1 + worst
            keep[split] = True
            spans += [(first, split), (split, last)]
    return np.flatnonzero(keep)


def fit_heating_curve(t_s: Array, error: Array) -> HeatingCurve:
    """The paper's "ideal heating curve" (section 3.1, figure 9): a quadratic with its R squared."""
    if t_s.size < 4:
        raise FitError("a heating curve needs at least four points")
    q2, q1, q0 = (float(q) for q in np.polyfit(t_s, error, 2))
    residual = error - np.polyval([q2, q1, q0], t_s)
    spread = error - error.mean()
    total = float(spread @ spread)
    if total == 0.0:
        raise FitError("the error signal does not change during the heating run: nothing to fit")
    return HeatingCurve(q2, q1, q0, 1.0 - float(residual @ residual) / total, float(t_s[0]), float(t_s[-1]))


def scale_to_reference(curve: HeatingCurve, t_s: Array, start_c: float, end_c: float) -> Array:
    """Temperature (degC) at each t_s: the curve's range mapped linearly onto the reference's range."""
    low, high = curve(np.array([curve.start_s, curve.end_s]))
    if high == low:
        raise FitError("the heating curve begins and ends at the same error: it has no range to scale")
    return np.asarray(start_c + (end_c - start_c) * (curve(t_s) - low) / (high - low))


# ------------------------------------------------------------------------------------- regression


def _statistics(
    law: str, names: Sequence[str], beta: Array, jacobian: Array, *, error: Array, predicted: Array
) -> Regression:
    n, k = jacobian.shape
    residual = error - predicted
    scale = np.abs(jacobian).max(axis=0)  # columns differ by up to 1e12 (T*n**2): condition them first
    if not np.all(scale > 0):
        raise FitError(f"the data do not determine '{names[int(np.argmin(scale))]}' of law {law}")
    variance = float(residual @ residual) / (n - k)
    normal = (jacobian / scale).T @ (jacobian / scale)
    covariance = np.linalg.pinv(normal) * variance
    std_error = np.sqrt(np.diag(covariance)) / scale
    spread = error - error.mean()
    unexplained = float(residual @ residual) / float(spread @ spread)
    f = (1.0 - unexplained) / max(unexplained, 1e-300) * (n - k) / (k - 1)
    return Regression(
        law=law,
        coefficients=tuple(
            Coefficient(name, float(b), float(s)) for name, b, s in zip(names, beta, std_error, strict=True)
        ),
        n_points=n,
        residual_sd=float(np.sqrt(variance)),
        max_residual=float(np.abs(residual).max()),
        r=float(np.sqrt(max(0.0, 1.0 - unexplained))),
        f=f,
        f_critical=float(stats.f.ppf(CONFIDENCE, k - 1, n - k)),
    )


def _require(points: Points, law: str, parameters: int, powers: int) -> None:
    if len(points) <= parameters:
        raise FitError(
            f"law {law} has {parameters} parameters and needs more points than that; got {len(points)}"
        )
    distinct = np.unique(np.round(points.phase_ticks)).size
    if distinct < powers:
        raise FitError(f"law {law} needs at least {powers} different powers in the data; got {distinct}")
    if np.ptp(points.temp_c) < 20.0:
        raise FitError(f"the points span only {np.ptp(points.temp_c):.1f} degC: too little to fit a law")


EQ5_NAMES = ("C", "A", "B", "AB", "BB", "ABB")


def fit_eq5(points: Points) -> Regression:
    """Multiple linear regression of equation 5.  Raises FitError if the data cannot support it."""
    _require(points, "eq5", len(EQ5_NAMES), 3)
    t, n = points.temp_c, points.phase_ticks
    design = np.column_stack([np.ones_like(t), t, n, t * n, n**2, t * n**2])
    scale = np.abs(design).max(axis=0)
    beta = np.linalg.lstsq(design / scale, points.error, rcond=None)[0] / scale
    return _statistics("eq5", EQ5_NAMES, beta, design, error=points.error, predicted=design @ beta)


@dataclass(frozen=True, slots=True)
class _NonlinearLaw:
    name: str
    names: tuple[str, ...]
    start: tuple[float, ...]  # the law at its published or derived values
    powers: int  # different powers the data must hold
    predict: Callable[[Array, Array, Array], Array]


def _predict_exp(beta: Array, temp_c: Array, p: Array) -> Array:
    a, b, c, d = beta
    return np.asarray(a * temp_c * np.exp(-b * p) + c + d * p)


def _predict_tank(beta: Array, temp_c: Array, p: Array) -> Array:
    g, t0, w, delta, b, q, c, d, m = beta
    field = np.sin(0.5 * np.pi * np.sqrt(p)) ** 2
    psi = np.zeros_like(temp_c, dtype=float)
    for _ in range(TANK_ROUNDS):
        u = field * np.cos(psi) ** 2
        psi = np.arctan(((temp_c - t0) * np.exp(-b * u - q * u**4) + delta) / w)
    return np.asarray(g * psi + c + d * np.exp(-m * p))


EXP_LAW = _NonlinearLaw("exp", ("a", "b", "c", "d"), (0.8, 1.06, 1.4, 5.1), 2, _predict_exp)
TANK_LAW = _NonlinearLaw(
    "tank",
    ("g", "t0", "w", "delta", "b", "q", "c", "d", "m"),
    (1154.0, 390.0, 1430.0, 0.0, 0.457, 0.6, 0.0, 313.9, 1.0),  # the reference tank's components
    3,
    _predict_tank,
)
# One standard deviation of what a builder's tank may differ from that by: coils and capacitors of 10-20 %, tuned.
TANK_PRIOR = (250.0, 60.0, 400.0, 300.0, 0.3, 0.4, 100.0, 100.0, 0.4)
TANK_ROUNDS = 12  # each shrinks the fixed point's error by more than 4


def _fit_nonlinear(law: _NonlinearLaw, points: Points) -> Regression:
    _require(points, law.name, len(law.names), law.powers)
    start = np.array(law.start)
    scale = np.maximum(np.abs(start), 1.0)
    temp_c, p, error = points.temp_c, points.power, points.error

    def residual(x: Array) -> Array:
        return np.asarray(law.predict(x * scale, temp_c, p) - error)

    solution = optimize.least_squares(residual, start / scale, method="lm", xtol=1e-14, ftol=1e-14)
    if not solution.success:
        raise FitError(f"the fit of law {law.name} did not converge: {solution.message}")
    beta = solution.x * scale
    jacobian = np.asarray(solution.jac) / scale
    return _statistics(
        law.name, law.names, beta, jacobian, error=error, predicted=law.predict(beta, temp_c, p)
    )


def fit_exp(points: Points) -> Regression:
    """The four-parameter law.  Raises FitError if the data cannot support it."""
    return _fit_nonlinear(EXP_LAW, points)


def fit_tank(points: Points) -> Regression:
    """The tank law: three powers or more.  Raises FitError if the data cannot support it."""
    law = TANK_LAW
    _require(points, law.name, len(law.names), law.powers)
    start, spread = np.array(law.start), np.array(TANK_PRIOR)
    temp_c, p, error = points.temp_c, points.power, points.error

    def solve(x0: Array, noise: float) -> tuple[Array, Array]:
        def residual(x: Array) -> Array:
            return np.concatenate([(law.predict(start + x * spread, temp_c, p) - error) / noise, x])

        solution = optimize.least_squares(residual, x0, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=4000)
        if not solution.success:
            raise FitError(f"the fit of law tank did not converge: {solution.message}")
        return solution.x, np.asarray(solution.jac)

    x = np.zeros(start.size)
    noise = 1.0
    for _ in range(3):  # the priors' weight depends on the data's own scatter
        x, jacobian = solve(x, noise)
        left = law.predict(start + x * spread, temp_c, p) - error
        noise = max(0.02, float(np.sqrt(left @ left / max(1, len(points) - start.size))))
    beta = start + x * spread
    std_error = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) * spread
    plain = _statistics(
        "tank",
        law.names,
        beta,
        jacobian[: len(points)] * noise / spread,
        error=error,
        predicted=law.predict(beta, temp_c, p),
    )
    names = zip(law.names, beta, std_error, strict=True)
    return replace(plain, coefficients=tuple(Coefficient(n, float(e), float(s)) for n, e, s in names))


FITTERS: dict[str, Callable[[Points], Regression]] = {"eq5": fit_eq5, "exp": fit_exp, "tank": fit_tank}


# ---------------------------------------------------------------------------------------- inversion


def predict(law: str, coefficients: dict[str, float], temp_c: Array, phase_ticks: Array) -> Array:
    """Error (units) a law gives at temp_c and phase_ticks."""
    p = power_of_ticks(phase_ticks)
    if law == "eq5":
        n = np.asarray(phase_ticks, dtype=float)
        k = coefficients
        base = k["C"] + k["B"] * n + k["BB"] * n**2
        return np.asarray(base + temp_c * (k["A"] + k["AB"] * n + k["ABB"] * n**2))
    model = {"exp": EXP_LAW, "tank": TANK_LAW}[law]
    return model.predict(np.array([coefficients[name] for name in model.names]), np.asarray(temp_c), p)


def invert(law: str, coefficients: dict[str, float], error: Array, phase_ticks: Array) -> Array:
    """Temperature (degC) from error; NaN where the law has no answer."""
    k, p = coefficients, power_of_ticks(phase_ticks)
    if law == "eq5":
        n = np.asarray(phase_ticks, dtype=float)
        slope = k["A"] + k["AB"] * n + k["ABB"] * n**2
        return np.where(slope > 0, (error - k["C"] - k["B"] * n - k["BB"] * n**2) / slope, np.nan)
    if law == "exp":
        return np.asarray((error - k["c"] - k["d"] * p) / (k["a"] * np.exp(-k["b"] * p)))
    psi = (error - k["c"] - k["d"] * np.exp(-k["m"] * p)) / k["g"]
    valid = np.abs(psi) < PSI_MAX_RAD
    psi = np.where(valid, psi, 0.0)
    u = (np.sin(0.5 * np.pi * np.sqrt(p)) * np.cos(psi)) ** 2
    growth = np.exp(k["b"] * u + k["q"] * u**4)
    return np.where(valid, k["t0"] + (k["w"] * np.tan(psi) - k["delta"]) * growth, np.nan)


def temperature_residuals(law: str, coefficients: dict[str, float], points: Points) -> Array:
    """Inverted minus reference temperature at each point, degC, shape (n,)."""
    return np.asarray(invert(law, coefficients, points.error, points.phase_ticks) - points.temp_c)
