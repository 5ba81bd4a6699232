"""The plant that would have given a recorded run: least squares with the plant itself as the model.

    x ─► parameters ─► plant along the recorded drive ─► codes ─► (recorded - simulated)/sigma

What a run determines (docs/theory/Identification.md): C dT/dt = efficiency P(phase) - losses - melt has one scale. Only
a heat known in watts fixes it: that of the filament, or a given parameter. A parameter whose standard error stays near
its prior is held at its start and named. Without a scale mass_factor is held first: the others are then ratios to it.

Some errors last longer than a block: of the sensing law, of heat that the model does not know, of the time at which the
fan changes. They are found along with the parameters, so that the standard errors include them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simulation.world import parameter_tables
from thermal.models.heat_loss import loss_w

from . import signal
from .recording import Array, Recording

# Of the prior: not determined beyond it. The priors of the five heats that share a scale leave 0.45 without one.
DOUBT = 0.4
WINDOW_S = 1.0  # residuals within it count as one if they agree
HEAT_SHARE, HEAT_S = 0.01, 1.0  # unknown heat: 1 sigma over the losses when hot, for so long
RETURN_S = 8.0  # heat capacity over losses and melt: how long such heat is felt
DELAY_S, DELAYS_MAX = 2.0, 6  # of a change of the fan behind its record: moves in the queue come first
SPIN_UP_S = 0.2  # of a fan
STEP = 1e-5  # of a prior's width, for derivatives; larger ones leave a scale where there is none
TOLERANCE = 1e-5  # of a mean square: its end is far nearer than one standard error
ROUNDS_MAX, DAMPING_MAX = 60, 1e8
BLURS = (300.0, 30.0, 3.0)
SCALE = "mass_factor"


@dataclass(frozen=True, slots=True)
class Free:
    """A parameter to be found. `prior`: 1 sigma about the start, a logarithm if `relative`, else in its unit."""

    name: str
    prior: float
    relative: bool
    needs: str  # what determines it in a run

    def value(self, start: float, x: float) -> float:
        return start * math.exp(self.prior * x) if self.relative else start + self.prior * x


FREE = (
    Free(SCALE, 1.0, True, "a heat-up, and for the scale of all heat extrusion"),
    Free("efficiency_factor", 1.0, True, "a heat-up, and for the scale of all heat extrusion"),
    Free("heat_exponent", 0.15, False, "a heat-up at high power and holding at low power"),
    Free("loss_factor", 1.0, True, "holding and cooling"),
    Free("second_j_k", 1.0, True, "ten seconds after a heat-up"),
    Free("melt_ua_w_k", 1.0, True, "slow and fast extrusion"),
    Free("fan_w_k", 1.0, True, "a change of the part fan"),
    Free("supply_v", 0.05, True, "readings at high and low power"),
    Free("c1_factor", 0.005, False, "readings at high and low power; stands for all detuning"),
    Free("ambient_c", 20.0, False, "readings of the cold nozzle"),
)


@dataclass(frozen=True, slots=True)
class Found:
    """One parameter. `sigma`: its standard error in its unit; NaN: not determined, `value` is the start."""

    name: str
    value: float
    sigma: float
    needs: str


@dataclass(frozen=True, slots=True)
class Fit:
    """The plant, and what it says of each step of the run."""

    found: tuple[Found, ...]
    fixed: Mapping[str, float]  # law, drive and what was given
    temp_c: Array  # of the simulated signal by the law, NaN where nothing was measured

    def changes(self) -> dict[str, float]:
        """All that differs from the preset."""
        return _at_start({**self.fixed, **{f.name: f.value for f in self.found}})


def _at_start(changes: dict[str, float]) -> dict[str, float]:
    """A run begins with all of the nozzle at the temperature of the room."""
    return {**changes, "start_c": changes["ambient_c"]} if "ambient_c" in changes else changes


class _Problem:
    """Residuals over x: the parameters, the fan's delays and the errors that last, all in units of their priors."""

    def __init__(self, run: Recording, fixed: Mapping[str, float], free: tuple[Free, ...]) -> None:
        self.run, self.fixed, self.free = run, fixed, free
        table = parameter_tables()["nozzle"]
        self.start = {f.name: fixed.get(f.name, table[f.name].presets["reference"]) for f in free}
        self.rows = np.flatnonzero(np.isfinite(run.raw))
        self.sigma = run.sigma_raw[self.rows]
        self.fan_rows = np.flatnonzero(np.diff(run.steps[:, 3]) != 0.0) + 1
        self.errors = self._law_errors()
        self.first_error = len(free) + min(len(self.fan_rows), DELAYS_MAX)

    def _per_units(self, units: Array) -> Array:
        return units / (self.run.parameters.front.units_per_lsb * self.sigma)[:, None]

    def _law_errors(self) -> Array:
        """The law is off by low orders of temperature and drive; a column each, in sigma of a reading."""
        run = self.run
        temp = run.temp_c[self.rows] / 200.0 - 1.0
        drive = 2.0 * (run.steps[self.rows, 1] / run.parameters.front.phase_max_ticks) ** 2 - 1.0
        surface = np.column_stack([np.ones_like(temp), temp, drive, temp * drive, temp**2, drive**2])
        return self._per_units(run.parameters.estimator.law.residual_units * surface)

    def add_heat_errors(self) -> None:
        """Unknown heat, in pieces one after another; each warms the nozzle and is lost again."""
        run = self.run
        heat_w = HEAT_SHARE * loss_w(run.parameters.loss, float(np.nanmax(run.temp_c)))
        rise_k_s = heat_w / run.parameters.filter.heat.at_25c_j_k
        pieces = np.floor(run.end_s / HEAT_S).astype(int)
        warmer_c, now_c = np.zeros((len(pieces), pieces[-1] + 1)), np.zeros(pieces[-1] + 1)
        for i, (piece, lasts_s) in enumerate(zip(pieces.tolist(), run.steps[:, 0].tolist(), strict=True)):
            now_c *= math.exp(-lasts_s / RETURN_S)
            now_c[piece] += rise_k_s * lasts_s
            warmer_c[i] = now_c
        units = warmer_c[self.rows] / run.c_per_unit[self.rows, None]
        self.errors = np.column_stack([self.errors, self._per_units(units)])

    def size(self) -> int:
        return self.first_error + self.errors.shape[1]

    def changes(self, x: Array) -> dict[str, float]:
        values = zip(self.free, x.tolist(), strict=False)
        return _at_start({**self.fixed, **{f.name: f.value(self.start[f.name], v) for f, v in values}})

    def steps(self, x: Array) -> Array:
        """The drive, each change of the fan as late as x says; the last delay holds for all further changes."""
        steps, fan = self.run.steps.copy(), self.run.steps[:, 3]
        middle_s, changed = self.run.end_s - 0.5 * steps[:, 0], fan[0] * np.ones(len(fan))
        for number, row in enumerate(self.fan_rows):
            delay_s = DELAY_S * x[len(self.free) + min(number, DELAYS_MAX - 1)]
            since_s = np.maximum(0.0, middle_s - middle_s[row] - delay_s)
            changed -= (fan[row] - fan[row - 1]) * np.expm1(-since_s / SPIN_UP_S)
        steps[:, 3] = np.clip(changed, 0.0, 1.0)
        return steps

    def plant(self, x: Array) -> Array:
        """The code of each step."""
        return signal.follow(self.changes(x), self.steps(x))

    def residual(self, x: Array) -> Array:
        wrong = (self.run.raw - self.plant(x))[self.rows] / self.sigma
        return np.concatenate([wrong - self.errors @ x[self.first_error :], x])

    def jacobian(self, x: Array) -> Array:
        out = np.zeros((len(self.rows) + self.size(), self.size()))
        here = self.plant(x)
        for i in range(self.first_error):
            there = self.plant(x + STEP * np.eye(1, self.size(), i)[0])
            out[: len(self.rows), i] = (here - there)[self.rows] / self.sigma / STEP
        out[: len(self.rows), self.first_error :] = -self.errors
        out[len(self.rows) :] = np.eye(self.size())
        return out

    def minimised(self, x: Array, blur: float = 1.0) -> tuple[Array, Array, Array]:
        """Levenberg and Marquardt's way from x to the least squares: x, its residuals and J'J there.

        With a blur readings weigh less: their priors hold the weakly determined parameters until the others are near.

        The normal equations are well conditioned in units of the priors, and ten times faster than scipy's SVD.
        """
        weight = np.concatenate([np.full(len(self.rows), 1.0 / blur), np.ones(self.size())])
        damping, residual = 1e-3, weight * self.residual(x)
        for _ in range(ROUNDS_MAX):
            jacobian = weight[:, None] * self.jacobian(x)
            normal, slope = jacobian.T @ jacobian, jacobian.T @ residual
            while damping < DAMPING_MAX:
                step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -slope)
                trial = weight * self.residual(x + step)
                gain = float(residual @ residual - trial @ trial)
                if gain >= 0.0:
                    break
                damping *= 10.0
            else:
                break
            x, residual, damping = x + step, trial, 0.1 * damping
            if gain < TOLERANCE * len(residual):
                break
        return x, residual, normal

    def solve(self) -> tuple[Array, Array]:
        """x and the standard errors of the parameters in it."""
        x = np.zeros(self.size())
        x[len(self.free) : self.first_error] = 1.0
        for blur in BLURS:
            x = self.minimised(x, blur)[0]
        self.add_heat_errors()  # only now: they would take the place of a fan that is far from its time
        x, residual, normal = self.minimised(np.concatenate([x, np.zeros(self.size() - len(x))]))
        wrong = residual[: len(self.rows)]
        windows = np.bincount((self.run.end_s[self.rows] / WINDOW_S).astype(int), wrong)
        inflation = max(1.0, float(np.sum(windows**2)) / len(self.rows))
        variance = np.diag(np.linalg.inv(normal))
        return x, np.sqrt(np.minimum(1.0, inflation * variance))[: len(self.free)]


def fit(run: Recording, given: Mapping[str, float]) -> Fit:
    """The plant of a run; parameters in `given` are known. Raises RunError."""
    fixed = {**signal.tank_of(run.parameters), **given}
    free = tuple(f for f in FREE if f.name not in given)
    unknown: list[Free] = []
    while True:
        problem = _Problem(run, fixed, free)
        x, sigma = problem.solve()
        doubtful = [f for f, s in zip(free, sigma, strict=True) if s > DOUBT]
        if not doubtful:
            break
        held = [f for f in doubtful if f.name == SCALE] or doubtful
        unknown += held
        fixed = {**fixed, **{f.name: problem.start[f.name] for f in held}}
        free = tuple(f for f in free if f not in held)
    values = problem.changes(x)
    known = {
        f.name: Found(f.name, values[f.name], s * f.prior * (values[f.name] if f.relative else 1.0), f.needs)
        for f, s in zip(free, sigma.tolist(), strict=True)
    }
    known |= {f.name: Found(f.name, fixed[f.name], math.nan, f.needs) for f in unknown}
    noise = Found("noise_lsb", run.noise_lsb, run.noise_sigma_lsb, "blocks at one phase")
    found = (*(known[f.name] for f in FREE if f.name in known), *(() if "noise_lsb" in given else (noise,)))
    return Fit(found, fixed, run.temperature(problem.plant(x))[0])
