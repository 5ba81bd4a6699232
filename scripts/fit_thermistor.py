#!/usr/bin/env python3
"""Fit thermistor models to a measured table, print their fitness, and give the printer.cfg section.

    scripts/fit_thermistor.py TABLE.csv [--pullup OHM --supply V] [--parallel OHM] [--plot PNG] [--json OUT]

TABLE.csv has a header with temp_c and ohm, or temp_c and volt (then --pullup and --supply are needed for the
resistance models).  Exit status 0 fitted, 2 the input cannot be used.
"""

from __future__ import annotations

import in_venv

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from extras.polynomial_thermistor import Polynomial
from thermal.identification.fit_data import read_columns
from thermal.identification.fit_sensing import FitError
from thermal.identification.fit_thermistor import (
    MODELS,
    Array,
    Divider,
    ThermistorFit,
    ThermistorFitError,
    fit_thermistor,
)


def read_table(path: Path, divider: Divider | None) -> tuple[Array, dict[str, Array]]:
    """(temp_c, {"ohm": ..., "volt": ...}) with what can be known; raises ThermistorFitError."""
    columns = read_columns(path)
    if "temp_c" not in columns or not {"ohm", "volt"} & columns.keys():
        raise ThermistorFitError(f"{path}: columns must be temp_c and ohm, or temp_c and volt")
    known: dict[str, Array] = {str(name): columns[name] for name in ("ohm", "volt") if name in columns}
    if divider and "ohm" not in known:
        known["ohm"] = divider.ohms(known["volt"])
    if divider and "volt" not in known:
        known["volt"] = divider.volts(known["ohm"])
    return columns["temp_c"], known


def fit_all(temp_c: Array, known: dict[str, Array], methods: list[str], seed: int) -> list[ThermistorFit]:
    fits = []
    for model in MODELS:
        x = known.get("volt" if model == "polynomial" else "ohm")
        if x is not None:
            fits += [fit_thermistor(model, method, x, temp_c, seed) for method in methods]
    return fits


def report(fits: list[ThermistorFit]) -> str:
    rows = ["model       method  fitness degC  worst degC  coefficients"]
    for f in fits:
        values = "  ".join(f"{name}={value:.9g}" for name, value in f.coefficients.items())
        worst = np.abs(f.residual_c).max()
        rows.append(f"{f.model:<11} {f.method:<7} {f.fitness_c:12.4f} {worst:11.3f}  {values}")
    return "\n".join(rows)


def config_section(fits: list[ThermistorFit], temp_c: Array, ohm: Array) -> str:
    """A [thermistor] section from the better of the two resistance models; a comment if it is no such sensor."""
    if np.corrcoef(temp_c, ohm)[0, 1] > 0.0:
        return (
            "# no [thermistor]: its resistance rises with temperature, as platinum's: take [adc_temperature]"
        )
    best = min((f for f in fits if f.model != "polynomial"), key=lambda f: f.fitness_c)
    k = best.coefficients
    if best.model == "beta":
        body = f"temperature1: 25\nresistance1: {k['r25']:.6g}\nbeta: {k['beta']:.6g}"
    else:
        picks = np.unique(np.linspace(0, temp_c.size - 1, 3).astype(int))
        rows = []
        for i, row in enumerate(np.argsort(temp_c)[picks], 1):
            log = np.log(ohm[row])
            smooth_c = 1.0 / (k["a"] + k["b"] * log + k["c"] * log**3) - 273.15
            rows.append(f"temperature{i}: {smooth_c:.3f}\nresistance{i}: {ohm[row]:.6g}")
        body = "\n".join(rows)
    how = f"{best.model} by {best.method}, fitness {best.fitness_c:.3f} degC"
    return f"[thermistor my_sensor]    # {how}\n{body}"


def polynomial_section(fits: list[ThermistorFit], volt: Array, supply_v: float) -> str:
    """A [polynomial_thermistor] section, valid between the voltages of the table; a comment if it turns round there."""
    best = min((f for f in fits if f.model == "polynomial"), key=lambda f: f.fitness_c)
    values = list(best.coefficients.values())
    try:
        Polynomial(values, supply_v, float(volt.min()), float(volt.max()))
    except ValueError as error:
        return f"# no [polynomial_thermistor]: {error}"
    return (
        f"[polynomial_thermistor my_sensor]    # by {best.method}, fitness {best.fitness_c:.3f} degC\n"
        f"coefficients: {', '.join(f'{v:.9g}' for v in values)}\n"
        f"adc_voltage: {supply_v:g}\nmin_voltage: {volt.min():.6g}\nmax_voltage: {volt.max():.6g}"
    )


def draw(fits: list[ThermistorFit], temp_c: Array, path: Path) -> None:
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    order = np.argsort(temp_c)
    for f in fits:
        label = f"{f.model} {f.method}: {f.fitness_c:.3f}"
        axes.plot(
            temp_c[order],
            f.residual_c[order],
            "o-",
            ms=3,
            lw=1,
            label=label,
        )
    axes.set(xlabel="temperature, °C", ylabel="model − table, °C", title="thermistor fits (fitness in °C)")
    axes.axhline(0, color="0.7", lw=0.8)
    axes.legend()
    figure.savefig(path, dpi=110)


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", type=Path)
    parser.add_argument("--pullup", type=float, metavar="OHM", help="pull-up resistor")
    parser.add_argument("--supply", type=float, metavar="V", default=5.0, help="divider supply (default 5 V)")
    parser.add_argument(
        "--parallel", type=float, metavar="OHM", default=float("inf"), help="resistor across it"
    )
    parser.add_argument("--method", choices=("lsq", "pso", "both"), default="both")
    parser.add_argument("--seed", type=int, default=1, help="of the particle swarm")
    parser.add_argument("--json", type=Path, metavar="OUT")
    parser.add_argument("--plot", type=Path, metavar="OUT.png")
    return parser


def main(argv: list[str] | None = None) -> int:
    options = arguments().parse_args(argv)
    methods = ["lsq", "pso"] if options.method == "both" else [options.method]
    try:
        if any(v is not None and v <= 0 for v in (options.pullup, options.supply, options.parallel)):
            raise ThermistorFitError("--pullup, --supply and --parallel must be positive")
        divider = Divider(options.pullup, options.supply, options.parallel) if options.pullup else None
        temp_c, known = read_table(options.table, divider)
        fits = fit_all(temp_c, known, methods, options.seed)
    except (ThermistorFitError, FitError, OSError) as error:
        print(f"fit_thermistor: {error}", file=sys.stderr)
        return 2
    print(report(fits))
    if "ohm" in known:
        print("\n" + config_section(fits, temp_c, known["ohm"]))
    if "volt" in known:
        print("\n" + polynomial_section(fits, known["volt"], options.supply))
    if options.json:
        body = [
            {"model": f.model, "method": f.method, "fitness_c": f.fitness_c, **f.coefficients} for f in fits
        ]
        options.json.write_text(json.dumps(body, indent=2) + "\n", encoding="utf-8")
    if options.plot:
        draw(fits, temp_c, options.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
