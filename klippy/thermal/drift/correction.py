"""Corrects the sensing law by what drift_observer.py finds: which witness is asked when, and how fast the law follows.

    heater off      readings of a nozzle at rest against the room (rest.py): the automatic zero
    heater on       k of the looks, gain of the drive, heat balance
    correction      at once with the heater off, quickly on the way, slowly near the target

A first heat waits up to WAIT_S if the cold reading is off the room's temperature and nobody knows yet why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from thermal.drift import observer
from thermal.drift.observer import DriftParameters, DriftState
from thermal.drift.rest import NEAR_C, NEAR_SIGMA_C, Rest
from thermal.sensing.block_temperature import EstimatorParameters
from thermal.sensing.blocks import Blocks
from thermal.sensing.heat_balance_monitor import HeatBalanceParameters
from thermal.sensing.laws import TankLaw

# A zero farther off is another nozzle or coil. Readings below the room's may be raised further: that heats less.
ZERO_LOW_C, ZERO_HIGH_C = -150.0, 60.0
LEVER_EXPONENT = 2.6  # drive_offset.h: h = (phase/phase_max)^2.6
BALANCE_EACH_S, BALANCE_SIGMA_C = 12.0, 2.0  # the heat balance averages over this time
CALIBRATED_C = 1.0  # what a calibration leaves
ZERO_SIGMA_C = 1.5  # the excess at rest must be known so well
ZERO_EACH_S = 60.0
WAIT_S = 3.0
LOOKS_EACH_S = 0.1
LOOKS_SIGMA_C = 8.0  # k in more doubt says nothing
WAY_C = 20.0  # farther from the target than this is the way to it
WAY_C_S, NEAR_C_S = 20.0, 0.2  # the correction moves so fast ...
MOVE_C, DOUBT_C = 2.0, 4.0  # ... once the estimate is farther away than its doubt, within these limits ...
MOVED_C = 0.3  # ... until it is as near as that
NAMED_C = 10.0  # drift beyond this is named, if it is surely so much


@dataclass(slots=True)
class DriftMemory:
    """Times are print times."""

    state: DriftState = field(default_factory=DriftState)
    rest: Rest = field(default_factory=Rest)
    applied_c: float = 0.0
    is_moving: bool = False
    time_s: float = math.nan  # of the state
    zeroed_s: float = -math.inf
    judged_s: float = -math.inf  # newest reading at rest that has been asked
    since_s: float = math.nan  # target on, or off
    looked_s: float = -math.inf  # newest look that has been asked
    balanced_s: float = -math.inf
    is_on: bool = False
    is_calibrated: bool = False  # just now: nothing has drifted yet


def tau_s(balance: HeatBalanceParameters) -> float:
    """Of a nozzle that cools near the room's temperature, with its second mass."""
    loss = balance.loss
    return (balance.heat.at_25c_j_k + loss.second_j_k) / loss.slope_w_k(loss.ambient_c)


def begin(p: DriftParameters, m: DriftMemory, time_s: float) -> None:
    """Nothing is known of the nozzle."""
    m.state, m.time_s = observer.fresh(p), time_s
    m.rest.restart()
    m.zeroed_s = m.judged_s = m.looked_s = m.balanced_s = -math.inf
    m.since_s, m.is_on = time_s, False
    if m.is_calibrated:
        m.state.p[observer.DRIFT][observer.DRIFT] = CALIBRATED_C**2
        m.zeroed_s = time_s


def advance(p: DriftParameters, m: DriftMemory, time_s: float, heat_j: float) -> None:
    if math.isnan(m.time_s):
        begin(p, m, time_s)
    if time_s > m.time_s:
        observer.advance(p, m.state, time_s - m.time_s, heat_j)
        m.time_s = time_s


def note_target(m: DriftMemory, is_on: bool, time_s: float) -> bool:
    """Was the target turned on or off?"""
    if is_on == m.is_on:
        return False
    m.is_on, m.since_s = is_on, time_s
    if not is_on:
        m.rest.restart()
    return True


def note_rest(m: DriftMemory, estimator: EstimatorParameters, raw_blocks: Blocks) -> None:
    """Blocks with the heater off, or before the first heat. A reading outside the law's range counts, too."""
    law = estimator.law
    for b in raw_blocks.raw[0 : raw_blocks.count]:
        if b.phase_ticks != estimator.phase_low_ticks or b.lost or not 0 < b.min_raw <= b.max_raw < 4095:
            continue
        temp_c, c_per_unit = law.invert(b.signal_units, b.phase_ticks, estimator.supply)
        if math.isfinite(temp_c):
            m.rest.note(b.centre_s, temp_c, b.noise_units * c_per_unit, b.heat_w * b.duration_s)


def zero(p: DriftParameters, m: DriftMemory, balance: HeatBalanceParameters, time_s: float) -> bool:
    """The automatic zero, if it is due and the nozzle's rest is known well enough."""
    newest_s = m.rest.readings[-1][0] if m.rest.readings else m.judged_s
    is_late = m.is_on and time_s - m.since_s > WAIT_S  # what is known has to do
    if (newest_s == m.judged_s and not is_late) or time_s - m.zeroed_s < ZERO_EACH_S:
        return False
    m.judged_s = newest_s
    excess_c, sigma_c = m.rest.excess_c(tau_s(balance), balance.heat.at_25c_j_k, p.room_c)
    if sigma_c == math.inf:
        return False
    off_c = m.rest.mean_c() - p.room_c - excess_c
    is_colder = off_c < -NEAR_C and m.rest.is_still()  # so cold a reading is no warm nozzle's
    if not (sigma_c <= ZERO_SIGMA_C or is_late or is_colder):
        return False
    if not ZERO_LOW_C <= off_c <= ZERO_HIGH_C:
        return False
    observer.cold_zero(m.state, off_c, sigma_c)
    m.zeroed_s = time_s
    return True


def glance(p: DriftParameters, m: DriftMemory) -> None:
    """Heat goes in before the rest is known: a reading near the room's is that of a cold nozzle."""
    if m.zeroed_s == -math.inf and m.rest.has_any():
        off_c = m.rest.mean_c() - p.room_c
        if abs(off_c) <= NEAR_C:
            observer.cold_zero(m.state, off_c, NEAR_SIGMA_C)


def waits(p: DriftParameters, m: DriftMemory, time_s: float) -> bool:
    """Is the first heat to wait for the zero? `m.since_s`: when the target was turned on."""
    if m.zeroed_s > -math.inf or not m.is_on or time_s - m.since_s > WAIT_S:
        return False
    if not m.rest.has_any():
        return True
    off_c = m.rest.mean_c() - p.room_c
    return ZERO_LOW_C < off_c < -NEAR_C or NEAR_C < off_c < ZERO_HIGH_C


def is_detuned(m: DriftMemory, low_c: float) -> bool:
    """Does a nozzle at rest that has no zero yet read so cold as a detuned tank does?"""
    return m.zeroed_s == -math.inf and m.rest.has_any() and ZERO_LOW_C < m.rest.mean_c() < low_c


def note_looks(
    p: DriftParameters,
    m: DriftMemory,
    estimator: EstimatorParameters,
    d: Any,
    temp_c: float,
    phase_max: float,
) -> None:
    """k of the looks, when it has learned something. `d`: C's struct drive_offset."""
    if d.look_s - m.looked_s < LOOKS_EACH_S or not isinstance(estimator.law, TankLaw):
        return
    m.looked_s = d.look_s
    if d.variance > LOOKS_SIGMA_C**2:
        return
    observer.looks(
        p,
        m.state,
        estimator.law,
        m.applied_c,
        d.full_c * d.look,
        math.sqrt(d.variance) * d.look,
        temp_c=temp_c,
        lever=d.look,
        strong=phase_max * d.look ** (1.0 / LEVER_EXPONENT),
        weak=estimator.phase_low_ticks,
        supply=estimator.supply,
    )


def note_balance(m: DriftMemory, drift_c: float | None) -> None:
    """The corrected reading less what the heat balance says; None: it says nothing now."""
    if drift_c is None or m.time_s - m.balanced_s < BALANCE_EACH_S:
        return
    m.balanced_s = m.time_s
    observer.heat_balance(m.state, drift_c + m.applied_c, BALANCE_SIGMA_C)


def follow(m: DriftMemory, dt_s: float, below_c: float) -> float:
    """The correction from now on, `below_c` under the target; infinite: no heat goes in.

    It moves only when the estimate is farther away than its own doubt, and then all the way: noise moves nothing.
    """
    off_c = m.state.drift_c - m.applied_c
    m.is_moving = abs(off_c) > (MOVED_C if m.is_moving else max(MOVE_C, min(m.state.sigma_c, DOUBT_C)))
    if not m.is_moving:
        return m.applied_c
    step_c = math.inf if below_c == math.inf else dt_s * (WAY_C_S if below_c > WAY_C else NEAR_C_S)
    return m.applied_c + max(-step_c, min(step_c, off_c))


def corrected(estimator: EstimatorParameters, applied_c: float) -> EstimatorParameters:
    """With the law that is in use."""
    return replace(estimator, law=estimator.law.drifted(applied_c)) if applied_c else estimator


def warning(m: DriftMemory) -> str:
    """Text for people, "" for a thermometer that is as calibrated."""
    drift_c, sigma_c = m.state.drift_c, m.state.sigma_c
    if abs(drift_c) - sigma_c <= NAMED_C:
        return ""
    return (
        f"the thermometer has drifted by {drift_c:+.0f} C (within {2.0 * sigma_c:.0f} C); the reading is corrected."
        " Check with a reference, then run INDUCTION_ZERO or INDUCTION_CALIBRATE"
    )
