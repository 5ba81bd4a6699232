"""The simulated machine with a bed to probe: runs G-code, and gives console, objects and truth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simulation.runner import RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ROOT / "config" / "sim-probe.cfg"
STEP_MM = 8.0 / (200 * 16)  # of a Z motor
PROBED = re.compile(r"probe at (-?[\d.]+),(-?[\d.]+) is z=(-?[\d.]+)")
Option = tuple[str, str, str]


class _Listening(Simulation):
    """Keeps every line of the console."""

    def __init__(self, options: RunOptions) -> None:
        super().__init__(options)
        self.console: list[str] = []
        self.probing_times: list[float] = []

    def _on_output(self, text: str) -> None:
        self.console.append(text)
        if PROBED.search(text):
            self.probing_times.append(self.reactor.monotonic())
        super()._on_output(text)


@dataclass(slots=True)
class Probed:
    """What a run left behind."""

    status: int
    reason: str
    console: list[str]
    simulation: Any

    @property
    def times(self) -> list[float]:
        """Of the reactor, of every trigger."""
        times: list[float] = self.simulation.probing_times
        return times

    @property
    def text(self) -> str:
        return "\n".join(self.console)

    def object(self, name: str) -> Any:
        return self.simulation.printer.lookup_object(name)

    def status_of(self, name: str) -> dict[str, Any]:
        return self.object(name).get_status(self.simulation.reactor.monotonic())

    def found(self) -> list[tuple[float, float, float]]:
        """Every trigger: x, y of the nozzle, its height."""
        return [(float(x), float(y), float(z)) for x, y, z in PROBED.findall(self.text)]

    def bed(self, x: float, y: float) -> float:
        """True height of the bed."""
        world, machine = self.simulation.world, self.simulation.machine
        return world.bed_height(machine.probes[""], x, y)

    def axis_mm(self, name: str) -> float:
        """True place of an axis."""
        return self.simulation.world.axis(self.simulation.machine.axes[name])["position_mm"]


def run(folder: Path, gcode: str, *options: Option, seed: int = 1, config: Path = CONFIG) -> Probed:
    path = folder / "probe.gcode"
    path.write_text(gcode)
    simulation = _Listening(RunOptions(config, path, seed, tuple(options)))
    outcome = simulation.run()
    return Probed(outcome.status, outcome.reason, simulation.console, simulation)


def bed(**options: float) -> list[Option]:
    """Options of [simulator probe]."""
    return [("simulator probe", name, str(value)) for name, value in options.items()]


FLAT = bed(bed_height=0.0, tilt_x=0.0, tilt_y=0.0, bump_height=0.0, noise=0.0)

__all__: Sequence[str] = ("CONFIG", "FLAT", "STEP_MM", "Probed", "bed", "run")
