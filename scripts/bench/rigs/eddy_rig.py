"""A calibrated eddy probe on the simulated machine of config/probes/sim-eddy.cfg with a flat bed: by G-code alone.

The head's height is declared to be the true one; so the paper test is a TESTZ of what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import probe_rig
from probe_rig import FLAT, Option, Probed

CONFIG = probe_rig.ROOT / "config" / "probes" / "sim-eddy.cfg"
SECTION = "probe_eddy_current coil"
GAUGE = "simulator gauge probe_eddy_current coil"
FORCE = ("force_move", "enable_force_move", "1")
START = "SET_KINEMATIC_POSITION X=71.3 Y=40.2 Z=12.7\nG1 X100 Y100 F6000\n"
CALIBRATE = f"{START}PROBE_EDDY_CURRENT_CALIBRATE CHIP=coil\nTESTZ Z=-12.7\nACCEPT\n"


def coil(**options: float) -> list[Option]:
    """Options of the simulated coil."""
    return [(GAUGE, name, str(value)) for name, value in options.items()]


def run(folder: Path, gcode: str, options: Sequence[Option] = (), seed: int = 1) -> Probed:
    return probe_rig.run(folder, gcode, *FLAT, FORCE, *options, seed=seed, config=CONFIG)


def calibration(result: Probed) -> list[Option]:
    """What SAVE_CONFIG would write of a run, for the next one."""
    found = result.object(SECTION).coil
    options = [
        (SECTION, "calibrate", found.curve.text()),
        (SECTION, "calibration_temp", str(found.calibration_c)),
    ]
    if found.drift is not None:
        options.append((SECTION, "drift_calibration", found.drift.text()))
    return options


def drift_gcode(ramp_k_s: float, step_k: float, count: int) -> str:
    """The drift calibration at `count` temperatures, `step_k` apart; the coil warms at ramp_k_s."""
    text = f"{START}G1 Z5\nTEMPERATURE_PROBE_CALIBRATE PROBE=coil TARGET=79 STEP=26\nTESTZ Z=-5\nACCEPT\n"
    return text + (
        f"G4 P{1000.0 * step_k / ramp_k_s:.0f}\nTEMPERATURE_PROBE_NEXT\nTESTZ Z=-0.4\nACCEPT\n" * (count - 1)
        + "TEMPERATURE_PROBE_COMPLETE\n"
    )
