#!/usr/bin/env python3
"""Simulates bridge and tank in time and writes the tables of the simulated nozzle.

    scripts/bench/bridge_circuit.py [--check]

The circuit is test/data/bridge_circuit.cir, whose .param lines are read here. Each leg is a node with its output
capacitance. A switch ties it to a rail. With both switches open the current of the tank charges it up to a diode. The
tank is stepped exactly for a constant voltage. Coil inductance and resistance follow temperature and amplitude,
once a period, by the two tables of components below. Results go to test/data/bridge_circuit.csv, and as differences
against dead time 0 to klippy/simulation/plant/bridge_table.h. --check compares the header with the table instead.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm

ROOT = Path(__file__).resolve().parents[2]
NETLIST = ROOT / "test" / "data" / "bridge_circuit.cir"
TABLE = NETLIST.with_suffix(".csv")
HEADER = ROOT / "klippy" / "simulation" / "plant" / "bridge_table.h"
PHASE_FULL = 45000
STEPS, PERIODS = 8192, 36  # a step of 1 ns; 36 periods are 11 time constants of the tank

DEAD_TIMES_NS = (0.0, 60.0, 120.0, 200.0, 300.0)
SUPPLIES_V = (22.8, 25.2)  # beside the 24 V of the netlist
DRIVES = tuple(range(1500, PHASE_FULL + 1, 1500))
TEMPS_C = (25.0, 150.0, 275.0, 400.0, 525.0)
# Components of the coil, assumed: effect of temperature on L1 over x = |I1| / 39.7 A in steps of 0.1. It differs from
# the fit to Table 1 of Oskolkov 2021 by up to 0.03.
SATURATION = (1.0, 0.9998, 0.991, 0.968, 0.931, 0.882, 0.821, 0.745, 0.643, 0.504, 0.337, 0.171, 0.06)
# Relative change of the tank's resistance: rows at TEMPS_C, columns at x = 0, 0.25 ... 1. 3e-4/K at small current about
# 250 degC, less in saturated steel.
RESISTANCE = (
    (-0.0640, -0.0648, -0.0663, -0.0668, -0.0640),
    (-0.0297, -0.0308, -0.0333, -0.0359, -0.0372),
    (0.0076, 0.0064, 0.0031, -0.0017, -0.0069),
    (0.0463, 0.0446, 0.0401, 0.0331, 0.0243),
    (0.0846, 0.0825, 0.0768, 0.0678, 0.0561),
)


def parameters() -> dict[str, float]:
    """The .param lines of the netlist, in SI units."""
    scale = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3}
    found = re.findall(r"^\.param (\w+)=([-0-9.e]+)([numk]?)\b", NETLIST.read_text(encoding="utf-8"), re.M)
    return {name: float(number) * scale[unit] for name, number, unit in found}


def curve(values: Sequence[float], step: float) -> CubicHermiteSpline:
    """Through evenly spaced values, with the slopes of their neighbours, as the plant does (Catmull-Rom)."""
    return CubicHermiteSpline(step * np.arange(len(values)), values, np.gradient(values, step))


class Circuit:
    """All combinations at once: arrays over (dead time, temperature, drive), flat."""

    def __init__(
        self,
        dead_times_ns: Sequence[float] = DEAD_TIMES_NS,
        temps_c: Sequence[float] = TEMPS_C,
        drives: Sequence[int] = DRIVES,
        steps: int = STEPS,
        **changes: float,
    ) -> None:
        self.p, self.steps = parameters() | changes, steps
        grid = np.meshgrid(dead_times_ns, temps_c, drives, indexing="ij")
        self.shape = grid[0].shape
        self.dead_s, self.temp_c, self.ticks = (axis.ravel() for axis in grid)
        self.dead_s = self.dead_s * 1e-9
        self.period_s = 1.0 / self.p["fsw"]
        self.dt = self.period_s / steps
        self.shift_s = 0.5 * self.period_s * self.ticks / PHASE_FULL
        self.legs = [self._schedule(np.zeros_like(self.shift_s)), self._schedule(self.shift_s)]
        self.node_v = np.zeros((2, self.ticks.size))
        self.amplitude = np.zeros(self.ticks.size)
        self.state = self._first_harmonic()  # current of L2, voltage of C1, current of L1

    def _schedule(self, shift_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each step: state at its begin and end (1 high, -1 low, 0 open), and the share before the change."""
        half, t = 0.5 * self.period_s, np.arange(self.steps)[:, None] * self.dt
        local = (t - shift_s) % self.period_s

        def level(x: np.ndarray) -> np.ndarray:
            x = x % self.period_s
            side = np.where(x < half, 1, -1)
            return np.where(x % half < self.dead_s, 0, side).astype(np.int8)

        before, after = level(local), level(local + self.dt)
        edges = np.stack([np.zeros_like(self.dead_s), self.dead_s, np.full_like(self.dead_s, half)])
        next_s = np.full_like(local, np.inf)
        for edge in [*edges, half + self.dead_s]:
            ahead = (edge - local) % self.period_s
            next_s = np.minimum(next_s, np.where(ahead <= 0.0, self.period_s, ahead))
        share = np.where(before != after, np.clip(next_s / self.dt, 0.0, 1.0), 1.0)
        return before, after, share

    def _first_harmonic(self) -> np.ndarray:
        """The state at the begin of a period if the bridge gave a sine: where the simulation begins."""
        p, w = self.p, 2.0 * np.pi * self.p["fsw"]
        for _ in range(10):
            l1, r = self.coil()
            coil_ohm, c1_s = r + 1j * w * l1, 1j * w * p["c1"]
            angle = np.pi * self.shift_s / self.period_s
            volt = 4.0 / np.pi * p["vdc"] * np.sin(angle) * np.exp(-1j * angle)
            current = volt / (coil_ohm + 1j * w * p["l2"] * (1.0 + coil_ohm * c1_s))
            self.amplitude = np.abs(current)
        return np.array([current * (1.0 + coil_ohm * c1_s), current * coil_ohm, current]).real

    def _part(self, leg: int, level: np.ndarray, out_a: np.ndarray, span_s: np.ndarray) -> np.ndarray:
        """One leg for part of a step; returns the integral of its voltage."""
        p, v = self.p, self.node_v[leg]
        tied = np.where(level > 0, p["vdc"], 0.0) - out_a * p["ron"]
        free = np.minimum(np.maximum(v - out_a * span_s / p["coss"], -p["vf"]), p["vdc"] + p["vf"])
        end = np.where(level == 0, free, tied)
        area = np.where(level == 0, 0.5 * (v + end), end) * span_s
        self.node_v[leg] = np.where(span_s > 0.0, end, v)
        return area

    def coil(self) -> tuple[np.ndarray, np.ndarray]:
        """Inductance and resistance at the present amplitude."""
        p, x = self.p, self.amplitude / self.p["isat"]
        l1 = p["l1"] * (1.0 - p["l1slope"] * curve(SATURATION, 0.1)(x) * (self.temp_c - p["l1ref"]))
        rise = np.zeros_like(x)
        for temp_c, row in zip(TEMPS_C, RESISTANCE, strict=True):
            rise = np.where(self.temp_c == temp_c, curve(row, 0.25)(x), rise)
        return l1, p["r"] * (1.0 + rise)

    def _tank(self) -> tuple[np.ndarray, np.ndarray]:
        """Exact step of the tank under a constant voltage, a matrix for each combination."""
        p, (l1, r) = self.p, self.coil()
        m = np.zeros((self.ticks.size, 4, 4))
        m[:, 0, 1], m[:, 0, 3] = -1.0 / p["l2"], 1.0 / p["l2"]
        m[:, 1, 0], m[:, 1, 2] = 1.0 / p["c1"], -1.0 / p["c1"]
        m[:, 2, 1], m[:, 2, 2] = 1.0 / l1, -r / l1
        step = expm(m * self.dt)
        return step[:, :3, :3], step[:, :3, 3].T

    def period(self) -> np.ndarray:
        """One period; returns the first harmonic of the coil's current, against the centre of the commanded pulse."""
        step, drive = self._tank()
        total = np.zeros(self.ticks.size, dtype=complex)
        turn = np.exp(-2j * np.pi * np.arange(self.steps) / self.steps)
        changes = [share.min(axis=1) < 1.0 for _, _, share in self.legs]
        for n in range(self.steps):
            areas = []
            for leg, (before, after, share) in enumerate(self.legs):
                out_a = self.state[0] if leg == 0 else -self.state[0]
                span_s = share[n] * self.dt
                area = self._part(leg, before[n], out_a, span_s)
                if changes[leg][n]:
                    area = area + self._part(leg, after[n], out_a, self.dt - span_s)
                areas.append(area)
            total += turn[n] * self.state[2]
            volt = (areas[0] - areas[1]) / self.dt
            self.state = np.einsum("kij,jk->ik", step, self.state) + drive * volt
        harmonic = 2.0 / self.steps * total
        self.amplitude = np.abs(harmonic)
        return harmonic * np.exp(1j * np.pi * self.shift_s / self.period_s)

    def run(self, periods: int = PERIODS) -> tuple[np.ndarray, np.ndarray]:
        """Current phase psi (degrees) and amplitude (A) in the steady state, by (dead time, temperature, drive)."""
        for _ in range(periods):
            current = self.period()
        return np.degrees(np.angle(-current)).reshape(self.shape), np.abs(current).reshape(self.shape)


def write_table() -> None:
    psi_deg, current_a = Circuit().run()
    others = [Circuit(vdc=volt).run()[0] for volt in SUPPLIES_V]
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(
            [
                "dead_time_ns",
                "temp_c",
                "phase_ticks",
                "psi_deg",
                "coil_a",
                *(f"psi_{volt:g}_v_deg" for volt in SUPPLIES_V),
            ]
        )
        for index in np.ndindex(psi_deg.shape):
            place = DEAD_TIMES_NS[index[0]], TEMPS_C[index[1]], DRIVES[index[2]]
            found = (psi_deg[index], current_a[index], *(other[index] for other in others))
            rows.writerow([*(f"{x:g}" for x in place), *(f"{x:.4f}" for x in found)])


def header() -> str:
    """The C table: what dead time adds to psi, how that moves with the supply (by its logarithm), and the logarithm of
    what it leaves of the current.
    """
    with TABLE.open(encoding="utf-8") as file:
        data = np.array([[float(x) for x in row] for row in list(csv.reader(file))[1:]])
    shape = len(DEAD_TIMES_NS), len(TEMPS_C), len(DRIVES)
    psi_deg, current_a, low_deg, high_deg = (data[:, k].reshape(shape) for k in range(3, 7))
    per_supply = (high_deg - low_deg) / np.log(SUPPLIES_V[1] / SUPPLIES_V[0])

    def rows(table: np.ndarray, digits: int) -> str:
        return ",\n".join("    {" + ", ".join(f"{x:.{digits}f}" for x in row) + "}" for row in table)

    def cube(name: str, table: np.ndarray) -> str:
        body = ",\n".join("  {\n" + rows(block, 3) + "}" for block in table)
        return f"static const double {name}[{shape[0] - 1}][{shape[1]}][{shape[2]}] = {{\n{body}}};\n"

    def line(name: str, values: Sequence[float]) -> str:
        return f"static const double {name}[{len(values)}] = {{{', '.join(f'{x:g}' for x in values)}}};\n"

    return (
        "// Made by scripts/bench/bridge_circuit.py from test/data/bridge_circuit.csv; origin and circuit there.\n"
        "// clang-format off\n"
        + line("bridge_dead_ns", DEAD_TIMES_NS)
        + f"enum {{ BRIDGE_DEADS = {shape[0]}, BRIDGE_TEMPS = {shape[1]}, BRIDGE_DRIVES = {shape[2]} }};\n"
        + f"static const double bridge_temp_low_c = {TEMPS_C[0]:g}, bridge_temp_step_k = {TEMPS_C[1] - TEMPS_C[0]:g}, "
        + f"bridge_drive_step_ticks = {DRIVES[0]};\n"
        + cube("bridge_psi_deg", psi_deg[1:] - psi_deg[0])
        + cube("bridge_psi_deg_per_supply", per_supply[1:] - per_supply[0])
        + cube("bridge_log_current", np.log(np.maximum(current_a[1:] / current_a[0], 1e-3)))
        + line("coil_saturation", SATURATION)
        + f"static const double coil_resistance[{shape[1]}][5] = {{\n{rows(np.array(RESISTANCE), 4)}}};\n"
        + "// clang-format on\n"
    )


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        description="Circuit simulation of bridge and tank; writes the plant's tables."
    )
    parser.add_argument("--check", action="store_true", help="only compare the C header with the table")
    if parser.parse_args(argv).check:
        return int(HEADER.read_text(encoding="utf-8") != header())
    write_table()
    HEADER.write_text(header(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
