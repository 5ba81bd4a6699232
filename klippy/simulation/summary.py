"""The results of a simulated print, as plain data for the summary file.

    world figures, epochs, links, axes ─┐
    run facts (RunFacts) ───────────────┴─► summary() ─► dict for JSON

Units are in the names; -1 of the C side ("never") becomes null.
"""

from __future__ import annotations

import hashlib
import math
import resource
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from util import get_software_version

from .machine import Machine

SETTLE_S = 2.0  # of world_trace.c: so long within the band is settled
ROOT = Path(__file__).resolve().parents[2]
STATUS_TEXT = {0: "printed", 2: "bad input", 3: "printer shut down"}


@dataclass(slots=True)
class RunFacts:
    """What the runner knows beside the world. `stages_s`: wall time by part of the program."""

    config: str
    gcode: str
    seed: int
    exit_status: int = 0
    reason: str = ""
    simulated_s: float = 0.0
    wall_s: float = 0.0
    moves: int = 0
    file_progress: float = 0.0
    faults: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)  # warnings of the nozzle's chain and monitor
    nozzle_monitor: list[dict[str, Any]] = field(default_factory=list)
    unknown_commands: dict[str, int] = field(default_factory=dict)  # name: how often
    injected: list[dict[str, Any]] = field(default_factory=list)  # see faults.py
    recovery: dict[str, Any] = field(default_factory=dict)  # see restarted.py
    stages_s: dict[str, float] = field(default_factory=dict)
    host_links: dict[str, Mapping[str, Any]] = field(default_factory=dict)


def peak_memory_mb() -> float:
    """Largest resident set of this program so far, MB (1e6 bytes)."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage also counts what the process was before exec: the size of who started it
        high_water = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(high_water.split()[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


@cache
def _version() -> str:
    return get_software_version(str(ROOT))


def _sha256(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def summary(facts: RunFacts, machine: Machine | None) -> dict[str, Any]:
    """The summary; without a machine (it was never built) only the run's own facts."""
    result: dict[str, Any] = {
        "status": STATUS_TEXT.get(facts.exit_status, "failed"),
        "exit_status": facts.exit_status,
        "reason": facts.reason,
        "version": _version(),
        "date": datetime.now().astimezone().isoformat(" ", "seconds"),
        "config": facts.config,
        "gcode": facts.gcode,
        "gcode_sha256": _sha256(Path(facts.gcode)),
        "seed": facts.seed,
        "simulated_s": round(facts.simulated_s, 6),
        "wall_s": round(facts.wall_s, 3),
        "ratio": round(facts.simulated_s / facts.wall_s, 2) if facts.wall_s > 0 else None,
        "stages_s": {name: round(value, 3) for name, value in facts.stages_s.items()},
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "moves": facts.moves,
        "file_progress": round(facts.file_progress, 6),
        "faults": list(facts.faults),
        "messages": list(facts.messages),
        "nozzle_monitor": facts.nozzle_monitor,
        "unknown_commands": facts.unknown_commands,
        "injected": facts.injected,
        **({"recovery": facts.recovery} if facts.recovery else {}),
    }
    if machine is None:
        return result
    figures = machine.world.figures()
    result["extruded_mm3"] = _rounded(figures["extruded_mm3"])
    result["heater"] = heater_figures(figures, machine.world.epochs())
    result["axes"] = {
        name: {k: _rounded(v) for k, v in machine.world.axis(index).items()}
        for name, index in machine.axes.items()
    }
    result["links"] = {
        name: {**machine.world.link(index), **facts.host_links.get(name, {})}
        for name, index in machine.mcus.items()
    }
    return result


def heater_figures(figures: Mapping[str, Any], epochs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The nozzle's figures over all targets, and one record a target."""
    settled_s = sum(e["settled_seconds"] for e in epochs)
    squares = sum(e["square_error_sum"] for e in epochs)
    errors = sum(e["error_sum"] for e in epochs)
    heating = [e for e in epochs if e["target_c"] > e["from_c"] + 5.0]
    return {
        "settled_s": _rounded(settled_s),
        "settled_max_error_c": _largest(epochs, "max_error_c", settled_s),
        "settled_rms_error_c": _rounded(math.sqrt(squares / settled_s)) if settled_s else None,
        "settled_mean_error_c": _rounded(errors / settled_s) if settled_s else None,
        "estimate_max_error_c": _largest(epochs, "estimate_max_error_c", settled_s),
        "overshoot_c": _largest(heating, "overshoot_c", settled_s),
        "climb_ratio": _slowest(epochs, "settle_s"),
        "shown_climb_ratio": _slowest(epochs, "shown_settle_s"),
        "time_to_heat_s": _rounded(_ever(heating[0]["reach_s"])) if heating else None,
        "peak_c": _rounded(figures["peak_c"]),
        "peak_power_w": _rounded(figures["peak_power_w"]),
        "energy_j": _rounded(figures["energy_j"]),
        "peak_flow_mm3_s": _rounded(figures["peak_flow_mm3_s"]),
        "targets": [_epoch(e) for e in epochs],
    }


def _epoch(epoch: Mapping[str, Any]) -> dict[str, Any]:
    seconds = epoch["settled_seconds"]
    return {
        "start_s": _rounded(epoch["start_s"]),
        "from_c": _rounded(epoch["from_c"]),
        "target_c": _rounded(epoch["target_c"]),
        "reach_s": _rounded(_ever(epoch["reach_s"])),
        "settle_s": _rounded(_ever(epoch["settle_s"])),
        "climb_ratio": climb_ratio(epoch),
        "climb_over_s": _rounded(epoch["settle_s"] - SETTLE_S - epoch["bound_s"])
        if climb_ratio(epoch)
        else None,
        "overshoot_c": _rounded(epoch["overshoot_c"]),
        "settled_s": _rounded(seconds),
        "max_error_c": _rounded(epoch["max_error_c"]) if seconds else None,
        "rms_error_c": _rounded(math.sqrt(epoch["square_error_sum"] / seconds)) if seconds else None,
    }


def climb_ratio(epoch: Mapping[str, Any], settled: str = "settle_s") -> float | None:
    """Time until the nozzle is in the band and stays there, over that of full power from the first moment; None: no
    climb, or it never ended. `settled`: by the true temperature, or by the host's estimate.
    """
    climbed = epoch["bound_s"] > 0.0 and epoch[settled] >= 0.0
    return _rounded((epoch[settled] - SETTLE_S) / epoch["bound_s"]) if climbed else None


def _slowest(epochs: Sequence[Mapping[str, Any]], settled: str) -> float | None:
    ratios = [climb_ratio(epoch, settled) for epoch in epochs]
    return max((ratio for ratio in ratios if ratio is not None), default=None)


def _largest(epochs: Sequence[Mapping[str, Any]], name: str, settled_s: float) -> float | None:
    return _rounded(max((e[name] for e in epochs), default=0.0)) if settled_s else None


def _ever(seconds: float) -> float | None:
    return None if seconds < 0.0 else seconds


def _rounded(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value
