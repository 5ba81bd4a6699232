"""The estimate of the tip against the simulated nozzle's, at a steady flow."""

from __future__ import annotations

import pytest

from system.conftest import Simulate
from thermal.models.melt_exchange import MeltExchange

FLOW = "G28\nG1 X10 Y40 Z1 F6000\nM83\nM109 S250\nM400\nG1 X160 E{mm:.3f} F{feed}\nM400\n"


@pytest.mark.parametrize("flow_mm3_s", [4.0, 12.0])
def test_the_tip_lies_below_the_nozzle_by_the_heat_into_the_melt(
    simulate: Simulate, flow_mm3_s: float
) -> None:
    mm = 6.0 if flow_mm3_s > 8.0 else 3.0
    feed = 60.0 * 150.0 * flow_mm3_s / (mm * 2.405)
    run = simulate(FLOW.format(mm=mm, feed=round(feed)), settings=["simulator nozzle nozzle.tip_k_w=3.1"])
    assert run.status == 0, run.stderr
    columns = zip(*map(run.column, ("flow_mm3_s", "true_c", "tip_c")), strict=True)
    steady = [row for row in columns if row[0] > 0.98 * flow_mm3_s][-1]
    below_c = steady[1] - MeltExchange().tip_c(steady[1], steady[0])
    assert below_c > 5.0
    assert below_c == pytest.approx(
        steady[1] - steady[2], rel=0.12
    )  # the heat is that of the bore, not of the tip
