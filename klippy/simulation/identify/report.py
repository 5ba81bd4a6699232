"""A fitted plant as a section of a simulated printer's config, and as a picture."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from .fit import SCALE, Fit, Found
from .recording import Recording


def rms_c(run: Recording, fit: Fit) -> float:
    """Simulated against recorded temperature, both by the law of the run."""
    return float(np.sqrt(np.nanmean((run.temp_c - fit.temp_c) ** 2)))


def summary(run: Recording, fit: Fit) -> str:
    """One line for people."""
    unknown = [f.name for f in fit.found if math.isnan(f.sigma)]
    text = f"simulated against recorded: rms {rms_c(run, fit):.2f} C over {run.end_s[-1]:.0f} s"
    return text + (f"; this run does not determine {', '.join(unknown)}" if unknown else "")


def section(run: Recording, fit: Fit, source: str) -> str:
    """`[simulator nozzle NAME]` with what each parameter rests on."""
    lines = [f"[simulator nozzle {run.heater}]", f"# From {source}; {summary(run, fit)}."]
    if any(f.name == SCALE and math.isnan(f.sigma) for f in fit.found):
        lines.append(f"# All heat is in proportion to {SCALE}, which this run does not determine.")
    lines.append("preset: reference")
    if np.any(run.steps[:, 3] > 0.0):
        lines.append("fan: fan")
    for found in fit.found:
        lines.append(_option(found))
    found_names = {f.name for f in fit.found}
    lines.append("# From the sensing law, the drive law and the front end of the run, and given:")
    lines += [f"{name}: {value:.9g}" for name, value in fit.fixed.items() if name not in found_names]
    lines.append(f"start_c: {fit.changes()['start_c']:.4g}")
    return "\n".join(lines) + "\n"


def _option(found: Found) -> str:
    if math.isnan(found.sigma):
        return f"{found.name}: {found.value:.6g}  # not determined by this run: it would need {found.needs}"
    digits = 2 + max(0, math.ceil(math.log10(abs(found.value) / found.sigma)))
    return f"{found.name}: {found.value:.{digits}g}  # +- {found.sigma:.2g}, from {found.needs}"


def draw(run: Recording, fit: Fit, path: Path) -> None:
    """Recorded and simulated temperature, and their difference."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    rows = np.isfinite(run.temp_c)
    time_s = run.end_s[rows]
    top.plot(time_s, run.temp_c[rows], "C0.", ms=2, label="recorded")
    top.plot(time_s, fit.temp_c[rows], "C1-", lw=0.8, label="simulated")
    bottom.plot(time_s, (run.temp_c - fit.temp_c)[rows], "C2.", ms=2)
    top.set(ylabel="nozzle, °C", title=summary(run, fit))
    bottom.set(ylabel="difference, °C", xlabel="time, s")
    top.legend(loc="best")
    figure.savefig(path, dpi=100)
