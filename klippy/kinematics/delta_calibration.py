"""What a calibration may change of a delta machine, and where the head is for any choice of it. No printer here.

A motor's place is kept as the steps between it and its endstop. That number stays true whatever the parameters are: for
new parameters it gives the place where the head really was. Lengths in mm, angles in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from kinematics.delta_limits import lower_meeting_point

Steps = Sequence[float]  # of each motor, from its endstop
Parameters = Mapping[str, float]
NAMES = "abc"


@dataclass(frozen=True, slots=True)
class Calibration:
    """A machine's parameters, the functions between them and places, and where they are written."""

    parameters: dict[str, float]
    basic: tuple[str, ...]  # what probed heights determine
    extended: tuple[str, ...]  # what heights and measured distances determine
    options: dict[str, tuple[str, str]]  # parameter -> section and option of the config
    steps_at: Callable[[Parameters, Sequence[float]], list[float]]
    place_at: Callable[[Parameters, Steps], list[float]]

    def saved(self, parameters: Parameters) -> Iterator[tuple[str, str, str]]:
        """(section, option, value) for the config."""
        for name, value in parameters.items():
            yield *self.options[name], f"{value:.6f}"


def _options(shared: Mapping[str, str], of_tower: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    options = {name: ("printer", option) for name, option in shared.items()}
    for tower in NAMES:
        options |= {f"{name}_{tower}": (f"stepper_{tower}", option) for name, option in of_tower.items()}
    return options


# What stays fixed is the direction of the third tower: turning the whole machine changes no height and no distance.
_FREE = ("angle_a", "angle_b", "endstop_a", "endstop_b", "endstop_c")


def linear_delta(parameters: dict[str, float], step_dists: Sequence[float]) -> Calibration:
    """Parameters: radius, and angle, arm, endstop of each tower (`angle_a` ...)."""

    def towers(p: Parameters) -> Iterator[tuple[float, float, float, float]]:
        for tower in NAMES:
            angle, arm = math.radians(p[f"angle_{tower}"]), p[f"arm_{tower}"]
            x, y = p["radius"] * math.cos(angle), p["radius"] * math.sin(angle)
            yield x, y, arm, p[f"endstop_{tower}"] + math.sqrt(max(0.0, arm**2 - p["radius"] ** 2))

    def steps_at(p: Parameters, place: Sequence[float]) -> list[float]:
        return [
            (top - place[2] - math.sqrt(max(0.0, arm**2 - (place[0] - x) ** 2 - (place[1] - y) ** 2))) / dist
            for (x, y, arm, top), dist in zip(towers(p), step_dists, strict=True)
        ]

    def place_at(p: Parameters, steps: Steps) -> list[float]:
        return lower_meeting_point(
            [
                ((x, y, top - count * dist), arm**2)
                for (x, y, arm, top), count, dist in zip(towers(p), steps, step_dists, strict=True)
            ]
        )

    return Calibration(
        parameters,
        ("radius", *_FREE),
        ("radius", *_FREE, "arm_a", "arm_b", "arm_c"),
        _options(
            {"radius": "delta_radius"},
            {"angle": "angle", "arm": "arm_length", "endstop": "position_endstop"},
        ),
        steps_at,
        place_at,
    )


def rotary_delta(parameters: dict[str, float], step_dists: Sequence[float]) -> Calibration:
    """Parameters: radius and height of the shoulders; angle, upper, lower, endstop of each arm. Steps in rad."""

    def turned(p: Parameters, arm: str, place: Sequence[float]) -> float:
        """Angle (rad) of the upper arm above the horizontal with the head at a place."""
        angle = math.radians(p[f"angle_{arm}"])
        out = place[0] * math.cos(angle) + place[1] * math.sin(angle) - p["radius"]
        across = -place[0] * math.sin(angle) + place[1] * math.cos(angle)
        up = place[2] - p["height"]
        upper, lower2 = p[f"upper_{arm}"], p[f"lower_{arm}"] ** 2 - across**2
        distance = math.hypot(out, up)
        cosine = (distance**2 + upper**2 - lower2) / (2.0 * upper * distance)
        inner = math.acos(max(-1.0, min(1.0, cosine)))
        # the elbow is the outer one of the two possible
        return max(
            (math.atan2(up, out) + turn for turn in (inner, -inner)), key=lambda t: (math.cos(t), math.sin(t))
        )

    def elbow(p: Parameters, arm: str, angle: float) -> list[float]:
        out = p["radius"] + p[f"upper_{arm}"] * math.cos(angle)
        direction = math.radians(p[f"angle_{arm}"])
        z = p["height"] + p[f"upper_{arm}"] * math.sin(angle)
        return [out * math.cos(direction), out * math.sin(direction), z]

    def homed(p: Parameters, arm: str) -> float:
        return turned(p, arm, (0.0, 0.0, p[f"endstop_{arm}"]))

    def steps_at(p: Parameters, place: Sequence[float]) -> list[float]:
        return [
            _nearest(homed(p, arm) - turned(p, arm, place)) / dist
            for arm, dist in zip(NAMES, step_dists, strict=True)
        ]

    def place_at(p: Parameters, steps: Steps) -> list[float]:
        return lower_meeting_point(
            [
                (elbow(p, arm, homed(p, arm) - count * dist), p[f"lower_{arm}"] ** 2)
                for arm, count, dist in zip(NAMES, steps, step_dists, strict=True)
            ]
        )

    arms = tuple(f"{part}_{arm}" for part in ("upper", "lower") for arm in NAMES)
    return Calibration(
        parameters,
        ("radius", *_FREE),
        ("radius", "height", *_FREE, *arms),
        _options(
            {"radius": "shoulder_radius", "height": "shoulder_height"},
            {"angle": "angle", "upper": "upper_arm", "lower": "lower_arm", "endstop": "position_endstop"},
        ),
        steps_at,
        place_at,
    )


def _nearest(angle: float) -> float:
    """The same direction within half a turn."""
    return math.remainder(angle, 2.0 * math.pi)
