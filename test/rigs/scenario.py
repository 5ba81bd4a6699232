"""One story, played on every build of the firmware: identify, configure, home, heat, print, hold, a fault, shutdown.

The host is the product's own, unchanged; the plant is the same for every build; what differs is the library behind the
MCU. A case names the machine's config, the build, how hot, and what breaks at the end; `play` gives what came of it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from simulation.emulator import Emulator
from simulation.runner import Outcome, RunOptions, Simulation
from simulation.summary import heater_figures

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Case:
    """`heater`: "nozzle" (induction) or "load" (thermistor): whose parameter `broken` becomes `value` at the end."""

    build: str
    config: str
    target_c: float
    heater: str = "nozzle"
    broken: tuple[str, float] = ("fault", 1.0)  # no nozzle in the coil; a load's thermistor open

    def overrides(self) -> tuple[tuple[str, str, str], ...]:
        """The simulator port has ports A to H: a chip's J, K and L lie on pins of G and H there."""
        if self.build != "simulator":
            return ()
        found, section = [], ""
        for line in (ROOT / "config" / self.config).read_text().splitlines():
            section = line.strip("[]") if line.startswith("[") else section
            match = re.match(r"(\w*pin): ([!^]*)P([JKL])(\d)$", line)
            if match:
                port, first = {"J": ("G", 0), "K": ("G", 8), "L": ("H", 0)}[match[3]]
                found.append((section, match[1], f"{match[2]}P{port}{first + int(match[4])}"))
        return tuple(found)


@dataclass
class Story:
    """What happened."""

    case: Case
    outcome: Outcome
    steps: dict[str, tuple[int, int]] = field(default_factory=dict)  # axis → steps forward, backward
    positions_mm: dict[str, float] = field(default_factory=dict)
    crashed: int = 0
    extruded_mm3: float = 0.0
    end_of_print_s: float = 0.0
    held_c: list[float] = field(default_factory=list)  # true temperature, every 0.25 s, after the print
    heater: dict[str, Any] = field(default_factory=dict)  # its figures before the fault
    fault_s: float = 0.0  # the moment something broke
    shutdown_s: float = 0.0
    energy_after_j: float = 0.0  # put into the heater after the shutdown
    counters: dict[str, Any] = field(default_factory=dict)  # of an emulated chip


def part(target_c: float) -> str:
    """A square of 12 mm, two layers, after homing and heating: 80 moves of plain G-code with material."""
    lines = ["G28", f"M109 S{target_c:g}", "G90", "M83", "G1 Z0.3 F600", "G1 X60 Y60 F9000", "M106 S128"]
    for layer in range(2):
        lines.append(f"G1 Z{0.3 + 0.2 * layer:.1f} F600")
        for side in range(5):
            low, high = 60 + 0.8 * side, 72 - 0.8 * side
            for x, y in ((high, low), (high, high), (low, high), (low, low)):
                length = high - low
                lines.append(f"G1 X{x:.2f} Y{y:.2f} E{length * 0.033:.4f} F2400")
    return "\n".join([*lines, "G1 E-1 F1800", "G1 Z5 F600", "M107"]) + "\n"


class Play(Simulation):
    """A simulated print that watches on after the file: hold, break something, see the printer stop."""

    HOLD_S = 3.0
    PATIENCE_S = 30.0

    def __init__(self, case: Case, folder: Path, seed: int, trace: Path | None) -> None:
        gcode = folder / "part.gcode"
        gcode.write_text(part(case.target_c))
        config = ROOT / "config" / case.config
        super().__init__(
            RunOptions(config, gcode, seed, case.overrides(), trace=trace, builds={"mcu": case.build})
        )
        self.case = case
        self.story = Story(case, Outcome(1, "", {}))

    def _temperature_c(self) -> float:
        lib, pointer = self.world.lib, self.world.pointer
        read = lib.world_nozzle_temperature if self.case.heater == "nozzle" else lib.world_load_temperature
        return float(read(pointer, 0))

    def _seconds(self) -> float:
        return self.world.now - self.world.start_s

    def _finish_print(self, status: dict[str, Any]) -> None:
        assert not self.facts.faults, self.facts.faults
        assert self.machine is not None
        self.printer.lookup_object("toolhead").wait_moves()
        story, machine = self.story, self.machine
        story.end_of_print_s = self._seconds()
        for name, index in machine.axes.items():
            axis = self.world.axis(index)
            story.steps[name] = (axis["steps_forward"], axis["steps_backward"])
            story.positions_mm[name] = axis["position_mm"]
            story.crashed += axis["steps_lost"]
        story.extruded_mm3 = self.world.figures()["extruded_mm3"]
        while self._seconds() < story.end_of_print_s + self.HOLD_S and self._pause():
            story.held_c.append(self._temperature_c())
        story.heater = heater_figures(self.world.figures(), self.world.epochs())
        name, value = self.case.broken
        story.fault_s = self._seconds()
        self.world.set_parameter(self.case.heater, 0, name, value)
        energy_j = 0.0
        while self._seconds() < story.fault_s + self.PATIENCE_S:
            energy_j = self.world.figures()["energy_j"]
            if not self._pause():
                break
        story.shutdown_s = self._seconds()
        story.energy_after_j = self.world.figures()["energy_j"] - energy_j
        if machine.builds["mcu"].emulated:
            story.counters = Emulator(self.world, machine.mcus["mcu"]).counters()


def play(case: Case, folder: Path, seed: int = 1, trace: Path | None = None) -> Story:
    """Play the story on one build."""
    run = Play(case, folder, seed, trace)
    outcome = run.run()
    run.story.outcome = outcome
    return run.story
