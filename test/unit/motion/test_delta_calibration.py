"""A delta's dimensions from what was measured: a wrong machine probes and prints, the fit finds what it really is."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from extras.delta_calibrate import PILLAR_ANGLES, Height, Measured, object_distances
from extras.probing.least_squares import fit
from kinematics.delta_calibration import Calibration, linear_delta, rotary_delta
from motion_rig import FFI, LIB

STEP_MM, STEP_RAD = 0.0125, 2e-4
LINEAR = {
    "radius": 174.75,
    "angle_a": 210.0,
    "angle_b": 330.0,
    "angle_c": 90.0,
    **{f"arm_{tower}": 333.0 for tower in "abc"},
    **{f"endstop_{tower}": 297.0 for tower in "abc"},
}
ROTARY = {
    "radius": 33.9,
    "height": 412.9,
    "angle_a": 30.0,
    "angle_b": 150.0,
    "angle_c": 270.0,
    **{f"upper_{arm}": 170.0 for arm in "abc"},
    **{f"lower_{arm}": 320.0 for arm in "abc"},
    **{f"endstop_{arm}": 252.0 for arm in "abc"},
}
TRUE_LINEAR = {
    **LINEAR, "radius": 175.6, "angle_a": 210.4, "angle_b": 329.7,
    "endstop_a": 296.2, "endstop_b": 297.9, "endstop_c": 297.3,
}  # fmt: skip
TRUE_ROTARY = {
    **ROTARY, "radius": 34.4, "angle_a": 30.3, "angle_b": 149.8,
    "endstop_a": 251.5, "endstop_b": 252.6, "endstop_c": 252.2,
}  # fmt: skip
MACHINES = [
    pytest.param(linear_delta, LINEAR, TRUE_LINEAR, STEP_MM, id="linear"),
    pytest.param(rotary_delta, ROTARY, TRUE_ROTARY, STEP_RAD, id="rotary"),
]
Make = Callable[[dict[str, float], list[float]], Calibration]


def around(radius: float) -> list[tuple[float, float]]:
    return [
        (radius * math.cos(math.radians(angle)), radius * math.sin(math.radians(angle)))
        for angle in PILLAR_ANGLES
    ]


def touching(machine: Calibration, true: dict[str, float]) -> Measured:
    """The motors' places with the nozzle of the true machine on a flat bed."""
    places = [(0.0, 0.0), *around(70.0)]
    return Measured(heights=[Height(0.0, machine.steps_at(true, (x, y, 0.0))) for x, y in places])


@pytest.mark.parametrize(("make", "configured", "true", "step"), MACHINES)
def test_steps_from_the_endstops_give_the_place_again(
    make: Make, configured: dict[str, float], true: dict[str, float], step: float
) -> None:
    machine = make(configured, [step] * 3)
    for place in ((0.0, 0.0, 0.0), (50.0, -20.0, 30.0), (-60.0, 40.0, 0.5)):
        assert machine.place_at(true, machine.steps_at(true, place)) == pytest.approx(place, abs=1e-9)


def test_steps_are_those_of_the_motors() -> None:
    """Against the kinematics in C that move the machine."""
    solvers = {
        "linear": [
            LIB.delta_stepper_alloc(333.0**2, 174.75 * math.cos(a), 174.75 * math.sin(a))
            for a in map(math.radians, (210.0, 330.0, 90.0))
        ],
        "rotary": [
            LIB.rotary_delta_stepper_alloc(33.9, 412.9, math.radians(a), 170.0, 320.0)
            for a in (30.0, 150.0, 270.0)
        ],
    }
    for name, machine in (
        ("linear", linear_delta(LINEAR, [STEP_MM] * 3)),
        ("rotary", rotary_delta(ROTARY, [STEP_RAD] * 3)),
    ):
        at_endstop = (0.0, 0.0, 297.0 if name == "linear" else 252.0)
        step = STEP_MM if name == "linear" else STEP_RAD
        for place in ((0.0, 0.0, 0.0), (40.0, 30.0, 12.0), (-55.0, 10.0, 3.0)):
            steps = machine.steps_at(machine.parameters, place)
            for solver, count in zip(solvers[name], steps, strict=True):
                kept = FFI.gc(solver, lambda _: None)
                from_endstop = LIB.itersolve_calc_position_from_coord(
                    kept, *at_endstop
                ) - LIB.itersolve_calc_position_from_coord(kept, *place)
                assert count * step == pytest.approx(from_endstop, abs=1e-9)


@pytest.mark.parametrize(("make", "configured", "true", "step"), MACHINES)
def test_seven_heights_make_the_bed_flat(
    make: Make, configured: dict[str, float], true: dict[str, float], step: float
) -> None:
    machine = make(configured, [step] * 3)
    measured = touching(machine, true)
    errors = measured.residuals(machine, configured)
    assert max(map(abs, errors)) > 0.5
    found = fit(configured, machine.basic, lambda p: measured.residuals(machine, p))
    assert max(map(abs, measured.residuals(machine, found))) < 0.001
    # and between the probed places, too
    for x, y in around(35.0):
        assert abs(machine.place_at(found, machine.steps_at(true, (x, y, 0.0)))[2]) < 0.02


def test_distances_on_the_object_give_its_true_size() -> None:
    """All arms are 2 mm longer than configured: for heights alone another radius does the same."""
    true = {**TRUE_LINEAR, **{f"arm_{tower}": 335.0 for tower in "abc"}}
    machine = linear_delta(LINEAR, [STEP_MM] * 3)
    measured = touching(machine, true)
    basic = fit(LINEAR, machine.basic, lambda p: measured.residuals(machine, p))
    # the object is printed with the configured parameters: its pillars stand where the true machine is then
    printed = [
        machine.place_at(true, machine.steps_at(LINEAR, (x, y, 0.0))) for x, y in [(0.0, 0.0), *around(65.0)]
    ]
    middle, pillars = printed[0], printed[1:]
    outer = [9.0, 9.1, 8.9, 9.05, 8.95, 9.0]
    center = [9.0, 9.2, 8.8]
    measures = {
        "CENTER_PILLAR_WIDTHS": center,
        "OUTER_PILLAR_WIDTHS": outer,
        "CENTER_DISTS": [
            math.dist(p, middle) + 0.5 * (center[spoke] + width)
            for p, spoke, width in zip(pillars, (0, 2, 1, 0, 2, 1), outer, strict=True)
        ],
        "OUTER_DISTS": [
            math.dist(pillars[k], pillars[k - 5]) + 0.5 * (outer[k] + outer[k - 5]) for k in range(6)
        ],
    }
    measured.distances = object_distances(machine, measures, 1.0)
    extended = fit(LINEAR, machine.extended, lambda p: measured.residuals(machine, p))

    def size_error(parameters: dict[str, float]) -> float:
        """Of a printed line of 130 mm, mm."""
        ends = [machine.place_at(true, machine.steps_at(parameters, (x, 0.0, 0.0))) for x in (-65.0, 65.0)]
        return abs(math.dist(*ends) - 130.0)

    assert size_error(basic) > 0.2
    assert size_error(extended) < 0.02
    assert max(map(abs, measured.residuals(machine, extended))) < 0.005


def test_what_is_saved_is_read_again() -> None:
    measured = Measured(
        [Height(0.0, (1.0, 2.0, 3.5))], [Height(0.25, (4.0, 5.0, 6.0))],
        object_distances(
            linear_delta(LINEAR, [STEP_MM] * 3),
            {
                "CENTER_PILLAR_WIDTHS": [9.0] * 3, "OUTER_PILLAR_WIDTHS": [9.0] * 6,
                "CENTER_DISTS": [74.0] * 6, "OUTER_DISTS": [74.0] * 6,
            },
            1.0,
        ),
    )  # fmt: skip
    saved = measured.saved()
    assert saved["height0_pos"] == "1.000,2.000,3.500"
    assert saved["manual_height0"] == "0.250000"
    assert saved["distance0"] == "65.000000"

    class Section:
        """A section of the config."""

        def getfloat(self, name: str, default: float | None, **limits: float) -> float | None:
            return float(saved[name]) if name in saved else default

        def getfloatlist(self, name: str, count: int) -> tuple[float, ...]:
            return tuple(float(part) for part in saved[name].split(","))

    assert Measured.read(Section()).saved() == saved  # type: ignore[arg-type]
