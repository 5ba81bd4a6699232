"""[axis_twist_compensation]: corrects a probe whose carriage tilts along a twisted rail.

The calibration probes a place of the bed and then has the user bring the nozzle there: the two heights must differ by
z_offset, and what they differ by beyond that is the rail's error with the carriage at that place. Every later probed
height is corrected by it, linear between the places of the calibration and constant beyond them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import manual_probe
from .probe import run_single_probe

SAMPLES = 3
LETTERS = "xy"


@dataclass(frozen=True, slots=True)
class Travel:
    """Where the nozzle goes to calibrate one rail; mm."""

    axis: int
    start: float
    end: float
    across: float  # of the other axis

    def places(self, count: int) -> list[tuple[float, float]]:
        """x, y of the nozzle."""
        along = [self.start + (self.end - self.start) * k / (count - 1) for k in range(count)]
        return [(p, self.across) if self.axis == 0 else (self.across, p) for p in along]


@dataclass(frozen=True, slots=True)
class Twist:
    """What to add to a probed height, at equal distances along a rail from start to end; mm."""

    axis: int
    start: float
    end: float
    values: Sequence[float]

    @property
    def is_usable(self) -> bool:
        return len(self.values) >= 2 and self.start != self.end

    def at(self, place: float) -> float:
        steps = len(self.values) - 1
        position = max(0.0, min(1.0, (place - self.start) / (self.end - self.start))) * steps
        lower = min(int(position), steps - 1)
        share = position - lower
        return (1.0 - share) * self.values[lower] + share * self.values[lower + 1]


# Options of an axis: the corrections, the first and the last place
SAVED = (
    ("z_compensations", "compensation_start_x", "compensation_end_x"),
    ("zy_compensations", "compensation_start_y", "compensation_end_y"),
)


def _read_travel(config: ConfigWrapper, axis: int) -> Travel | None:
    along, across = LETTERS[axis], LETTERS[1 - axis]
    names = (f"calibrate_start_{along}", f"calibrate_end_{along}", f"calibrate_{across}")
    if axis and not any(config.get(name, None) for name in names):
        return None  # calibrating y is optional
    start, end, other = (config.getfloat(name) for name in names)
    if start == end:
        raise config.error(
            f"Options '{names[0]}' and '{names[1]}' in section '{config.get_name()}' are the same place "
            f"({config.where(names[1])})"
        )
    return Travel(axis, start, end, other)


def _read_twist(config: ConfigWrapper, axis: int, travel: Travel | None) -> Twist | None:
    values_name, start_name, end_name = SAVED[axis]
    values = config.getfloatlist(values_name, ())
    start = config.getfloat(start_name, travel.start if travel else None)
    end = config.getfloat(end_name, travel.end if travel else None)
    if not values:
        return None
    if start is None or end is None or not Twist(axis, start, end, values).is_usable:
        raise config.error(
            f"Option '{values_name}' in section '{config.get_name()}' needs two values or more, and {start_name} and "
            f"{end_name} at different places ({config.where(values_name)})"
        )
    return Twist(axis, start, end, values)


def _of_twist(axis: int, name: str) -> Any:
    """An attribute for plugins: a field of one rail's correction."""

    def get(self: Any) -> Any:
        return getattr(self.twists[axis], name, [] if name == "values" else None)

    def put(self: Any, value: Any) -> None:
        twist = self.twists[axis] or Twist(axis, 0.0, 0.0, ())
        self.twists[axis] = replace(twist, **{name: value})

    return property(get, put)


def _of_travel(axis: int, name: str) -> Any:
    """An attribute for plugins: an option of the calibration."""
    return property(lambda self: getattr(self.travels[axis], name, None))


class AxisTwistCompensation:
    """Printer object 'axis_twist_compensation'."""

    z_compensations, zy_compensations = _of_twist(0, "values"), _of_twist(1, "values")
    compensation_start_x, compensation_end_x = _of_twist(0, "start"), _of_twist(0, "end")
    compensation_start_y, compensation_end_y = _of_twist(1, "start"), _of_twist(1, "end")
    calibrate_start_x, calibrate_end_x, calibrate_y = (_of_travel(0, n) for n in ("start", "end", "across"))
    calibrate_start_y, calibrate_end_y, calibrate_x = (_of_travel(1, n) for n in ("start", "end", "across"))

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.speed = config.getfloat("speed", 50.0, above=0.0)
        self.horizontal_move_z = config.getfloat("horizontal_move_z", 5.0)
        self.travels = [_read_travel(config, axis) for axis in (0, 1)]
        self.twists = [_read_twist(config, axis, self.travels[axis]) for axis in (0, 1)]
        self.printer.register_event_handler("probe:update_results", self._update_z_compensation_value)
        self.printer.lookup_object("gcode").register_command(
            "AXIS_TWIST_COMPENSATION_CALIBRATE",
            self.cmd_AXIS_TWIST_COMPENSATION_CALIBRATE,
            desc="Performs the x twist calibration wizard",
        )

    # -- use --

    def get_z_compensation_value(self, pos: Sequence[float]) -> float:
        """What to add to a height that was probed with the nozzle at a place."""
        return sum(
            twist.at(pos[twist.axis]) for twist in self.twists if twist is not None and twist.is_usable
        )

    def clear_compensations(self, axis: str | None = None) -> None:
        """Probed heights of one axis' rail (X, Y), or of both, count as they are."""
        for number, letter in enumerate(LETTERS):
            if axis is None or axis.lower() == letter:
                self.twists[number] = None

    def _update_z_compensation_value(self, pos: list[Any]) -> None:
        """`pos`: one ProbeResult, or x, y, z as older plugins send it."""
        if len(pos) == 1:
            place = pos[0]
            correction = self.get_z_compensation_value((place.test_x, place.test_y))
            pos[0] = place._replace(bed_z=place.bed_z + correction)
        else:
            pos[2] += self.get_z_compensation_value(pos)

    # -- calibration --

    def cmd_AXIS_TWIST_COMPENSATION_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """AXIS_TWIST_COMPENSATION_CALIBRATE [AXIS=X|Y] [AUTO=True] [SAMPLE_COUNT=3]."""
        manual_probe.verify_no_manual_probe(self.printer)
        probe = self.printer.lookup_object("probe", None)
        if probe is None:
            raise gcmd.error("AXIS_TWIST_COMPENSATION_CALIBRATE needs a probe: there is no section [probe]")
        count = gcmd.get_int("SAMPLE_COUNT", SAMPLES, minval=2)
        axis_name = gcmd.get("AXIS", None)
        both = gcmd.get("AUTO", "False").lower() in ("true", "1")
        if both and axis_name is not None:
            raise gcmd.error("AXIS and AUTO can not be given together: AUTO calibrates both axes")
        if (axis_name or "X").lower() not in LETTERS:
            raise gcmd.error(f"AXIS is '{axis_name}'; it can be X or Y")
        axes = [0, 1] if both else [LETTERS.index((axis_name or "X").lower())]
        for axis in axes:
            if self.travels[axis] is None:
                along, across = LETTERS[axis], LETTERS[1 - axis]
                raise gcmd.error(
                    f"[{self.name}] needs calibrate_start_{along}, calibrate_end_{along} and calibrate_{across}"
                )
        Calibration(self, gcmd, probe, axes, count).next_place()

    def use(self, gcmd: GCodeCommand, twist: Twist) -> None:
        """From now on."""
        axis = twist.axis
        self.twists[axis] = twist
        texts = (", ".join(f"{v:.6f}" for v in twist.values), f"{twist.start:g}", f"{twist.end:g}")
        configfile = self.printer.lookup_object("configfile")
        for option, text in zip(SAVED[axis], texts, strict=True):
            configfile.set(self.name, option, text)
        manual_probe.report_save_config(
            gcmd,
            f"AXIS_TWIST_COMPENSATION_CALIBRATE: {LETTERS[axis]}: {texts[0]}. PROBE_CALIBRATE should follow.",
        )


class Calibration:
    """One run: probe a place, then the paper test there, place after place."""

    def __init__(
        self, twist: AxisTwistCompensation, gcmd: GCodeCommand, probe: Any, axes: Sequence[int], count: int
    ) -> None:
        self._twist, self._gcmd, self._probe, self._count = twist, gcmd, probe, count
        self._toolhead = twist.printer.lookup_object("toolhead")
        self._axes = list(axes)
        self._errors: list[float] = []

    def next_place(self) -> None:
        """Start with the next place; after the last, use what was found."""
        axis = self._axes[0]
        travel = self._twist.travels[axis]
        assert travel is not None
        places = travel.places(self._count)
        offsets = self._probe.get_offsets(self._gcmd)
        if len(self._errors) == len(places):
            mean = sum(self._errors) / len(places)  # that belongs to z_offset
            values = [error - mean for error in self._errors]
            # while it probed, the carriage stood beside the place by the probe's offset
            ends = (travel.start - offsets[axis], travel.end - offsets[axis])
            self._twist.use(self._gcmd, Twist(axis, *ends, values))
            self._errors = []
            self._axes.pop(0)
            if self._axes:
                self.next_place()
            return
        x, y = places[len(self._errors)]
        self._go(x - offsets[0], y - offsets[1])
        probed = run_single_probe(self._probe, self._gcmd)[2]
        # the carriage's own error is what is looked for
        at = self._toolhead.get_position()[:2]
        probed -= self._twist.get_z_compensation_value(at)
        self._go(x, y)
        manual_probe.ManualProbeHelper(
            self._twist.printer, self._gcmd, lambda place: self._note(place, probed - offsets[2])
        )

    def _go(self, x: float, y: float) -> None:
        self._toolhead.manual_move([None, None, self._twist.horizontal_move_z], self._twist.speed)
        self._toolhead.manual_move([x, y], self._twist.speed)

    def _note(self, place: Sequence[float] | None, bed_by_probe: float) -> None:
        if place is None:
            self._gcmd.respond_info("AXIS_TWIST_COMPENSATION_CALIBRATE: aborted, nothing is changed")
            return
        self._errors.append(place[2] - bed_by_probe)
        self.next_place()


def load_config(config: ConfigWrapper) -> AxisTwistCompensation:
    return AxisTwistCompensation(config)
