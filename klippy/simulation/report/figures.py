"""The figures a simulated print is judged by, each computed from the trace and named for the reader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .data import SETTLED_BAND_C, Floats, Layer, Mask, Trace, extruding, find_layers, printing, settled


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table: what, how much (with unit), and how it was taken."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Masks:
    """Which rows of the trace count for which figure."""

    extrudes: Mask
    prints: Mask
    settled: Mask

    @classmethod
    def of(cls, trace: Trace) -> Masks:
        extrudes = extruding(trace)
        return cls(extrudes, printing(trace, extrudes), settled(trace))


@dataclass(frozen=True, slots=True)
class PrintRun:
    """A simulated print as the report needs it: the trace and what was worked out from it."""

    trace: Trace
    masks: Masks
    layers: Sequence[Layer]
    table: Sequence[Figure]
    provenance: Sequence[Figure]

    @classmethod
    def of(cls, trace: Trace, summary: Mapping[str, object]) -> PrintRun:
        masks = Masks.of(trace)
        layers = find_layers(trace, masks.extrudes)
        return cls(trace, masks, layers, figures(trace, masks, layers, summary), provenance(summary))


def figures(
    trace: Trace, masks: Masks, layers: Sequence[Layer], summary: Mapping[str, object]
) -> list[Figure]:
    """All figures, in reading order."""
    return [
        *_run(trace, summary),
        *_temperature(trace, masks),
        *_material(trace, masks, layers),
        *_power(trace, masks),
        *_trouble(summary),
    ]


PROVENANCE = {
    "version": "Version",
    "config": "Config",
    "gcode": "G-code file",
    "gcode_sha256": "SHA-256 of the file",
    "seed": "Seed of the noise",
    "date": "Date",
    "command": "Command",
}


def provenance(summary: Mapping[str, object]) -> list[Figure]:
    """What one needs to repeat the run, as far as the summary says."""
    facts = dict(summary)
    for key in ("config", "gcode"):
        if facts.get(key) is not None:
            facts[key] = Path(str(facts[key])).name
    return [Figure(label, str(facts[key])) for key, label in PROVENANCE.items() if facts.get(key) is not None]


def _run(trace: Trace, summary: Mapping[str, object]) -> list[Figure]:
    simulated_s = float(trace.t_s[-1] - trace.t_s[0])
    result = [Figure("Simulated time", duration(simulated_s))]
    wall_s = _number(summary, "wall_s")
    if wall_s:
        result.append(
            Figure("Wall time", f"{wall_s:.1f} s", f"{simulated_s / wall_s:.1f} times as fast as real time")
        )
    moves = _number(summary, "moves")
    if moves is not None:
        result.append(Figure("Moves", f"{moves:,.0f}"))
    return result


def _temperature(trace: Trace, masks: Masks) -> list[Figure]:
    result = []
    rise_s = heat_up_time(trace)
    if rise_s is not None:
        result.append(
            Figure(
                "Heat-up",
                f"{rise_s:.1f} s",
                f"first target, to within {SETTLED_BAND_C:.0f} °C of it for good",
            )
        )
    chosen = masks.settled & masks.prints
    if not chosen.any():
        return [
            *result,
            Figure("Temperature while printing", "none", "the nozzle was never settled while printing"),
        ]
    target = trace.target_c[chosen]
    error = trace.true_c[chosen] - target
    seen = trace.estimate_c[chosen] - trace.true_c[chosen]
    where = "true minus target, printing, settled"
    inside = 100.0 * np.mean(np.abs(error) <= SETTLED_BAND_C)
    return [
        *result,
        Figure("Target while printing", _span(target, "°C", 0)),
        Figure("Temperature error, rms", f"{_rms(error):.2f} °C", where),
        Figure("Temperature error, range", _span(error, "°C", 2, signed=True), where),
        Figure(f"Time within ±{SETTLED_BAND_C:.0f} °C", f"{inside:.2f} %", where),
        Figure("Estimator error, rms", f"{_rms(seen):.2f} °C", "estimate minus true, printing, settled"),
        Figure(
            "Estimator error, mean",
            f"{_decimal(np.nanmean(seen), 2, signed=True)} °C",
            "estimate minus true, printing, settled",
        ),
    ]


def _material(trace: Trace, masks: Masks, layers: Sequence[Layer]) -> list[Figure]:
    if not masks.extrudes.any():
        return [Figure("Printed", "nothing", "the file deposits down no plastic")]
    flow = trace.flow_mm3_s[masks.extrudes]
    melt = trace.melt_c[masks.extrudes]
    low, high = np.percentile(melt, (1, 99))
    return [
        Figure(
            "Layers",
            f"{len(layers)}",
            f"up to z = {max((layer.z_mm for layer in layers), default=0.0):.2f} mm",
        ),
        Figure(
            "Flow",
            f"{float(flow.mean()):.2f} mm³/s",
            f"mean while extruding; greatest {float(flow.max()):.1f} mm³/s",
        ),
        Figure(
            "Melt leaving the nozzle",
            f"{float(melt.mean()):.1f} °C",
            f"98 % of it {low:.0f} to {high:.0f} °C",
        ),
    ]


def _power(trace: Trace, masks: Masks) -> list[Figure]:
    energy_j = float(np.sum(trace.power_w[:-1] * np.diff(trace.t_s)))
    result = [
        Figure("Power into the nozzle, greatest", f"{float(trace.power_w.max()):.1f} W"),
        Figure("Energy into the nozzle", f"{energy_j / 1000.0:.2f} kJ", f"{energy_j / 3600.0:.2f} Wh"),
    ]
    if masks.prints.any():
        mean_w = float(trace.power_w[masks.prints].mean())
        result.insert(0, Figure("Power into the nozzle", f"{mean_w:.1f} W", "mean while printing"))
    return result


def _trouble(summary: Mapping[str, object]) -> list[Figure]:
    faults = summary.get("faults")
    if faults is None:
        return []
    if isinstance(faults, (list, tuple)):
        return [Figure("Faults", "; ".join(str(f) for f in faults) or "none")]
    return [Figure("Faults", str(faults) or "none")]


def heat_up_time(trace: Trace) -> float | None:
    """Seconds from the first target above zero until settled there for good; None if it never was."""
    asked = np.flatnonzero(trace.target_c > 0.0)
    if not len(asked):
        return None
    changes = np.flatnonzero(trace.target_c[asked[0] :] != trace.target_c[asked[0]])
    end = asked[0] + changes[0] if len(changes) else len(trace.t_s)
    arrived = np.flatnonzero(settled(trace)[asked[0] : end])
    return float(trace.t_s[asked[0] + arrived[0]] - trace.t_s[asked[0]]) if len(arrived) else None


def duration(seconds: float) -> str:
    """3723.4 -> "1 h 02 min 03 s"; below a minute with a tenth."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min {rest:02d} s" if hours else f"{minutes} min {rest:02d} s"


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(np.square(values, dtype=np.float64))))


def _decimal(value: float | np.floating, digits: int, signed: bool = False) -> str:
    """A number for print: a true minus sign, and no sign on what rounds to nothing."""
    rounded = round(float(value), digits) + 0.0
    text = f"{rounded:{'+' if signed and rounded else ''}.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _span(values: Floats, unit: str, digits: int, signed: bool = False) -> str:
    low, high = (_decimal(v, digits, signed) for v in (values.min(), values.max()))
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _number(summary: Mapping[str, object], key: str) -> float | None:
    value = summary.get(key)
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
