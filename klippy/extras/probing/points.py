"""A list of places to probe one after the other, by the probe or by hand; every levelling module works on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .. import manual_probe
from .series import Scan, Series, can_scan, lift_speed_of

Point = Sequence[float]
# finalize(offsets of the probe, nozzle's places at the triggers); "retry": probe all again
Finalize = Callable[[Any, list[list[float]]], Any]
SCANS = ("scan", "rapid_scan")
NO_OFFSETS = (0.0, 0.0, 0.0)


def scan_path(points: Sequence[Point], overshoot: float) -> list[tuple[Point, bool]]:
    """(place, is it a point to measure) on the way over rows of points that are run to and fro.

    Between two rows the way goes on by the overshoot first, so that the head has its speed again at the next point."""
    path: list[tuple[Point, bool]] = []
    for before, here, after in zip([None, *points], points, [*points[1:], None], strict=False):
        path.append((here, True))
        if not overshoot or before is None or after is None or after[1] == here[1]:
            continue
        way = math.copysign(overshoot, here[0] - before[0])
        path += [((here[0] + way, here[1]), False), ((after[0] + way, after[1]), False)]
    return path


class ProbePointsHelper:
    """Options `points`, `horizontal_move_z` and `speed`, and the way over them."""

    def __init__(
        self,
        config: ConfigWrapper,
        finalize_callback: Finalize,
        default_points: Sequence[Point] | None = None,
    ) -> None:
        self.printer = config.get_printer()
        self.finalize_callback = finalize_callback
        self.probe_points = default_points
        self.name = config.get_name()
        if default_points is None or "points" in config.get_prefix_options("points"):
            self.probe_points = config.getlists("points", seps=(",", "\n"), parser=float, count=2)
        self.default_horizontal_move_z = config.getfloat("horizontal_move_z", 5.0)
        self.horizontal_move_z = self.default_horizontal_move_z
        self.speed = config.getfloat("speed", 50.0, above=0.0)
        self.use_offsets = False
        self.scan_overshoot = 0.0  # mm beyond the outer points of a row, for rapid_scan
        self.lift_speed = self.speed
        self._offsets: Any = NO_OFFSETS
        self._manual_places: list[list[float]] = []

    # -- what the owner sets --

    def minimum_points(self, n: int) -> None:
        """Raise a config error if there are fewer points."""
        if self.probe_points is None or len(self.probe_points) < n:
            raise self.printer.config_error(
                f"Need at least {n} probe points for {self.name}, there are {len(self.probe_points or ())}"
            )

    def update_probe_points(self, points: Sequence[Point], min_points: int) -> None:
        self.probe_points = points
        self.minimum_points(min_points)

    def use_xy_offsets(self, use_offsets: bool) -> None:
        """The points are places of the probe rather than of the nozzle."""
        self.use_offsets = use_offsets

    def get_lift_speed(self) -> float:
        """mm/s, of the last run."""
        return self.lift_speed

    # -- running --

    def start_probe(self, gcmd: GCodeCommand) -> None:
        """Go over the points; METHOD=manual or no probe: the user probes each by paper."""
        manual_probe.verify_no_manual_probe(self.printer)
        probe = self.printer.lookup_object("probe", None)
        method = gcmd.get("METHOD", "automatic").lower()
        if method in SCANS and not can_scan(probe):
            raise gcmd.error(
                f"METHOD={method} needs a probe that measures without touching, such as [probe_eddy_current]; use "
                "METHOD=automatic"
            )
        if method not in ("automatic", "manual", "tap", *SCANS) or (method == "tap" and not can_scan(probe)):
            raise gcmd.error(f"METHOD is '{method}'; it can be automatic, manual, scan or rapid_scan")
        self.horizontal_move_z = gcmd.get_float("HORIZONTAL_MOVE_Z", self.default_horizontal_move_z)
        self._require_homed(gcmd)
        if probe is None or method == "manual":
            self._offsets, self.lift_speed = NO_OFFSETS, self.speed
            self._manual_places = []
            self._next_by_hand(gcmd)
            return
        self.lift_speed = min(self.speed, lift_speed_of(probe, gcmd))
        self._offsets = probe.get_offsets(gcmd)
        if self.horizontal_move_z < self._offsets[2]:
            raise gcmd.error("horizontal_move_z can't be less than probe's z_offset")
        if method == "rapid_scan":
            self._scan_all(probe, gcmd)
        else:
            self._probe_all(probe, gcmd, in_session=method == "scan")

    def _require_homed(self, gcmd: GCodeCommand) -> None:
        toolhead = self.printer.lookup_object("toolhead")
        homed = toolhead.get_status(self.printer.get_reactor().monotonic())["homed_axes"]
        if not set("xyz") <= set(homed):
            raise gcmd.error("Must home before probe: G28 first")

    def _probe_all(self, probe: Any, gcmd: GCodeCommand, in_session: bool) -> None:
        lift_speed = self.speed  # the first lift: nothing hangs on it
        while True:
            places: list[list[float]] = []
            series = Series(probe, gcmd, in_session)
            for number in range(len(self.probe_points or ())):
                self._travel(number, lift_speed)
                lift_speed = self.lift_speed
                places.append(series.run())
            series.end()
            if self._finish(places) != "retry":
                return

    def _scan_all(self, probe: Any, gcmd: GCodeCommand) -> None:
        """Over all points without a stop; the probe measures when it comes to each."""
        toolhead = self.printer.lookup_object("toolhead")
        while True:
            points = self.probe_points or ()
            self._travel(0, self.lift_speed)
            scan = Scan(probe, gcmd)
            for place, is_point in scan_path(points, self.scan_overshoot):
                toolhead.manual_move(self._nozzle_at(place), self.speed)
                if is_point:
                    scan.note_point()
            places = scan.end()
            if len(places) != len(points):
                raise gcmd.error(f"The probe measured {len(places)} of {len(points)} points; move slower")
            if self._finish(places) != "retry":
                return

    def _nozzle_at(self, place: Point) -> list[float]:
        x, y = place
        return [x - self._offsets[0], y - self._offsets[1]] if self.use_offsets else [x, y]

    def _travel(self, number: int, lift_speed: float) -> None:
        """Up, and over to a point."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.manual_move([None, None, self.horizontal_move_z], lift_speed)
        toolhead.manual_move(self._nozzle_at((self.probe_points or ())[number]), self.speed)

    def _finish(self, places: list[list[float]]) -> Any:
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.manual_move([None, None, self.horizontal_move_z], self.lift_speed)
        toolhead.get_last_move_time()
        return self.finalize_callback(self._offsets, places)

    def _next_by_hand(self, gcmd: GCodeCommand) -> None:
        """The paper test at the next point, or the end."""
        if len(self._manual_places) == len(self.probe_points or ()):
            places, self._manual_places = self._manual_places, []
            if self._finish(places) == "retry":
                self._next_by_hand(gcmd)
            return
        self._travel(len(self._manual_places), self.speed)

        def finalize(place: Sequence[float] | None) -> None:
            if place is None:
                self._manual_places = []
                return
            self._manual_places.append(list(place))
            self._next_by_hand(gcmd)

        manual_probe.ManualProbeHelper(self.printer, gcmd, finalize)
