"""What two witnesses say of a nozzle: its heat (flow_monitor.py) and its mount's vibration (mount_witness.py).

    flow is lost    hole narrowed    condition
    no              no               clear
    no              yes              restricted; clogged below HALF_CLOSED of the diameter
    yes             no               restricted; no_filament if nearly all is lost: runout, grinding
    yes             yes              clogged

A witness that cannot judge is left out; with none the condition is unknown. Both sums of flow_monitor.py's test are one
test already: the vibration's likelihood ratio is added there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermal.sensing import flow_monitor

from . import mount_witness

CLOGGED = "clogged"
HALF_CLOSED = 0.7  # of the diameter: half of the area
ALL_LOST = 0.75


@dataclass(frozen=True, slots=True)
class Heat:
    """What the heat says; None: nothing."""

    parameters: flow_monitor.FlowMonitorParameters | None = None
    state: flow_monitor.FlowMonitorState | None = None

    def condition(self) -> str:
        if self.parameters is None or self.state is None:
            return flow_monitor.UNKNOWN
        return flow_monitor.condition(self.parameters, self.state)


@dataclass(frozen=True, slots=True)
class Vibration:
    """What the vibration says; None: nothing."""

    parameters: mount_witness.MountParameters | None = None
    state: mount_witness.MountState | None = None

    @property
    def judges(self) -> bool:
        return self.state is not None and self.state.is_ready and bool(self.state.recent)

    def diameter_share(self) -> float:
        """Of the clear hole's."""
        return math.exp(self.state.log_diameter) if self.judges and self.state is not None else math.nan

    def lost_share(self) -> float:
        """Of the flow, if the hole is as it was."""
        state, p = self.state, self.parameters
        if state is None or p is None or not self.judges:
            return 0.0
        return max(0.0, 1.0 - math.exp(-p.exponent / state.flow_exponent * state.log_diameter))


def condition(heat: Heat, vibration: Vibration) -> str:
    """One of clear, restricted, clogged, no_filament, unknown."""
    by_heat = heat.condition()
    narrowed = vibration.judges and vibration.state is not None and vibration.state.is_narrowed
    lost_by_vibration = vibration.judges and vibration.state is not None and vibration.state.is_lost
    if by_heat in (flow_monitor.RESTRICTED, flow_monitor.NO_FILAMENT):
        return CLOGGED if narrowed else by_heat
    if narrowed:
        return CLOGGED if vibration.diameter_share() < HALF_CLOSED else flow_monitor.RESTRICTED
    if lost_by_vibration:
        all_lost = vibration.lost_share() >= ALL_LOST
        return flow_monitor.NO_FILAMENT if all_lost else flow_monitor.RESTRICTED
    return flow_monitor.CLEAR if vibration.judges or by_heat == flow_monitor.CLEAR else flow_monitor.UNKNOWN
