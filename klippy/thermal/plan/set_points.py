"""From wanted melt temperatures along the path to a nozzle temperature that physics can follow.

1. What is wanted of the wall: melt temperature -> wall temperature at the segment's flow. Where the weld decides, the
   interface temperature is the target on both sides, also beyond the material's window, which then bounds the wall.
2. `nodes`: the path in steps of `NODE_S`, earlier by the lag between nozzle and leaving melt. Each has the length
   deposited in it as its weight, for every mm of weld counts the same, and the mean of what is wanted there.
3. `best_path`: of all temperatures that keep the limits on heating (power) and cooling (loss and melt), those with the
   minimum sum of weight (T - wanted)^2. With F_i(T) the minimum cost of being at T at node i,

        F_i(T) = w_i (T - a_i)^2 + min of F_i-1 over T - rise <= T' <= T + fall

   and F_i convex: the minimum moves what falls in F_i-1 to the left by `fall` and what rises to the right by `rise`.
   So its derivative is a row of knots that move and are added to; its zero is the best end T*_i of all paths so far.
   Backwards from the last: T_i-1 = T*_i-1 if the limits allow it, else the nearest they do. A step of the request comes
   out as a ramp astride its border, and what steps too often for the nozzle as its best compromise.

        wanted  ----+              planned ---.
                    |     ->                   \\  <- border in the middle
                    +-----                      `---

4. `follow`: forwards along these nodes, never faster than heating or cooling allow at that temperature and flow. The
   plan is a polyline; the rate of each piece is the slowest within it, so every point of it is feasible.

thermal/plan/set_points.c and best_path.c do the same in time O(1) a node.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from thermal.models.heat_loss import loss_w
from thermal.models.melt_exchange import NozzleLimits, highest_c
from thermal.records import FlowSegment

NODE_S = 0.05  # as finely as the nozzle and its controller can follow
MAX_NODES = 8192
PIECE_C = 5.0  # longest ramp piece: within it the limit rates change by a few percent
MIN_RATE_K_S = 1e-6


class PlanPoint(NamedTuple):
    """A corner of the plan; straight lines between corners."""

    time_s: float
    temp_c: float


class Want(NamedTuple):
    """Melt temperatures wanted for a segment. NaN: none."""

    melt_c: float
    free_c: float = math.nan  # melt for the weld alone, beyond the material's window; NaN: it does not decide
    request_c: float = math.nan  # asked for by name: begins with a node of its own


class Node(NamedTuple):
    """A step of the path: its middle, and means over it."""

    time_s: float
    weight: float
    wanted_c: float
    low_c: float  # bounds
    high_c: float
    melt_w_k: float


def wall_wanted(limits: NozzleLimits, ceiling_c: float, melt_c: float, flow_mm3_s: float) -> float:
    """Nozzle temperature at which the melt leaves at `melt_c`, within the limits of an extruding nozzle."""
    wall_c = free_wall(limits, melt_c, flow_mm3_s)
    return min(ceiling_c, max(limits.min_c, limits.min_extrude_c, wall_c))


def free_wall(limits: NozzleLimits, melt_c: float, flow_mm3_s: float) -> float:
    """The same without limits."""
    inlet_c = limits.exchange.inlet_c
    return inlet_c + (melt_c - inlet_c) / max(limits.exchange.share(flow_mm3_s), 1e-6)


def _between(value: float, low: float, high: float) -> float:
    return min(high, max(low, value))


# (node temperature, falls?, W/K taken by the melt) -> K/s
Rate = Callable[[float, bool, float], float]
Knot = tuple[float, float]  # temperature, derivative of the cost


def _cut(knots: list[Knot], low: float, high: float) -> list[Knot]:
    """What lies within low..high, which is within the ends. The derivative may jump: inwards counts."""

    def at(x: float, first: int) -> Knot:
        (x0, v0), (x1, v1) = knots[first : first + 2]
        return x, v0 + (v1 - v0) * (x - x0) / (x1 - x0)

    left = max(i for i, k in enumerate(knots) if k[0] <= low)
    right = min(i for i, k in enumerate(knots) if k[0] >= high)
    if left > right:  # a single temperature, at a jump
        return [(low, knots[right][1]), (low, knots[left][1])]
    begin = knots[left] if knots[left][0] == low else at(low, left)
    end = knots[right] if knots[right][0] == high else at(high, right - 1)
    return [begin, *knots[left + 1 : right], end]


def _zero(knots: list[Knot]) -> float:
    """Where the derivative, which rises throughout, is zero; an end if it is zero nowhere."""
    if knots[0][1] > 0.0:
        return knots[0][0]
    if knots[-1][1] < 0.0:
        return knots[-1][0]
    (x0, v0) = [k for k in knots if k[1] <= 0.0][-1]
    (x1, v1) = next(k for k in knots if k[1] >= 0.0)
    return x0 + (x1 - x0) * -v0 / (v1 - v0) if v1 > v0 else x0


def best_path(nodes: Sequence[Node], from_s: float, start_c: float, rate: Rate) -> list[float]:
    """Temperatures at the nodes. A bound gives way where the limits leave no other choice."""
    best_c, before_s = start_c, from_s
    knots: list[Knot] = [(start_c, 0.0)]
    steps: list[tuple[float, float]] = []
    bests: list[float] = []
    for node in nodes:
        fall_c = (node.time_s - before_s) * rate(best_c, True, node.melt_w_k)
        rise_c = (node.time_s - before_s) * rate(best_c, False, node.melt_w_k)
        falling = [(x - fall_c, v) for x, v in knots if v < 0.0 or (v == 0.0 and x <= best_c)]
        rising = [(x + rise_c, v) for x, v in knots if v > 0.0 or (v == 0.0 and x >= best_c)]
        knots = [*falling, (best_c - fall_c, 0.0), (best_c + rise_c, 0.0), *rising]
        ends = knots[0][0], knots[-1][0]
        knots = _cut(knots, _between(node.low_c, *ends), _between(node.high_c, *ends))
        knots = [(x, v + node.weight * (x - node.wanted_c)) for x, v in knots]
        if node.weight > 0.0:
            best_c = _zero(knots)
        best_c = _between(
            best_c, knots[0][0], knots[-1][0]
        )  # without weight all that is near costs the same: stay
        before_s = node.time_s
        bests.append(best_c)
        steps.append((fall_c, rise_c))
    for i in range(len(bests) - 1, 0, -1):
        fall_c, rise_c = steps[i]
        bests[i - 1] = _between(bests[i - 1], bests[i] - rise_c, bests[i] + fall_c)
    return bests


def _smoothed(node: Node, near: Sequence[Node]) -> Node:
    """With the mean of the bounds near it."""
    if node.weight <= 0.0:
        return node
    weight = sum(n.weight for n in near)
    low_c = sum(n.weight * n.low_c for n in near) / weight
    return node._replace(low_c=low_c, high_c=sum(n.weight * n.high_c for n in near) / weight)


class Planner:
    """Plans batches of segments. It keeps nothing: the caller starts a batch where the last one ended."""

    def __init__(
        self, limits: NozzleLimits, window_c: tuple[float, float] = (0.0, 1000.0), smooth_s: float = 0.0
    ) -> None:
        """`window_c`: of the melt; what it bounds is averaged over `smooth_s` to both sides."""
        floor_c = max(limits.min_c, limits.min_extrude_c)
        self.limits, self.window_c, self.smooth_s = limits, window_c, smooth_s
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
        floor = min(len(self._loss_w) - 2, max(0, int(end_c)))
        capacity_j_k = self._capacity_j_k[floor + 1]
        if end_c > start_c:
            taken_w = (
                holder_w + self._loss_w[floor + 1] + melt_w_k * max(0.0, end_c - limits.exchange.inlet_c)
            )
            return max(MIN_RATE_K_S, (limits.power_w - taken_w) / capacity_j_k)
        given_w = holder_w + self._loss_w[floor] + melt_w_k * max(0.0, end_c - limits.exchange.inlet_c)
        return max(MIN_RATE_K_S, given_w / capacity_j_k)

    def plan(self, segments: Sequence[FlowSegment], wants: Sequence[Want], start_c: float) -> list[PlanPoint]:
        """Corners of the plan from the first segment's start to the last one's end."""
        if len(segments) != len(wants):
            raise ValueError(f"{len(segments)} segments but {len(wants)} wants")
        if not segments:
            return []

        def rate(at_c: float, falls: bool, melt_w_k: float) -> float:
            return self._rate(at_c if falls else at_c - 1.0, at_c, melt_w_k, start_c)

        nodes = self._nodes(segments, wants)
        temps = best_path(nodes, segments[0].start_s, start_c, rate)
        targets = [PlanPoint(node.time_s, temp_c) for node, temp_c in zip(nodes, temps, strict=True)]
        return self._follow(segments, targets, start_c)

    def wall(self, want: Want, flow_mm3_s: float) -> float:
        """Nozzle temperature that is wanted for a segment."""
        if math.isnan(want.free_c):
            return wall_wanted(self.limits, self.ceiling_c, want.melt_c, flow_mm3_s)
        return free_wall(self.limits, want.free_c, flow_mm3_s)

    def _nodes(self, segments: Sequence[FlowSegment], wants: Sequence[Want]) -> list[Node]:
        """Means over each step; the bounds then over more of them, within a stretch of the same request."""
        nodes: list[Node] = []
        for stretch in self._stretches(segments, wants):
            own = [self._node(begin_s, end_s, shares) for begin_s, end_s, shares in stretch]
            times = [node.time_s for node in own]
            for node in own:
                low = bisect.bisect_left(times, node.time_s - self.smooth_s)
                near = own[low : bisect.bisect_right(times, node.time_s + self.smooth_s)]
                nodes.append(_smoothed(node, near))
        return nodes

    def _stretches(
        self, segments: Sequence[FlowSegment], wants: Sequence[Want]
    ) -> Iterator[list[tuple[float, float, list[tuple[FlowSegment, Want, float]]]]]:
        """Steps (begin, end, [(segment, want, seconds of it)]) of each stretch of the same request."""
        from_s, lag_s = segments[0].start_s, self.limits.exchange.lag_s
        longest_s = max(NODE_S, (segments[-1].end_s - from_s) / MAX_NODES)
        borders = [from_s]  # of stretches
        spans: list[tuple[float, float]] = []
        at_s = from_s
        for i, segment in enumerate(segments):
            begin_s = max(at_s, segment.start_s - lag_s(segment.flow_mm3_s))
            at_s = max(begin_s, segment.end_s - lag_s(segment.flow_mm3_s))
            spans.append((begin_s, at_s))
            if i and not _same(wants[i - 1].request_c, wants[i].request_c):
                borders.append(begin_s)
        borders.append(at_s)
        for border_s, end_s in itertools.pairwise(borders):
            steps = []
            begin_s = border_s
            while end_s - begin_s > 1e-9:
                until_s = min(end_s, begin_s + longest_s)
                shares = []
                for segment, want, (first_s, last_s) in zip(segments, wants, spans, strict=True):
                    inside_s = min(last_s, until_s) - max(first_s, begin_s)
                    if inside_s > 0.0:
                        shares.append((segment, want, inside_s))
                steps.append((begin_s, until_s, shares))
                begin_s = until_s
            yield steps

    def _node(self, begin_s: float, end_s: float, shares: Sequence[tuple[FlowSegment, Want, float]]) -> Node:
        exchange, ceiling_c = self.limits.exchange, self.ceiling_c
        melt_j_k = weight = target = low = high = 0.0
        for segment, want, inside_s in shares:
            flow = segment.flow_mm3_s
            melt_j_k += inside_s * exchange.heat_w_k(flow)
            if flow <= 0.0 or math.isnan(want.melt_c):
                continue
            part = exchange.share(flow) ** 2 * segment.path_mm * inside_s
            part /= max(1e-9, segment.end_s - segment.start_s)
            if part > 0.0:
                weight += part
                target += part * self.wall(want, flow)
                low += part * wall_wanted(self.limits, ceiling_c, self.window_c[0], flow)
                high += part * wall_wanted(self.limits, ceiling_c, self.window_c[1], flow)
        middle_s, melt_w_k = 0.5 * (begin_s + end_s), melt_j_k / (end_s - begin_s)
        if weight <= 0.0:
            return Node(middle_s, 0.0, 0.0, self.floor_c, ceiling_c, melt_w_k)
        return Node(middle_s, weight, target / weight, low / weight, high / weight, melt_w_k)

    def _follow(
        self, segments: Sequence[FlowSegment], targets: Sequence[PlanPoint], start_c: float
    ) -> list[PlanPoint]:
        """Straight from node to node, over the borders of flow, as far as the limits allow."""
        heat_w_k = self.limits.exchange.heat_w_k
        now_s, now_c, end_s = segments[0].start_s, start_c, segments[-1].end_s
        points, holder_c, flow_i, target_i = [PlanPoint(now_s, now_c)], start_c, 0, 0
        while now_s < end_s:
            while target_i < len(targets) and targets[target_i].time_s <= now_s:
                target_i += 1
            while flow_i < len(segments) - 1 and segments[flow_i].end_s <= now_s:
                flow_i += 1
            segment = segments[flow_i]
            inside = segment.start_s <= now_s  # in a gap between two segments nothing flows
            border_s = min(end_s, segment.end_s if inside else segment.start_s)
            if not targets:
                target = PlanPoint(now_s, _between(start_c, self.floor_c, self.ceiling_c))
            elif target_i < len(targets):
                target = targets[target_i]
                border_s = min(border_s, target.time_s)
            else:
                target = targets[-1]
            melt_w_k = heat_w_k(segment.flow_mm3_s) if inside else 0.0
            now_c, holder_c = self._ramp(points, now_s, now_c, border_s, target, melt_w_k, holder_c)
            now_s = border_s
        return points

    def _ramp(
        self,
        points: list[PlanPoint],
        now_s: float,
        now_c: float,
        until_s: float,
        target: PlanPoint,
        melt_w_k: float,
        holder_c: float,
    ) -> tuple[float, float]:
        """Towards the target until `until_s`, to be there at its time; a corner wherever the slope changes."""
        while now_s < until_s:
            left_c, before_s, before_c = target.temp_c - now_c, now_s, now_c
            step_c = _between(left_c, -PIECE_C, PIECE_C)
            rate = self._rate(now_c, now_c + step_c, melt_w_k, holder_c)
            if target.time_s > now_s:
                rate = min(rate, abs(left_c) / (target.time_s - now_s))
            if abs(left_c) <= 1e-9:
                now_s = until_s
            elif now_s + abs(step_c) / rate > until_s:
                now_c += math.copysign(rate * (until_s - now_s), step_c)
                now_s = until_s
            else:
                now_s += abs(step_c) / rate
                now_c += step_c
            points.append(PlanPoint(now_s, now_c))
            middle_c = 0.5 * (before_c + now_c)
            holder_c -= (middle_c - holder_c) * math.expm1(-(now_s - before_s) / self.limits.holder_s)
        return now_c, holder_c


def _same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))
