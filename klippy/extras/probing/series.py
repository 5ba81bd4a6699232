"""Several points by one probe, in whichever of two ways it can be asked: a plugin's probe may have sessions only."""

from __future__ import annotations

from typing import Any

from gcode import GCodeCommand


def _at_nozzle(result: Any) -> list[float]:
    """x, y of the nozzle and its height at the trigger, from either form of a result."""
    if hasattr(result, "test_x"):
        return [result.test_x, result.test_y, result.test_z]
    return list(result[:3])


class Series:
    """From the constructor to `end`."""

    def __init__(self, probe: Any, gcmd: GCodeCommand, in_session: bool = False) -> None:
        self._probe, self._gcmd = probe, gcmd
        self._session: Any = None
        if hasattr(probe, "run_probe") and not in_session:
            probe.multi_probe_begin()
        else:
            self._session = probe.start_probe_session(gcmd)

    def run(self) -> list[float]:
        """Probe here; x, y of the nozzle and its height at the trigger (mm)."""
        if self._session is None:
            return list(self._probe.run_probe(self._gcmd))
        self._session.run_probe(self._gcmd)
        return _at_nozzle(self._session.pull_probed_results()[-1])

    def end(self) -> None:
        if self._session is None:
            self._probe.multi_probe_end()
        else:
            self._session.end_probe_session()


class Scan:
    """Points that a probe measures while it passes them. It has sessions, whose `run_probe` only notes the place."""

    def __init__(self, probe: Any, gcmd: GCodeCommand) -> None:
        self._gcmd = gcmd
        self._session = probe.start_probe_session(gcmd)

    def note_point(self) -> None:
        """The move queued last ends at a point."""
        self._session.run_probe(self._gcmd)

    def end(self) -> list[list[float]]:
        """x, y of the nozzle and its height at the trigger (mm), of each point."""
        results = [_at_nozzle(result) for result in self._session.pull_probed_results()]
        self._session.end_probe_session()
        return results


def can_scan(probe: Any) -> bool:
    """Whether a probe measures without touching, and while it moves."""
    if probe is None or not hasattr(probe, "get_status") or not hasattr(probe, "start_probe_session"):
        return False
    return str(probe.get_status(0.0).get("name", "")).startswith("probe_eddy_current")


def lift_speed_of(probe: Any, gcmd: GCodeCommand) -> float:
    """mm/s."""
    if hasattr(probe, "get_lift_speed"):
        return float(probe.get_lift_speed(gcmd))
    return float(probe.get_probe_params(gcmd)["lift_speed"])
