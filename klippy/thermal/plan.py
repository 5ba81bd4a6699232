"""From wanted melt temperatures along the path to a nozzle temperature that physics can follow.

1. `wall_wanted`: melt temperature -> wall temperature at the segment's flow, clamped to the limits.
2. Lead: seen from the end of the queue backwards, the time a_i that the ramp to segment i needs, with what is
   left over from the ramp after it in the same direction. Half of it is the lead: the ramp then lies astride the
   segment's border, which splits the error between both sides (a single step: rms half of a ramp begun there).

        wanted  ----+              planned ---.
                    |     ->                   \\  <- border in the middle
                    +-----                      `---

3. Forwards: follow the shifted steps, never faster than heating (power) or cooling (loss and melt) allow. The
   plan is a polyline; the rate of each piece is the slowest within it, so every point of it is feasible.
Everything is shifted earlier by the lag between nozzle and leaving melt. Time is O(1) a segment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .model import loss_w
from .nozzle_melt import NozzleLimits, highest_c
from .records import FlowSegment

PIECE_C = 5.0  # longest ramp piece: within it the limit rates change by a few percent
NEGLIGIBLE_C = 0.05  # a difference below the sensor's noise is no step
LEAST_RATE_K_S = 1e-6


class PlanPoint(NamedTuple):
    """A corner of the plan; straight lines between corners."""

    time_s: float
    temp_c: float


def wall_wanted(limits: NozzleLimits, ceiling_c: float, melt_c: float, flow_mm3_s: float) -> float:
    """Nozzle temperature at which the melt leaves at `melt_c`, within the limits of an extruding nozzle."""
    inlet_c = limits.exchange.inlet_c
    wall_c = inlet_c + (melt_c - inlet_c) / max(limits.exchange.share(flow_mm3_s), 1e-6)
    return min(ceiling_c, max(limits.min_c, limits.min_extrude_c, wall_c))


class Planner:
    """Plans batches of segments. It keeps nothing: the caller starts a batch where the last one ended."""

    def __init__(self, limits: NozzleLimits) -> None:
        floor_c = max(limits.min_c, limits.min_extrude_c)
        self.limits = limits
        self.ceiling_c = highest_c(limits)
        if self.ceiling_c < floor_c:
            raise ValueError(
                f"The power of {limits.power_w:.1f} W holds {self.ceiling_c:.0f} degC at most, below the lowest"
                f" temperature of {floor_c:.0f} degC at which this nozzle may extrude."
            )
        self.floor_c = floor_c
        # per whole degree: fourth powers are dear at every corner of the plan
        degrees = range(math.ceil(self.ceiling_c) + 2)
        self._loss_w = [loss_w(limits.loss, t) for t in degrees]
        self._capacity_j_k = [limits.capacity.at(t) for t in degrees]

    def _rate(self, start_c: float, end_c: float, melt_w_k: float, holder_c: float) -> float:
        """Slowest of the limit rates (K/s) between two temperatures, rounded to the slow side.

        Both rates fall towards the end of a ramp. The capacity is taken a degree up in either direction.
        `holder_c`: nozzle temperature at which the holder would be in balance now.
        """
        limits = self.limits
        holder_w = limits.holder_w_k * (end_c - holder_c)
        floor = max(0, int(end_c))
        capacity_j_k = self._capacity_j_k[floor + 1]
        if end_c > start_c:
            taken_w = (
                holder_w + self._loss_w[floor + 1] + melt_w_k * max(0.0, end_c - limits.exchange.inlet_c)
            )
            return max(LEAST_RATE_K_S, (limits.power_w - taken_w) / capacity_j_k)
        given_w = holder_w + self._loss_w[floor] + melt_w_k * max(0.0, end_c - limits.exchange.inlet_c)
        return max(LEAST_RATE_K_S, given_w / capacity_j_k)

    def plan(
        self, segments: Sequence[FlowSegment], melts_c: Sequence[float], start_c: float
    ) -> list[PlanPoint]:
        """`melts_c[i]`: wanted melt temperature of segment i, NaN where nothing is wanted (travel)."""
        if len(segments) != len(melts_c):
            raise ValueError(f"{len(segments)} segments but {len(melts_c)} wanted temperatures")
        if not segments:
            return []
        walls = self._walls(segments, melts_c, start_c)
        heat_w_k = self.limits.exchange.heat_w_k
        melts_w_k = [heat_w_k(segment.flow_mm3_s) for segment in segments]
        starts = self._starts(segments, walls, melts_w_k, start_c)
        return self._follow(segments, walls, melts_w_k, starts, start_c)

    def _walls(
        self, segments: Sequence[FlowSegment], melts_c: Sequence[float], start_c: float
    ) -> list[float]:
        """Wanted wall of each segment; where nothing is laid, that of the segment before."""
        limits, ceiling_c = self.limits, self.ceiling_c
        wall_c = min(ceiling_c, max(self.floor_c, start_c))
        walls = []
        for segment, melt_c in zip(segments, melts_c, strict=True):
            if segment.flow_mm3_s > 0.0 and math.isfinite(melt_c):
                wall_c = wall_wanted(limits, ceiling_c, melt_c, segment.flow_mm3_s)
            walls.append(wall_c)
        return walls

    def _starts(
        self,
        segments: Sequence[FlowSegment],
        walls: Sequence[float],
        melts_w_k: Sequence[float],
        start_c: float,
    ) -> list[float]:
        """When the plan turns to each wall temperature: never before the batch, never out of order."""
        limits = self.limits
        starts = [0.0] * len(walls)
        demand_s, direction, later_s = 0.0, 0, math.inf
        for i in range(len(walls) - 1, -1, -1):
            segment = segments[i]
            before_c = walls[i - 1] if i else start_c
            step_c = walls[i] - before_c
            at_s = segment.start_s - limits.exchange.lag_s(segment.flow_mm3_s)
            demand_s = max(0.0, demand_s - (later_s - at_s))
            if abs(step_c) > NEGLIGIBLE_C:
                sign = 1 if step_c > 0.0 else -1
                melt_w_k = melts_w_k[i - 1] if i else 0.0
                needed_s = abs(step_c) / self._rate(before_c, walls[i], melt_w_k, start_c)
                demand_s = needed_s + (demand_s if sign == direction else 0.0)
                direction = sign
            later_s = at_s
            starts[i] = at_s - 0.5 * demand_s
        latest_s = segments[0].start_s
        for i, at_s in enumerate(starts):
            latest_s = max(latest_s, at_s)
            starts[i] = latest_s
        return starts

    def _follow(
        self,
        segments: Sequence[FlowSegment],
        walls: Sequence[float],
        melts_w_k: Sequence[float],
        starts: Sequence[float],
        start_c: float,
    ) -> list[PlanPoint]:
        """Forward pass over the merged borders of flow and of target."""
        count = len(segments)
        now_s, now_c = segments[0].start_s, start_c
        target_c = min(self.ceiling_c, max(self.floor_c, start_c))
        points = [PlanPoint(now_s, now_c)]
        holder_c = start_c
        flow_i = turn_i = 0
        end_s = segments[-1].end_s
        while now_s < end_s:
            while turn_i < count and starts[turn_i] <= now_s:
                target_c = walls[turn_i]
                turn_i += 1
            while flow_i < count - 1 and segments[flow_i].end_s <= now_s:
                flow_i += 1
            segment = segments[flow_i]
            # in a gap between two segments nothing flows
            inside = segment.start_s <= now_s
            border_s = segment.end_s if inside else segment.start_s
            if turn_i < count:
                border_s = min(border_s, starts[turn_i])
            border_s = min(border_s, end_s)
            melt_w_k = melts_w_k[flow_i] if inside else 0.0
            now_c, holder_c = self._ramp(points, now_s, now_c, border_s, target_c, melt_w_k, holder_c)
            now_s = border_s
        points.append(PlanPoint(end_s, now_c))
        return points

    def _ramp(
        self,
        points: list[PlanPoint],
        now_s: float,
        now_c: float,
        until_s: float,
        target_c: float,
        melt_w_k: float,
        holder_c: float,
    ) -> tuple[float, float]:
        """Move towards the target until `until_s`; append a corner wherever the slope changes. (nozzle, holder)."""
        while now_s < until_s and abs(target_c - now_c) > 1e-9:
            step_c = min(PIECE_C, max(-PIECE_C, target_c - now_c))
            rate = self._rate(now_c, now_c + step_c, melt_w_k, holder_c)
            before_s, before_c = now_s, now_c
            if points[-1].time_s < now_s:
                points.append(PlanPoint(now_s, now_c))
            needed_s = abs(step_c) / rate
            if now_s + needed_s > until_s:
                now_c += math.copysign(rate * (until_s - now_s), step_c)
                now_s = until_s
            else:
                now_s += needed_s
                now_c += step_c
            points.append(PlanPoint(now_s, now_c))
            holder_c = self._holder(holder_c, 0.5 * (before_c + now_c), now_s - before_s)
        return now_c, self._holder(holder_c, now_c, max(0.0, until_s - now_s))

    def _holder(self, holder_c: float, nozzle_c: float, time_s: float) -> float:
        return holder_c - (nozzle_c - holder_c) * math.expm1(-time_s / self.limits.holder_s)
