"""From the recording of MODEL_CALIBRATE (step_test.py) to a model with its uncertainty. Offline code: numpy, scipy.

    python -m thermal.identification.fit_load TRACE.csv --power W --ambient C [--nozzle]        the result as JSON

The model is model_plant's own, run open loop from the first row with the recorded outputs; least squares finds

    ordinary   heat capacity, loss, two lags, and where the run has the steps, fan loss and melt exchange
    nozzle     heat capacity, loss factor, factor of the second mass (the paths' ratios are the reference nozzle's),
               and from further steps with extrusion the exchange with the melt (fit_melt.py)

The two lags of an ordinary heater (element, sensor) differ only in their order: the longer one is assigned to the
element, which is taken as ELEMENT_SHARE of the heat. 1 sigma is the jackknife's, and a share for the
shape of the model. The segment from `validate` on is kept from the fit; a fit that does not predict it is refused.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from thermal.control.nozzle_model import nozzle_model
from thermal.control.timeline import Timing
from thermal.models.heat_loss import HeatCapacity
from thermal.models.heater_model import ModelParameters, advance, at_rest, stepped
from thermal.models.melt_exchange import MeltExchange
from thermal.sensing.heat_balance_monitor import scaled

from . import fit_melt
from .step_test import MELT, MELT_PROOF, STAGES, Row

ELEMENT_SHARE = 0.2
COLUMNS = Row._fields
HELD_OUT = ("validate", "coast")
MIN_ROWS = 30
DOUBT = 0.30  # relative 1 sigma of heat or loss beyond which a run determines nothing
VALID_C, VALID_SHARE = (
    1.0,
    0.012,
)  # rms on the held-out segment: this, or this share of the rise, whichever is more
STRIDE_S = 0.02  # rows nearer than this are taken together
BAD_C = 1e3
BLOCKS = 10  # of the jackknife
FIT_STEP_S = 0.1  # of the integration
# No heater is three nodes: the simulated bed, which loses heat at two places where the model has one, comes out 2 %
# too heavy, the same in every part of the run. Half of that as 1 sigma of any number.
FORM_SHARE = 0.01
FILAMENT_SHARE, INLET_C = 0.1, 3.0  # 1 sigma of the heat of a volume of filament, and of where it enters
UNREPORTED = 0.5  # parameters with a relative 1 sigma above this are not reported
FLAT_C = 0.01  # rms that the readings move with a number (per e-fold): less is not seen


class LoadFitError(ValueError):
    """The recording does not give a model; the text is for people."""


@dataclass(frozen=True, slots=True)
class LoadFit:
    """Values and 1 sigma by option name, and how well they predict."""

    values: dict[str, float]
    sigma: dict[str, float]
    rms_c: float
    validation_rms_c: float
    validation_max_c: float
    limit_c: float

    def doubt(self, name: str) -> float:
        """1 sigma with what the run cannot show: the shape of the model. Not in it: wrong POWER or AMBIENT."""
        return math.hypot(self.sigma[name], FORM_SHARE * self.values[name])


Build = Callable[[Sequence[float]], ModelParameters]


def read_rows(path: Path) -> list[Row]:
    """The trace as written by the printer; raises LoadFitError."""
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise LoadFitError(f"{path}: columns must be {', '.join(COLUMNS)}")
        rows = []
        for r in reader:
            time_s, temp_c, output, fan, flow = (float(r[name]) for name in COLUMNS[:-1])
            rows.append(Row(time_s, temp_c, output, fan, flow, r["stage"]))
    return rows


def thin(rows: Sequence[Row], stride_s: float = STRIDE_S) -> list[Row]:
    """Every row with a reading at least `stride_s` after the one before; output and flow are the means since then."""
    first = next((i for i, row in enumerate(rows) if row.temp_c == row.temp_c), len(rows))
    rows = rows[first:]
    if not rows:
        raise LoadFitError("there is not one reading")
    kept = [rows[0]]
    energy = volume = 0.0
    for before, row in pairwise(rows):
        energy += row.output * (row.time_s - before.time_s)
        volume += row.flow_mm3_s * (row.time_s - before.time_s)
        since_s = row.time_s - kept[-1].time_s
        changed = row.stage != kept[-1].stage
        if not math.isnan(row.temp_c) and (since_s >= stride_s or changed) and since_s > 0.0:
            kept.append(row._replace(output=energy / since_s, flow_mm3_s=volume / since_s))
            energy = volume = 0.0
    return kept


def predict(p: ModelParameters, rows: Sequence[Row]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Readings the model expects, degC, open loop from rest.

    Steps of one length whatever the lags: a number of steps that changes with the parameters makes ripples in which the
    least squares get caught (1.4 % of the loss). In the MELT steps the node is where it was measured: the heat of
    the filament is not asked for yet.
    """
    p = stepped(p, min(FIT_STEP_S, p.step_s) if p.second_j_k else FIT_STEP_S)
    nodes = at_rest(p, p.ambient_c)
    expected = [nodes.sensor_c]
    for before, row in pairwise(rows):
        drive, around = (row.output, 1.0, 0.0), (row.flow_mm3_s, row.fan)
        nodes = advance(p, nodes, drive, around, row.time_s - before.time_s)
        if row.stage.startswith(MELT):
            nodes = nodes._replace(temp_c=row.temp_c, sensor_c=row.temp_c)
        if not abs(nodes.temp_c) < BAD_C:
            return np.full(len(rows), BAD_C)
        expected.append(nodes.sensor_c)
    return np.array(expected)


ORDINARY = ("model_heat_j_per_k", "model_loss_w_per_k", "tau_long_s", "tau_short_s")
STEPS = {"fan": "model_fan_w_per_k", "flow": "model_melt_w_per_k"}
NOZZLE = ("heat_capacity_j_per_k", "loss_factor", "second_mass_factor")


def ordinary_model(
    names: Sequence[str], x: Sequence[float], power_w: float, ambient_c: float
) -> ModelParameters:
    """Model of an ordinary heater from the logarithms of its numbers."""
    v = dict(zip(names, np.exp(x).tolist(), strict=True))
    heat, element = v["model_heat_j_per_k"], ELEMENT_SHARE * v["model_heat_j_per_k"]
    return ModelParameters(
        heat_j_k=heat - element,
        loss_w_k=v["model_loss_w_per_k"],
        output_w=power_w,
        output_high=1.0,
        ambient_c=ambient_c,
        element_j_k=element,
        element_w_k=element * (1.0 - ELEMENT_SHARE) / v["tau_long_s"],
        sensor_s=v["tau_short_s"],
        fan_w_k=v.get("model_fan_w_per_k", 0.0),
        melt_ua_w_k=v.get("model_melt_w_per_k", 0.0),
        melt_in_c=ambient_c,
    )


def nozzle(x: Sequence[float], power_w: float, ambient_c: float) -> ModelParameters:
    heat, factor, second = np.exp(x).tolist()
    loss = scaled(factor, ambient_c, second)
    return nozzle_model(HeatCapacity(heat), loss, power_w, Timing(0.0016, 0.0002, 0.015, 0.1))


def _start(rows: Sequence[Row], power_w: float, ambient_c: float, names: Sequence[str]) -> list[float]:
    """First guesses from the heat-up (heat) and the hold (loss)."""
    energy_j = sum(b.output * power_w * (b.time_s - a.time_s) for a, b in pairwise(rows) if b.stage == "heat")
    hot_c = max(r.temp_c for r in rows)
    rise_k = max(1.0, hot_c - ambient_c)
    hold = [r.output for r in rows if r.stage == "hold"]
    loss = max(1e-3, power_w * (float(np.mean(hold)) if hold else 0.1) / rise_k)
    guess = {"model_heat_j_per_k": max(0.1, 0.85 * energy_j / rise_k), "model_loss_w_per_k": loss}
    guess |= {"tau_long_s": 4.0, "tau_short_s": 1.5}
    guess |= {"model_fan_w_per_k": 0.3 * loss, "model_melt_w_per_k": 0.3 * loss}
    return [math.log(guess[name]) for name in names]


def _sigma(jacobian: Any, residual: Any) -> Any:
    """1 sigma of the parameters by the jackknife: how much they move when a tenth of the run is left out.

    Noise alone would say next to nothing (thousands of readings). What limits a fit is that no heater is its model, and
    that shows as parts of the run that want other numbers (Efron and Tibshirani, An Introduction to the Bootstrap,
    ch. 11, with blocks as in Kuensch 1989). The fit without a block is one Gauss-Newton step away from the whole one.
    """
    blocks = np.array_split(np.arange(len(residual)), BLOCKS)
    moved = []
    for block in blocks:
        kept_jacobian, kept = np.delete(jacobian, block, axis=0), np.delete(residual, block)
        moved.append(-np.linalg.lstsq(kept_jacobian, kept, rcond=None)[0])
    spread = np.array(moved) - np.mean(moved, axis=0)
    sigma = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum(spread**2, axis=0))
    sigma[np.sqrt(np.mean(jacobian**2, axis=0)) < FLAT_C] = math.inf  # the run looks the same without it
    return sigma


def _unreported(ua_w_k: float, rows: Sequence[Row]) -> float:
    """Relative 1 sigma of an exchange found at one flow: the filament's heat and inlet temperature are assumed.

    heat = c f (1 - exp(-x)) (T - Tin), x = UA/(c f): filament that leaves as hot as the metal (x of 3 and more) takes
    the same heat whatever UA is.
    """
    flow = max(row.flow_mm3_s for row in rows)
    fed = [row.temp_c for row in rows if row.flow_mm3_s > 0.5 * flow]
    if not flow or not fed:
        return math.inf
    x = ua_w_k / (1e-3 * MeltExchange().heat_mj_m3k * flow)
    share = x / math.expm1(x) if x < 50.0 else 0.0  # of a relative change of UA in that of the heat
    given = math.hypot(
        (1.0 - share) * FILAMENT_SHARE, INLET_C / (sum(fed) / len(fed) - min(r.temp_c for r in rows))
    )
    found = given / max(share, 1e-9)
    return found if found < UNREPORTED else math.inf


def fit_rows(rows: list[Row], power_w: float, ambient_c: float, is_nozzle: bool) -> LoadFit:
    """Fit and validation. Raises LoadFitError when the run determines too little, or the model does not hold."""
    # the row that ended the run belongs to no stage
    rows = [row for row in thin(rows) if row.stage in STAGES or row.stage.startswith(MELT)]
    train = [r for r in rows if r.stage not in HELD_OUT]
    held = len(rows) - len(train)
    if len(train) < MIN_ROWS or held < MIN_ROWS // 3:
        raise LoadFitError("too few readings")
    names = (
        NOZZLE
        if is_nozzle
        else (*ORDINARY, *(o for s, o in STEPS.items() if any(r.stage == s for r in rows)))
    )
    build: Build
    if is_nozzle:
        start, build = [math.log(0.45), 0.0, 0.0], lambda x: nozzle(x, power_w, ambient_c)
    else:
        start, build = (
            _start(rows, power_w, ambient_c, names),
            lambda x: ordinary_model(names, x, power_w, ambient_c),
        )
    measured = np.array([r.temp_c for r in rows])
    fitted = np.array([not r.stage.startswith(MELT) for r in rows])
    count = len(train)
    found = optimize.least_squares(
        lambda x: (predict(build(x), train) - measured[:count])[fitted[:count]],
        start,
        bounds=(np.array(start) - 3.5, np.array(start) + 3.5),
        diff_step=1e-3,
        max_nfev=40,
    )
    error = predict(build(found.x), rows) - measured
    rise_k = float(measured.max()) - ambient_c
    shown, check = error[:count][fitted[:count]], error[count:]
    sigma = _sigma(found.jac, shown)
    if STEPS["flow"] in names:
        at = names.index(STEPS["flow"])
        sigma[at] = math.hypot(sigma[at], _unreported(math.exp(found.x[at]), train))
    fit = _result(names, found.x, sigma, shown, check, rise_k)
    _judge(fit, names)
    return fit


def _result(names: Sequence[str], x: Any, sigma: Any, error: Any, check: Any, rise_k: float) -> LoadFit:
    values = dict(zip(names, np.exp(x).tolist(), strict=True))
    relative = dict(zip(names, sigma.tolist(), strict=True))
    if "tau_long_s" in values and values["tau_long_s"] < values["tau_short_s"]:
        for pair in (values, relative):
            pair["tau_long_s"], pair["tau_short_s"] = pair["tau_short_s"], pair["tau_long_s"]
    return LoadFit(
        values,
        {name: values[name] * relative[name] for name in names},
        float(np.sqrt(np.mean(error**2))),
        float(np.sqrt(np.mean(check**2))),
        float(np.abs(check).max()),
        max(VALID_C, VALID_SHARE * rise_k),
    )


def _judge(fit: LoadFit, names: Sequence[str]) -> None:
    if fit.validation_rms_c > fit.limit_c:
        raise LoadFitError(
            f"the model misses the segment it was not shown by {fit.validation_rms_c:.2f} C rms ({fit.limit_c:.2f} C is"
            " the limit): something else took heat (fan, draught, filament), or power and sensor"
            " are not what the config says"
        )
    for name in names[:2]:
        if fit.sigma[name] > DOUBT * fit.values[name]:
            raise LoadFitError(
                f"the run does not determine {name}: {fit.values[name]:.3g} +- {fit.sigma[name]:.2g}"
            )


def fit_further(rows: Sequence[Row], fit: LoadFit, ambient_c: float) -> fit_melt.MeltFit | None:
    """The exchange with the melt, where the run has the steps for it."""
    if not any(row.stage == MELT_PROOF for row in rows):
        return None
    v = fit.values
    heat = HeatCapacity(v["heat_capacity_j_per_k"])
    loss = scaled(v["loss_factor"], ambient_c, v["second_mass_factor"])
    return fit_melt.fit_held(fit_melt.held_steps(thin(rows, 0.0), heat, loss), ambient_c)


def options(fit: LoadFit, power_w: float, ambient_c: float, is_nozzle: bool) -> dict[str, float]:
    """The fit in words of printer.cfg."""
    v = dict(fit.values)
    if is_nozzle:
        return {**v, "ambient_temp": ambient_c}
    heat = v.pop("model_heat_j_per_k")
    element, long_s, short_s = ELEMENT_SHARE * heat, v.pop("tau_long_s"), v.pop("tau_short_s")
    return {
        "heater_power_w": power_w,
        "model_heat_j_per_k": heat - element,
        "model_element_j_per_k": element,
        "model_element_w_per_k": element * (1.0 - ELEMENT_SHARE) / long_s,
        "model_sensor_lag": short_s,
        "model_ambient_temp": ambient_c,
        **v,
    }


LABELS = {
    "model_heat_j_per_k": "heat capacity, all, J/K",
    "model_loss_w_per_k": "loss, W/K",
    "tau_long_s": "longer lag, s",
    "tau_short_s": "shorter lag, s",
    "model_fan_w_per_k": "fan at full speed, W/K",
    "model_melt_w_per_k": "filament exchange, W/K",
    "heat_capacity_j_per_k": "heat capacity at 25 C, J/K",
    "loss_factor": "losses, x reference",
    "second_mass_factor": "second mass, x reference",
}


def report(fit: LoadFit) -> list[str]:
    lines = [
        f"  {LABELS[k]:<26} {v:9.4g} "
        + (
            f"+- {fit.doubt(k):.2g}"
            if math.isfinite(fit.sigma[k])
            else "(not determined by the run: any such value will do)"
        )
        for k, v in fit.values.items()
    ]
    lines.append(
        f"  residual {fit.rms_c:.2f} C rms; on the segment kept from the fit {fit.validation_rms_c:.2f} C rms, worst"
        f" {fit.validation_max_c:.2f} C"
    )
    return lines


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trace", type=Path)
    parser.add_argument("--power", type=float, required=True, help="W at full output")
    parser.add_argument("--ambient", type=float, required=True)
    parser.add_argument("--nozzle", action="store_true")
    chosen = parser.parse_args(argv)
    try:
        rows = read_rows(chosen.trace)
        fit = fit_rows(rows, chosen.power, chosen.ambient, chosen.nozzle)
        melt = fit_further(rows, fit, chosen.ambient) if chosen.nozzle else None
    except (LoadFitError, fit_melt.MeltFitError, OSError, ValueError) as error:
        print(f"fit_load: {error}", file=sys.stderr)
        return 2
    tuning, lines = options(fit, chosen.power, chosen.ambient, chosen.nozzle), report(fit)
    if melt is not None:
        tuning |= fit_melt.options(melt)
        lines += fit_melt.report(melt)
    print(json.dumps({"options": tuning, "values": fit.values, "sigma": fit.sigma, "report": lines}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
