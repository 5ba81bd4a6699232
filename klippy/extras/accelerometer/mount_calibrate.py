"""NOZZLE_MONITOR_CALIBRATE with an accelerometer: extrude at several flows, find the mount's resonance and its law.

extrude in the air, at rest and at each flow ─► raw files ─► vibration/fit_mount.py, a process of its own ─► SAVE_CONFIG
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gcode import GCodeCommand
from roles import Printer
from vibration import mount_witness

from .mount import MountVibration

HOST_FOLDER = Path(__file__).resolve().parents[2]
REST_S = 5.0
LEAD_S = 1.0  # of a flow, before it is measured
LOW_C = 150.0
FLOWS_APART = 1.5  # the greatest over the smallest: nearer ones give no exponent


@dataclass(frozen=True, slots=True)
class Found:
    """What a calibration found."""

    frequency_hz: float
    quality: float
    amplitude_m_s2: float
    flow_exponent: float
    flow_exponent_sigma: float
    noise_m_s2: float
    weakest_m_s2: float

    @property
    def times_longer(self) -> float:
        """For a flow exponent that is known well enough: 1 if it is."""
        return max(1.0, (self.flow_exponent_sigma / mount_witness.FLOW_EXPONENT_SIGMA) ** 2)


def fit_law(
    p: mount_witness.MountParameters, found: dict[str, Any], flows: Sequence[float], temp_c: float
) -> Found:
    """A and m of the amplitudes at some flows: a straight line in logarithms, by least squares with their sigmas."""
    rows = [
        (math.log(flow / mount_witness.FLOW_MM3_S), math.log(max(1e-9, amplitude)), sigma**-2)
        for flow, amplitude, sigma in zip(flows, found["amplitudes_m_s2"], found["sigmas"], strict=True)
    ]
    weight = sum(w for _, _, w in rows)
    mean_x, mean_y = (sum(row[i] * row[2] for row in rows) / weight for i in (0, 1))
    spread = sum(w * (x - mean_x) ** 2 for x, _, w in rows)
    m = sum(w * (x - mean_x) * (y - mean_y) for x, y, w in rows) / spread
    _, b = mount_witness.law_exponents(p)
    warm = b * (1.0 / (temp_c + mount_witness.KELVIN) - 1.0 / (mount_witness.TEMP_C + mount_witness.KELVIN))
    return Found(
        found["frequency_hz"], found["quality"], math.exp(mean_y - m * mean_x - warm), min(2.0, max(0.3, m)),
        spread**-0.5, found["noise_m_s2"], min(found["amplitudes_m_s2"]),
    )  # fmt: skip


def _read_flows(gcmd: GCodeCommand) -> list[float]:
    try:
        flows = [float(word) for word in gcmd.get("FLOW", "3,5,8").split(",")]
    except ValueError:
        flows = []
    if not flows or not 0.0 < FLOWS_APART * min(flows) <= max(flows):
        raise gcmd.error(
            "NOZZLE_MONITOR_CALIBRATE: FLOW must be flows in mm3/s, the greatest at least"
            f" {FLOWS_APART} times the smallest, such as 3,5,8"
        )
    return flows


def measure(
    printer: Printer, gcmd: GCodeCommand, vibration: MountVibration, extruder: Any, temp_c: float
) -> Found:
    """Extrude and evaluate; raises the command's error."""
    flows = _read_flows(gcmd)
    seconds = gcmd.get_float("TIME", 20.0 if vibration.parameters.frequency_hz > 50.0 else 60.0, minval=3.0)
    if temp_c < LOW_C:
        raise gcmd.error(f"NOZZLE_MONITOR_CALIBRATE: heat the nozzle first; it has {temp_c:.0f} C")
    gcode = printer.lookup_object("gcode")
    gcode.run_script_from_command("M400\nM83")
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.csv" for number in range(len(flows) + 1)]
        for path, flow in zip(paths, [0.0, *flows], strict=True):
            if flow:
                _extrude(gcode, extruder, flow, LEAD_S)
            recording = vibration.sensor.start_internal_client()
            if flow:
                _extrude(gcode, extruder, flow, seconds)
            else:
                gcode.run_script_from_command(f"G4 P{1000.0 * REST_S:.0f}")
            recording.finish_measurements()
            if recording.fault is not None:
                raise gcmd.error(f"NOZZLE_MONITOR_CALIBRATE: the accelerometer is {recording.fault}")
            recording.write_to_file(str(path))
        found = _evaluate(printer, gcmd, vibration, paths)
    return fit_law(vibration.parameters, found, flows, temp_c)


def _extrude(gcode: Any, extruder: Any, flow_mm3_s: float, seconds: float) -> None:
    speed_mm_s = flow_mm3_s / extruder.filament_area
    gcode.run_script_from_command(f"G1 E{speed_mm_s * seconds:.5f} F{60.0 * speed_mm_s:.4f}")


def _evaluate(
    printer: Printer, gcmd: GCodeCommand, vibration: MountVibration, paths: Sequence[Path]
) -> dict[str, Any]:
    command = [sys.executable, "-m", "vibration.fit_mount", "--axis", "xyz"[vibration.axis], *map(str, paths)]
    run = partial(subprocess.run, command, cwd=HOST_FOLDER, capture_output=True, text=True, check=False)
    done = printer.get_reactor().run_beside(run).wait()
    if isinstance(done, Exception) or done.returncode:
        lines = str(done) if isinstance(done, Exception) else done.stderr.strip()
        raise gcmd.error(f"NOZZLE_MONITOR_CALIBRATE: {(lines.splitlines() or ['no reason'])[-1]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result
