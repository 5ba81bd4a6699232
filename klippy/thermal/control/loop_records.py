"""What the loop of one nozzle is given and what it remembers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from thermal.drift import correction as drift
from thermal.drift import observer as drift_observer
from thermal.models import heat_loss
from thermal.models.melt_exchange import MeltExchange
from thermal.records import PhaseCommand, Planned, PowerRequest, TempEstimate
from thermal.sensing import (
    block_temperature,
    features,
    heat_balance_monitor,
    laws,
    supervision,
    temperature_filter,
)

from . import actuator, control_api
from .timeline import Bridge, Timing

CALIBRATION = "calibration"  # name of the law that is a calibration's run

# Where a chain begins.
NO_REQUEST = PowerRequest(-math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOT_MEASURED = TempEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, 0, False, "not measured yet")


@dataclass(frozen=True, slots=True)
class Approach:
    """Less power near the target, where the temperature must be known well.

    The exp and eq5 laws rest on tables at 0.2, 10, 20 and 100 % power and are good to 2.5 degC up to 20 %;
    between 30 and 90 % the reference tank reads up to 25 degC too much. Full power is for the way, not for
    the arrival. A calibrated tank law follows the drive and arrives with more.
    """

    power_w: float = 42.2  # heat at 20 % power
    band_c: float = 45.0  # within this of the target: more than the laws err plus 50 ms of full power
    leave_c: float = 80.0  # hysteresis: farther than this is the way again

    # A step of p = (phase/45000)^2 by more than this moves the reading by degrees without any heat: not a
    # slope. Infinite: the sensing law follows the drive.
    rebase_fraction: float = 0.1


@dataclass(frozen=True, slots=True)
class Control:
    """A control law with its parameters; output in watts."""

    law: control_api.Law[Any, Any]
    parameters: Any
    power_max_w: float
    models: bool = False  # the law knows losses, delays and flow itself, and plans ahead
    # A law that swings is at its target from so far below on, and the target is so far below max_temp at most.
    cycle_c: float = 0.0
    beyond_c: float = 0.0


@dataclass(frozen=True, slots=True)
class LoopParameters:
    """All parameters of one nozzle's chain."""

    front: features.FeatureParameters
    estimator: block_temperature.EstimatorParameters
    control: Control
    loss: heat_loss.LossLaw
    actuator: actuator.ActuatorParameters
    supervise: supervision.SuperviseParameters
    timing: Timing
    approach: Approach
    filter: temperature_filter.FilterParameters
    heat_balance: heat_balance_monitor.HeatBalanceParameters
    melt: MeltExchange = field(default_factory=MeltExchange)
    drift: drift_observer.DriftParameters | None = None  # None: the law stays as it is

    @property
    def has_looks(self) -> bool:
        """Strong drives have looks at the sensing phase: with a calibrated tank law, which follows the drive."""
        calibrated = self.supervise.calibrated and isinstance(self.estimator.law, laws.TankLaw)
        return calibrated and self.actuator.look_s > 0.0

    @property
    def trusted_w(self) -> float:
        """The strongest drive at which the reading can be trusted; infinite: any."""
        law = self.estimator.law
        if not isinstance(law, laws.TankLaw) or law.table is None:
            return math.inf
        ticks = law.table.trusted_ticks()
        return math.inf if ticks >= self.actuator.law.phase_max_ticks else self.actuator.law.power_w(ticks)


class Ahead(NamedTuple):
    """What is known of the time ahead; set from outside."""

    reference: control_api.Reference | None  # wanted temperature
    flow: control_api.Schedule  # planned extrusion, mm^3/s
    fan: control_api.Schedule  # part fan, 0..1


new_ahead = partial(tuple.__new__, Ahead)


@dataclass(slots=True)
class LoopState:
    """Memory of the chain and what the status shows."""

    target_c: float = 0.0
    estimate: TempEstimate = NOT_MEASURED  # newest valid one
    request: PowerRequest = NO_REQUEST
    bridge: Bridge = field(default_factory=Bridge)  # commands sent, and what the actuator owes
    horizon: tuple[Planned, ...] = ()  # what the law means to do after its request
    decided_s: float = -math.inf  # last control step
    lapse_s: float = 0.0  # longest time without control or blocks since somebody set this to 0
    settled_s: float = math.inf  # since when the estimate has been near the target
    arriving: bool = False  # near the target, power limited
    law: Any = None  # memory of the control law
    supervise: supervision.SuperviseState = field(default_factory=supervision.SuperviseState)
    heat_balance: heat_balance_monitor.HeatBalanceState = field(
        default_factory=heat_balance_monitor.HeatBalanceState
    )
    balanced_s: float = -math.inf  # when that was
    drift: drift.DriftMemory = field(default_factory=drift.DriftMemory)
    is_waiting: bool = False  # no heat before the zero at rest
    warning: str = ""  # plausibility: text for people
    latency_s: float = 0.0  # newest: from the centre of a block to its value here

    @property
    def commanded(self) -> PhaseCommand:
        """Newest command sent; of a plan its first."""
        return self.bridge.head
