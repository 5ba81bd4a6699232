"""Fitting thermistor models to a table of temperature against resistance or voltage (offline; numpy, scipy).

Three models, each by least squares or by a particle swarm that minimises the same fitness:

    beta        R = R25 * exp(beta * (1/T - 1/298.15 K))                 T in kelvin
    steinhart   1/T = A + B*ln R + C*(ln R)**3                           Steinhart and Hart, 1968
    polynomial  T' = a2*u**2 + a1*u + a0, u the divider's voltage        Liu, Chen, Chen 2019, eq 2

The fitness is eq 3 of the same source, in degC:  sqrt(sum((T' - T)**2) / (N - 1)).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyswarm
from numpy.typing import NDArray

Array = NDArray[np.float64]

ZERO_K = -273.15
T25_K = 298.15
BOX_C = 10.0  # half width of the swarm's search box, in degC of fitness along each direction
SWARM = {"swarmsize": 40, "maxiter": 200, "omega": 0.7, "phip": 1.5, "phig": 1.5, "minstep": 1e-12}


class ThermistorFitError(ValueError):
    """The table cannot support the fit; the text says why."""


@dataclass(frozen=True, slots=True)
class Divider:
    """Pull-up from the thermistor to the supply, and an optional resistor parallel to the thermistor."""

    pullup_ohm: float
    supply_v: float
    parallel_ohm: float = float("inf")

    def volts(self, ohm: Array) -> Array:
        load = 1.0 / (1.0 / ohm + 1.0 / self.parallel_ohm)
        return np.asarray(self.supply_v * load / (load + self.pullup_ohm))

    def ohms(self, volts: Array) -> Array:
        """Thermistor resistance; raises ThermistorFitError for a voltage that this circuit cannot give."""
        if np.any(volts <= 0) or np.any(volts >= self.supply_v):
            raise ThermistorFitError(f"voltages must lie between 0 and the supply of {self.supply_v:g} V")
        load = self.pullup_ohm * volts / (self.supply_v - volts)
        if np.any(load >= self.parallel_ohm):
            raise ThermistorFitError(
                f"a voltage is higher than the parallel {self.parallel_ohm:g} ohm allows"
            )
        return np.asarray(1.0 / (1.0 / load - 1.0 / self.parallel_ohm))


@dataclass(frozen=True, slots=True)
class Model:
    """A thermistor model: its coefficients' names, its temperature, and its least squares."""

    names: tuple[str, ...]
    temperature_c: Callable[
        [Array, Array], Array
    ]  # (coefficients, x) -> degC; x in ohm, or volt for polynomial
    least_squares: Callable[[Array, Array], Array]  # (x, temp_c) -> coefficients


@dataclass(frozen=True, slots=True)
class ThermistorFit:
    model: str
    method: str
    coefficients: dict[str, float]
    fitness_c: float  # eq 3
    residual_c: Array  # model minus table, shape (n,)


def fitness(residual_c: Array) -> float:
    """Eq 3, degC."""
    return float(np.sqrt(residual_c @ residual_c / (residual_c.size - 1)))


def _lstsq(columns: list[Array], target: Array) -> Array:
    design = np.column_stack(columns)
    scale = np.abs(design).max(axis=0)
    return np.asarray(np.linalg.lstsq(design / scale, target, rcond=None)[0] / scale)


def _beta_temperature(k: Array, ohm: Array) -> Array:
    inverse = 1.0 / T25_K + np.log(ohm / k[1]) / k[0]
    return np.asarray(1.0 / inverse + ZERO_K)


def _beta_lsq(ohm: Array, temp_c: Array) -> Array:
    """ln R on 1/T: the noise of a table read with a multimeter is relative in R."""
    inverse = 1.0 / (temp_c - ZERO_K)
    intercept, beta = _lstsq([np.ones_like(ohm), inverse], np.log(ohm))
    return np.array([beta, np.exp(intercept + beta / T25_K)])


def _steinhart_temperature(k: Array, ohm: Array) -> Array:
    log = np.log(ohm)
    return np.asarray(1.0 / (k[0] + k[1] * log + k[2] * log**3) + ZERO_K)


def _steinhart_lsq(ohm: Array, temp_c: Array) -> Array:
    log = np.log(ohm)
    return _lstsq([np.ones_like(log), log, log**3], 1.0 / (temp_c - ZERO_K))


def _polynomial_temperature(k: Array, volts: Array) -> Array:
    return np.asarray(np.polyval(k, volts))


def _polynomial_lsq(volts: Array, temp_c: Array) -> Array:
    return _lstsq([volts**2, volts, np.ones_like(volts)], temp_c)


MODELS: dict[str, Model] = {
    "beta": Model(("beta", "r25"), _beta_temperature, _beta_lsq),
    "steinhart": Model(("a", "b", "c"), _steinhart_temperature, _steinhart_lsq),
    "polynomial": Model(("a2", "a1", "a0"), _polynomial_temperature, _polynomial_lsq),
}


def evaluate(model: str, coefficients: dict[str, float], x: Array, temp_c: Array) -> ThermistorFit:
    """A given set of coefficients (e.g. published ones) judged on a table."""
    k = np.array([coefficients[name] for name in MODELS[model].names])
    residual = MODELS[model].temperature_c(k, x) - temp_c
    return ThermistorFit(model, "given", dict(coefficients), fitness(residual), residual)


def _search_box(model: Model, centre: Array, x: Array) -> Array:
    """Directions of the swarm's box, shape (k, k): along each of them the fitness changes by BOX_C alone.

    The coefficients themselves are so correlated that a swarm in their own axes ends in a narrow valley.
    """
    steps = 1e-4 * np.abs(centre)
    nominal = model.temperature_c(centre, x)
    jacobian = np.column_stack(
        [(model.temperature_c(centre + step, x) - nominal) / step[i] for i, step in enumerate(np.diag(steps))]
    )
    scale = np.abs(jacobian).max(axis=0)
    upper = np.linalg.qr(jacobian / scale, mode="r")
    return np.asarray(BOX_C * np.sqrt(x.size - 1) * np.linalg.inv(upper) / scale[:, None])


def _swarm(model: Model, x: Array, temp_c: Array, seed: int) -> Array:
    centre = model.least_squares(x, temp_c)
    directions = _search_box(model, centre, x)

    def objective(unit: Array) -> float:
        with np.errstate(all="ignore"):
            value = fitness(model.temperature_c(centre + directions @ unit, x) - temp_c)
        return value if np.isfinite(value) else 1e9

    best = pyswarm.pso(objective, lb=[-1.0] * centre.size, ub=[1.0] * centre.size, seed=seed, **SWARM)
    return np.asarray(centre + directions @ np.asarray(best[0] if isinstance(best, tuple) else best.x))


def fit_thermistor(model: str, method: str, x: Array, temp_c: Array, seed: int = 1) -> ThermistorFit:
    """Fit `model` by `method` ("lsq" or "pso").

    x: resistance in ohm (beta, steinhart) or voltage in V (polynomial), shape (n,); temp_c: degC, shape (n,).
    Raises ThermistorFitError if the table is too small or not physical.
    """
    shape = MODELS[model]
    if x.size <= len(shape.names):
        raise ThermistorFitError(f"{model} has {len(shape.names)} coefficients: {x.size} rows are too few")
    if not (np.isfinite(x).all() and np.isfinite(temp_c).all()) or np.any(x <= 0) or np.any(temp_c <= ZERO_K):
        raise ThermistorFitError("every row needs a positive resistance or voltage and a real temperature")
    if np.ptp(temp_c) < 5.0:
        raise ThermistorFitError(f"the table spans only {np.ptp(temp_c):.1f} degC")
    k = shape.least_squares(x, temp_c) if method == "lsq" else _swarm(shape, x, temp_c, seed)
    residual = shape.temperature_c(k, x) - temp_c
    coefficients = {name: float(v) for name, v in zip(shape.names, k, strict=True)}
    return ThermistorFit(model, method, coefficients, fitness(residual), residual)
