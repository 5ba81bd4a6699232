"""A print with [print_recovery] on the simulated machine, looked at or stopped at given times."""

from __future__ import annotations

import harness

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from extras.recovery.journal import Journal
from simulation.runner import RunOptions, Simulation

AXES = {"x": "stepper_x", "y": "stepper_y", "z": "stepper_z", "extruder": "extruder"}
FULL_STEP_MM = {"x": 40.0 / 200, "y": 40.0 / 200, "z": 8.0 / 200, "extruder": 7.6 / 200}
INTERVAL_S = 0.5


@dataclass(slots=True)
class Instant:
    """What a crash at this moment would leave: the journal, the motors' steps; and where the axes are."""

    record: dict[str, Any]
    steps: dict[str, int]
    place: dict[str, float]


class Watched(Simulation):
    """Looks at journal and machine at given times."""

    def __init__(self, options: RunOptions, journal: Path, at_s: list[float]) -> None:
        super().__init__(options)
        self.journal, self.at_s = journal, sorted(at_s)
        self.instants: list[Instant] = []
        self.outcome: Any = None

    def axis(self, name: str) -> dict[str, Any]:
        assert self.machine is not None
        return self.world.axis(self.machine.axes[name])

    def _before_advance(self, now: float) -> None:
        super()._before_advance(now)
        while self.at_s and now - self.world.start_s >= self.at_s[0]:
            self.at_s.pop(0)
            axes = {name: self.axis(name) for name in AXES}
            steps = {AXES[n]: int(a["steps_forward"] - a["steps_backward"]) for n, a in axes.items()}
            place = {name: a["position_mm"] for name, a in axes.items()}
            self.instants.append(Instant(Journal(str(self.journal)).read(), steps, place))


def options(
    part: Path, journal: Path, faults: tuple[str, ...] = (), more: tuple[tuple[str, str, str], ...] = ()
) -> RunOptions:
    """A print of `part` with [print_recovery]."""
    values = {"filename": str(journal), "interval": str(INTERVAL_S), "z_stays": "True"}
    overrides = tuple(("print_recovery", name, value) for name, value in values.items())
    return RunOptions(harness.SAMPLE_CONFIG, part, overrides=overrides + more, faults=faults)
