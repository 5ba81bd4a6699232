"""How slowly a hot layer has to be deposited: what is left when even the coolest melt of the window is too hot.

The coolest melt T0 on a substrate S makes the wanted interface I if S = 2 I - T0. In a stack that grows by d in each
time t, at the speed v = d/t, and is at S when the next road comes, what a road brings leaves through the top and, from
the stack below (a fin of the length l = 2 alpha/(sqrt(v^2 + 4 alpha m) - v)), through the flanks or stays behind:

    d (T0 - Te) = t a (S - Te + f) + t m l (S - Te) + t m d f       a = h/(rho c), m = a side
    f = (T0 - S) min(1, 2 d/sqrt(pi alpha t))                       mean of what is left of the fresh road's own excess

The t that fulfils it is `needed_age_s`: no layer may come sooner. (The map's stacks lose more than this fin. A tower
deposited at this age ends up to 13 degC cooler than S: the error is to the slow side.)

    age of the layer below = extrusion / speed_factor + all else (travel, what the file waits)
                             ─►  speed_factor, and a pause if that leaves the allowed range
Nothing cools below its surroundings: the goal is never nearer to them than `FUTILE_C`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from .deposit import Surroundings
from .materials import Material

# Within one layer the substrate differs by 10 degC either way (corners, where the head has just been). A speed factor
# that brings the wanted melt to the very edge of the window leaves half of the path beyond it.
ROOM_C = 10.0
FUTILE_C = 10.0  # substrate; waiting for the rest gains less than 5 degC at the weld, and takes ever longer
LONGEST_S = 300.0
WORTH_SHARE = 0.03  # a smaller change of speed_factor is not worth a seam
ENOUGH_MM = 5.0  # the age of the layer below needs at least this much path on it


class Ages(NamedTuple):
    """Path deposited on a layer below (mm), and sums over it (times mm): age of that layer, of this extrusion, and
    the same extrusion at full speed, s; open flanks per volume, 1/mm."""

    above_mm: float = 0.0
    age_s: float = 0.0
    depositing_s: float = 0.0
    full_speed_s: float = 0.0
    side_per_mm: float = 0.0

    def since(self, before: Ages) -> Ages:
        """What came after `before`."""
        return Ages(*(a - b for a, b in zip(self, before, strict=True)))


class Place(NamedTuple):
    """Where the layer lies: height of its top, its thickness, fan 0..1, open flanks per volume (2/width: a wall)."""

    z_mm: float
    thick_mm: float
    fan: float
    side_per_mm: float = 0.0


def needed_age_s(material: Material, around: Surroundings, place: Place, interface_c: float) -> float:
    """Age of the layer below at which a melt ROOM_C above the coolest makes the wanted interface, s."""
    melt_c, around_c = material.low_c + ROOM_C, around.around_c(place.z_mm)
    goal_c = max(2.0 * interface_c - melt_c, around_c + FUTILE_C)
    if goal_c >= melt_c:
        return 0.0
    alpha, thick_mm = 1e6 * material.diffusivity_m2_s, place.thick_mm
    h_w_m2k = around.still_w_m2k + place.fan * around.fan_w_m2k
    loss = 1e3 * h_w_m2k / (material.density_kg_m3 * material.heat_j_kgk)  # mm/s
    flanks_per_s = loss * place.side_per_mm
    low_s, high_s = 1e-3, LONGEST_S
    for _ in range(30):  # to a millionth of the first interval
        age_s = math.sqrt(low_s * high_s)
        speed = thick_mm / age_s
        fresh_c = (melt_c - goal_c) * min(1.0, 2.0 * thick_mm / math.sqrt(math.pi * alpha * age_s))
        top = loss * age_s * (goal_c - around_c + fresh_c)
        stack = (
            0.5
            * (speed + math.sqrt(speed * speed + 4.0 * alpha * flanks_per_s))
            * age_s
            * (goal_c - around_c)
        )
        left = top + stack + flanks_per_s * age_s * thick_mm * fresh_c
        enough = left >= thick_mm * (melt_c - around_c)
        low_s, high_s = (low_s, age_s) if enough else (age_s, high_s)
    return high_s


@dataclass(frozen=True, slots=True)
class LayerSpeed:
    """`factor`: part of the file's speed for extruding moves; `pause_s`: to wait before each layer."""

    factor: float = 1.0
    pause_s: float = 0.0


def next_speed(
    now: LayerSpeed, ages: Ages, needed_s: float, slowest: float, longest_pause_s: float
) -> LayerSpeed:
    """LayerSpeed of the next layer, if it is like the one that `ages` describes."""
    if ages.above_mm < ENOUGH_MM:
        return now
    age_s, depositing_s, full_speed_s = (value / ages.above_mm for value in ages[1:4])
    other_s = max(0.0, age_s - depositing_s - now.pause_s)
    room_s = needed_s - other_s
    factor = 1.0 if room_s <= full_speed_s else max(slowest, full_speed_s / room_s)
    missing_s = room_s - full_speed_s / factor
    pause_s = min(longest_pause_s, missing_s) if missing_s > WORTH_SHARE * needed_s else 0.0
    if abs(factor - now.factor) <= WORTH_SHARE * now.factor and factor < 1.0:
        factor = now.factor
    return LayerSpeed(factor, max(0.0, pause_s))


class LayerSpeeds:
    """Chooses the speed of each layer of one print."""

    def __init__(self, slowest: float, longest_pause_s: float) -> None:
        self.slowest = slowest
        self.longest_pause_s = longest_pause_s
        self.now = LayerSpeed()
        self._seen = Ages()

    @property
    def is_used(self) -> bool:
        """Do the limits allow any slowing down?"""
        return self.slowest < 1.0 or self.longest_pause_s > 0.0

    def layer(
        self, ages: Ages, interface_c: float, material: Material, around: Surroundings, place: Place
    ) -> LayerSpeed:
        """Speed of the layer that begins; `ages` since the beginning of the print. NaN: no interface is wanted."""
        recent = ages.since(self._seen)
        if math.isnan(interface_c):
            self.now = LayerSpeed()
        elif recent.above_mm >= ENOUGH_MM:
            self._seen = ages
            place = place._replace(side_per_mm=recent.side_per_mm / recent.above_mm)
            needed_s = needed_age_s(material, around, place, interface_c)
            self.now = next_speed(self.now, recent, needed_s, self.slowest, self.longest_pause_s)
        return self.now

    def is_round(self, ages: Ages, since_s: float) -> bool:
        """Without marks of layers: has about one layer been deposited within `since_s`?"""
        recent = ages.since(self._seen)
        return recent.above_mm >= ENOUGH_MM and since_s * recent.above_mm >= recent.age_s
