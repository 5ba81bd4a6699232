"""How far off is the thermometer? A Kalman filter over what drifts, fed by everything that shows it.

    drift      error of the reading at the sensing phase, degC: capacitor, choke, crystal, cable, delays
    supply     error of the assumed supply voltage, relative
    copper     error of the assumed resistance of the tank, relative: the coil warms with use
    balance    error of the heat balance, degC: losses, melt and fan are not known better
    law        error of the sensing law at the strong drive, degC of k
    ambient    error of the assumed room temperature, degC

Witnesses, each of a part of them:

    cold zero      reading of a rested nozzle less room temperature     = drift + ambient
    looks          k, what full drive adds to the reading               = f(drift, supply, copper) + law
    heat balance   reading less the temperature that explains the heat  = drift + balance

The errors that stay the same from one measurement to the next are states of their own: repeating a measurement does
not average them away. f is asked of the sensing law: 0.1 % of C1 is 15 degC of drift and 29 degC of k.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from thermal.sensing.laws import TankLaw

DRIFT, SUPPLY, COPPER, WARMTH, BALANCE, LAW, AMBIENT = range(7)
COUNT = 7
GATE_SIGMA = 4.0  # farther off than this: the state is wrong, not the witness
STEP_C, STEP_SHARE = 1.0, 0.002  # for derivatives of k
COIL_S = 20.0  # the coil cools within this time
LAW_C, LAW_LEVER = 60.0, 0.5  # the law's error is another one this far off, in temperature and drive
LAW_SAME = 0.1  # nearer than this share of those it is the same: noise of a hold does not count
SCATTER_SHARE = 0.3  # a look's share in the mean square of what scatters


@dataclass(frozen=True, slots=True)
class DriftParameters:
    """Standard deviations: at the start, and of the walk within a second (each _walk)."""

    drift_c: float = 15.0  # 0.1 % of C1
    drift_walk_c: float = 0.3  # in a minute 2 degC: a capacitor of 100 ppm/K that warms by 1 K
    supply: float = 0.03  # measured: 0.003
    supply_walk: float = 2e-4
    copper: float = 0.005
    copper_walk: float = 2e-4
    warmth_per_j: float = 6e-4  # 6 % in a cold start, which warms the coil by 20 to 80 K
    power_max_w: float = 81.3
    balance_c: float = 30.0  # losses that are a sixth wrong, at 200 K above the room
    balance_walk_c: float = 0.1
    law_c: float = 6.0
    law_walk_c: float = 0.05
    room_c: float = 25.0
    ambient_c: float = 2.5  # of room_c; with a sensor 1.5
    ambient_walk_c: float = 0.02

    def start(self) -> list[float]:
        return [
            *(self.drift_c, self.supply, self.copper, self.warmth_per_j),
            *(self.balance_c, self.law_c, self.ambient_c),
        ]

    def walk(self) -> list[float]:
        return [
            self.drift_walk_c,
            self.supply_walk,
            self.copper_walk,
            0.0,
            self.balance_walk_c,
            self.law_walk_c,
            self.ambient_walk_c,
        ]


@dataclass(slots=True)
class DriftState:
    """Estimate and covariance."""

    x: list[float] = field(default_factory=lambda: [0.0] * COUNT)
    p: list[list[float]] = field(default_factory=lambda: [[0.0] * COUNT for _ in range(COUNT)])
    coil_j: float = 0.0  # heat that the coil has not lost yet, as share of the nozzle's
    looked_c: float = math.nan  # what was left of the newest look ...
    looked_at: tuple[float, float] = (math.nan, math.nan)  # ... and about its temperature and lever
    scatter_c2: float = 100.0  # mean square of its changes

    @property
    def drift_c(self) -> float:
        return self.x[DRIFT]

    @property
    def sigma_c(self) -> float:
        return math.sqrt(self.p[DRIFT][DRIFT])


def fresh(parameters: DriftParameters) -> DriftState:
    state = DriftState()
    for i, sigma in enumerate(parameters.start()):
        state.p[i][i] = sigma * sigma
    return state


def advance(parameters: DriftParameters, state: DriftState, dt_s: float, heat_j: float) -> None:
    """Time passes, and so much heat goes in."""
    for i, sigma in enumerate(parameters.walk()):
        state.p[i][i] += sigma * sigma * dt_s
    # The current's square goes with the 4/3 of the heat in the nozzle.
    full = min(1.0, heat_j / dt_s / parameters.power_max_w)
    state.coil_j += heat_j * full ** (1.0 / 3.0)
    state.coil_j *= math.exp(-dt_s / COIL_S)


def observe(state: DriftState, row: list[float], residual: float, sigma: float, blame: int) -> None:
    """A measurement `row . error of x`, by `residual` off the estimate's. Far off, the state `blame` has changed."""
    p = state.p
    for _ in range(2):
        spread_by = [sum(p[i][j] * row[j] for j in range(COUNT)) for i in range(COUNT)]
        spread = sum(row[i] * spread_by[i] for i in range(COUNT)) + sigma * sigma
        if residual * residual <= GATE_SIGMA**2 * spread:
            break
        p[blame][blame] += (residual / row[blame]) ** 2
    gain = [s / spread for s in spread_by]
    for i in range(COUNT):
        state.x[i] += gain[i] * residual
        for j in range(COUNT):
            p[i][j] -= gain[i] * spread_by[j]


def cold_zero(state: DriftState, off_c: float, sigma_c: float) -> None:
    """The law's own reading of a rested nozzle is `off_c` above the room."""
    row = [0.0] * COUNT
    row[DRIFT] = row[AMBIENT] = 1.0
    observe(state, row, off_c - state.x[DRIFT] - state.x[AMBIENT], sigma_c, DRIFT)


def heat_balance(state: DriftState, off_c: float, sigma_c: float) -> None:
    """The law's own reading is `off_c` above the temperature that explains the heat."""
    row = [0.0] * COUNT
    row[DRIFT] = row[BALANCE] = 1.0
    observe(state, row, off_c - state.x[DRIFT] - state.x[BALANCE], sigma_c, BALANCE)


def added_c(
    law: TankLaw, applied_c: float, x: list[float], temp_c: float, strong: float, weak: float, supply: float
) -> float:
    """What the reading at the phase `strong` is above that at `weak` (ticks), by the law corrected by `applied_c`,
    where the tank is off by `x`."""
    used = law.drifted(applied_c)
    tank = replace(law, delta=law.delta + x[DRIFT], w=law.w * (1.0 + x[COPPER]))
    volts = supply * (1.0 + x[SUPPLY]) / (1.0 + x[COPPER])
    high, low = (used.invert(tank.error(temp_c, phase, volts), phase, supply)[0] for phase in (strong, weak))
    return high - low


def _move_law(parameters: DriftParameters, state: DriftState, temp_c: float, lever: float) -> None:
    """The law's error is a smooth function of temperature and drive: elsewhere little of what was found remains."""
    before_c, before = state.looked_at
    away = abs(temp_c - before_c) / LAW_C + abs(lever - before) / LAW_LEVER
    if away < LAW_SAME:
        return
    state.looked_at = temp_c, lever
    if math.isnan(away):
        return
    keep = math.exp(-away)
    state.x[LAW] *= keep
    for i in range(COUNT):
        state.p[i][LAW] *= keep
        state.p[LAW][i] *= keep
    state.p[LAW][LAW] += (1.0 - keep * keep) * parameters.law_c**2


def looks(
    parameters: DriftParameters,
    state: DriftState,
    law: TankLaw,
    applied_c: float,
    measured_c: float,
    sigma_c: float,
    *,
    temp_c: float,
    lever: float,
    strong: float,
    weak: float,
    supply: float,
) -> None:
    """The reading at the phase `strong`, `lever` of full drive, has been `measured_c` above that at the sensing phase.

    Looks that scatter by more than `sigma_c` (ripple of the supply) are worth less: the mean square of what was not
    expected from one to the next says by how much.
    """
    _move_law(parameters, state, temp_c, lever)
    before = list(state.x)
    tank = list(state.x)
    tank[COPPER] += state.x[WARMTH] * state.coil_j
    expected_c = added_c(law, applied_c, tank, temp_c, strong, weak, supply)
    row = [0.0] * COUNT
    for i, step in ((DRIFT, STEP_C), (SUPPLY, STEP_SHARE), (COPPER, STEP_SHARE)):
        moved = list(tank)
        moved[i] += step
        row[i] = (added_c(law, applied_c, moved, temp_c, strong, weak, supply) - expected_c) / step
    row[WARMTH] = row[COPPER] * state.coil_j
    row[LAW] = lever
    residual = measured_c - expected_c - lever * state.x[LAW]
    if not (math.isfinite(residual) and all(map(math.isfinite, row))):
        return
    if not math.isnan(state.looked_c):
        state.scatter_c2 += SCATTER_SHARE * ((residual - state.looked_c) ** 2 - state.scatter_c2)
    observe(state, row, residual, math.hypot(sigma_c, math.sqrt(state.scatter_c2)), LAW)
    state.looked_c = residual - sum(r * (x - b) for r, x, b in zip(row, state.x, before, strict=True))
