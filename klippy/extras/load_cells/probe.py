"""The nozzle as the probe: the force of a load cell stops the move, and a fit finds where it began to touch.

before each move    the mean of tare_time becomes zero, the filter and the limits go to the board
on the board        |filtered force| >= trigger_force: stop; a reading beyond force_safety_limit: an error
interpolate_enable  the head is lifted by interpolate_lift_dist, the samples of that give the height of the contact
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from ..probe import PrinterProbe
from ..probing.analog_endstop import AnalogEndstop
from ..probing.filters import Scale, Section, high_pass, low_pass, notch
from ..probing.stream import Gathering, position_at
from ..probing.switch import ProbeSwitch
from . import messages
from .cell import LoadCell
from .chips import RANGE
from .contact import find_contact

UNITS_PER_GRAM = 1 << 14
MAX_SECTIONS = 4
MAX_NOTCHES = 2
FORCE_MAX_G = 20000.0
APPROACH_S = 0.25  # of the way down, for the contact
TAP_RELEASE = 0.5  # of trigger_force: the tap is over
TAP_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class ForceSettings:
    """Options that a command may change."""

    safety_limit_g: float
    trigger_g: float
    drift_hz: float | None
    drift_order: int
    buzz_hz: float | None
    buzz_order: int
    notch_hz: tuple[float, ...]
    notch_quality: float
    tare_s: float

    @staticmethod
    def read(config: ConfigWrapper, rate_hz: float) -> ForceSettings:
        half = rate_hz / 2.0
        notches = config.getfloatlist("notch_filter_frequencies", ())
        if len(notches) > MAX_NOTCHES or not all(0.0 < hz < half for hz in notches):
            raise config.error(
                f"Option 'notch_filter_frequencies' in section '{config.get_name()}'"
                f" ({config.where('notch_filter_frequencies')}): at most {MAX_NOTCHES} frequencies above 0 and below"
                f" {half:g} Hz, half of the sensor's rate."
            )
        return ForceSettings(
            config.getfloat("force_safety_limit", 2000.0, above=0.0, maxval=FORCE_MAX_G),
            config.getfloat("trigger_force", 75.0, above=0.0, maxval=FORCE_MAX_G),
            config.getfloat("drift_filter_cutoff_frequency", None, above=0.0, below=half),
            config.getint("drift_filter_delay", 2, minval=1, maxval=2),
            config.getfloat("buzz_filter_cutoff_frequency", None, above=0.0, below=half),
            config.getint("buzz_filter_delay", 2, minval=1, maxval=2),
            tuple(notches),
            config.getfloat("notch_filter_quality", 2.0, minval=0.5, maxval=3.0),
            config.getfloat("tare_time", 4.0 / 60.0, above=0.0, maxval=5.0),
        )

    def changed_by(self, gcmd: GCodeCommand, rate_hz: float) -> ForceSettings:
        """With the parameters of a command."""
        half = rate_hz / 2.0
        text = gcmd.get("NOTCH_FILTER_FREQUENCIES", None)
        try:
            notches = (
                self.notch_hz
                if text is None
                else tuple(float(word) for word in text.split(",") if word.strip())
            )
        except ValueError:
            notches = (0.0,)
        if len(notches) > MAX_NOTCHES or not all(0.0 < hz < half for hz in notches):
            raise gcmd.error(
                f"NOTCH_FILTER_FREQUENCIES: at most {MAX_NOTCHES}, above 0 and below {half:g} Hz"
            )
        force: dict[str, Any] = {"above": 0.0, "maxval": FORCE_MAX_G}
        frequency: dict[str, Any] = {"above": 0.0, "below": half}
        return replace(
            self,
            safety_limit_g=gcmd.get_float("FORCE_SAFETY_LIMIT", self.safety_limit_g, **force),
            trigger_g=gcmd.get_float("TRIGGER_FORCE", self.trigger_g, **force),
            drift_hz=gcmd.get_float("DRIFT_FILTER_CUTOFF_FREQUENCY", self.drift_hz, **frequency),
            drift_order=gcmd.get_int("DRIFT_FILTER_DELAY", self.drift_order, minval=1, maxval=2),
            buzz_hz=gcmd.get_float("BUZZ_FILTER_CUTOFF_FREQUENCY", self.buzz_hz, **frequency),
            buzz_order=gcmd.get_int("BUZZ_FILTER_DELAY", self.buzz_order, minval=1, maxval=2),
            notch_hz=notches,
            notch_quality=gcmd.get_float("NOTCH_FILTER_QUALITY", self.notch_quality, minval=0.5, maxval=3.0),
            tare_s=gcmd.get_float("TARE_TIME", self.tare_s, above=0.0, maxval=5.0),
        )

    def sections(self, rate_hz: float) -> list[Section]:
        """Of the filter on the board."""
        sections = [] if self.drift_hz is None else [high_pass(self.drift_hz, rate_hz, self.drift_order)]
        sections += [] if self.buzz_hz is None else [low_pass(self.buzz_hz, rate_hz, self.buzz_order)]
        return sections + [notch(hz, rate_hz, self.notch_quality) for hz in self.notch_hz]


class ForceSwitch(ProbeSwitch):
    """The load cell as the switch of a probe."""

    def __init__(self, config: ConfigWrapper, cell: LoadCell) -> None:
        self.printer = config.get_printer()
        self.cell = cell
        self._z_offset = config.getfloat("z_offset")
        self._each_sample = True
        load = self.printer.load_object(config, "gcode_macro").load_template
        self._activate = load(config, "activate_gcode", "")
        self._deactivate = load(config, "deactivate_gcode", "")
        self.settings = self._defaults = ForceSettings.read(config, cell.chip.rate_hz)
        self._interpolates = config.getboolean("interpolate_enable", False)
        self._lift_mm = config.getfloat("interpolate_lift_dist", 0.25, minval=0.0)
        self._lift_speed = config.getfloat("interpolate_lift_speed", 2.0, above=0.0)
        self._approach: Gathering | None = None
        self.tare_counts = 0
        self.endstop = AnalogEndstop(cell.mcu, MAX_SECTIONS, "ads131m0x_error:")
        self.endstop.period_s = 1.0 / cell.chip.rate_hz
        cell.mcu.register_config_callback(self._attach)
        self.mcu_endstop = self.endstop
        self._in_series = self._is_out = False
        self.printer.register_event_handler("klippy:mcu_identify", self._attach_steppers)

    def _attach(self) -> None:
        messages.attach_trigger(self.cell.mcu, self.cell.chip.family, self.cell.chip.oid, self.endstop.oid)

    def change_settings(self, gcmd: GCodeCommand) -> None:
        """For the probings of a command."""
        self.settings = self._defaults.changed_by(gcmd, self.cell.chip.rate_hz)

    def probe_prepare(self, hmove: Any) -> None:
        """Before each move towards the bed: the present force is zero."""
        super().probe_prepare(hmove)
        self.printer.lookup_object("toolhead").wait_moves()
        self.arm()

    def arm(self) -> None:
        """Tare, and send limits and filter to the board."""
        cell = self.cell
        if cell.counts_per_gram is None or cell.reference_tare is None:
            raise self.printer.command_error("Load Cell not calibrated: run LOAD_CELL_CALIBRATE")
        settings, counts_per_gram = self.settings, cell.counts_per_gram
        self.tare_counts = round(statistics.fmean(cell.read_counts(settings.tare_s)))
        reach = settings.safety_limit_g * counts_per_gram
        low, high = cell.reference_tare - reach, cell.reference_tare + reach
        if not low < self.tare_counts < high and not cell.mcu.is_fileoutput():
            force_g = (self.tare_counts - cell.reference_tare) / counts_per_gram
            raise self.printer.command_error(
                f"The load cell reads {force_g:.0f}g before the move, beyond force_safety_limit: is something pressing"
                " on it, or is it damaged? LOAD_CELL_CALIBRATE sets reference_tare_counts anew."
            )
        raw = sorted(round(max(-RANGE, min(RANGE - 1, cell.sign * limit))) for limit in (low, high))
        factor = cell.sign * UNITS_PER_GRAM / counts_per_gram
        scale = Scale(round(cell.sign * self.tare_counts), factor)
        self.endstop.filter.send(settings.sections(cell.chip.rate_hz), scale)
        self.endstop.set_trigger("abs_ge", round(settings.trigger_g * UNITS_PER_GRAM), (raw[0], raw[1]))

    def home_start(
        self,
        print_time: float,
        sample_time: float,
        sample_count: int,
        rest_time: float,
        triggered: bool = True,
    ) -> Any:
        if self._interpolates:
            self._approach = self.cell.stream.gather()
        return super().home_start(print_time, sample_time, sample_count, rest_time, triggered)

    def home_wait(self, home_end_time: float) -> float:
        """The time of the trigger, or with interpolation that of the first contact."""
        try:
            trigger_time = super().home_wait(home_end_time)
            if self._approach is None or not trigger_time or self.cell.mcu.is_fileoutput():
                return trigger_time
            self._approach.wait_until(trigger_time - self.endstop.period_s)
            # down at a constant speed: the corner over the time is that over the height
            samples = self._approach.between(trigger_time - APPROACH_S, trigger_time)
        finally:
            if self._approach is not None:
                self._approach.end()
            self._approach = None
        contact = find_contact([(trigger_time - time, value) for time, value in samples])
        return trigger_time if contact is None else trigger_time - contact

    def probing_move(self, pos: Sequence[float], speed: float) -> list[float]:
        """Move to pos until the trigger; returns where the head was then, or where it began to touch."""
        place = super().probing_move(pos, speed)
        if not self._interpolates or not self._lift_mm or self.cell.mcu.is_fileoutput():
            return place
        toolhead = self.printer.lookup_object("toolhead")
        gathering = self.cell.stream.gather()
        try:
            start = toolhead.get_last_move_time()
            here = toolhead.get_position()
            toolhead.manual_move([None, None, here[2] + self._lift_mm], self._lift_speed)
            end = toolhead.get_last_move_time()
            gathering.wait_until(end)
            samples = gathering.between(start, end)
        finally:
            gathering.end()
        period_s = self.endstop.period_s
        contact = find_contact([(position_at(self.printer, t, period_s)[2], value) for t, value in samples])
        if contact is None:
            raise self.printer.command_error(
                f"The {len(samples)} samples of the lift do not show where the nozzle left the bed: a larger"
                " interpolate_lift_dist, trigger_force or sample_rate, or a slower interpolate_lift_speed."
            )
        return [*place[:2], contact, *place[3:]]

    # -- taps by hand --

    def wait_for_tap(self, timeout_s: float) -> bool:
        """Whether the board sees a tap within a time; the head stays."""
        reactor, mcu = self.printer.get_reactor(), self.cell.mcu
        self.arm()
        end = reactor.monotonic() + timeout_s
        completion = self.endstop.home_start(
            mcu.estimated_print_time(reactor.monotonic()) + 0.1, 0.0, 1, 0.001
        )
        while completion.test() is False and reactor.monotonic() < end:
            reactor.pause(reactor.monotonic() + TAP_POLL_S)
        now = mcu.estimated_print_time(reactor.monotonic())
        if not self.endstop.home_wait(now):
            return False
        while reactor.monotonic() < end:
            counts = statistics.fmean(self.cell.read_counts(TAP_POLL_S))
            assert self.cell.counts_per_gram is not None
            if (
                abs(counts - self.tare_counts) / self.cell.counts_per_gram
                < TAP_RELEASE * self.settings.trigger_g
            ):
                break
        return True


class ForceProbe(PrinterProbe):
    """Printer object 'probe' of a load cell."""

    def run_probe(self, gcmd: GCodeCommand) -> list[float]:
        self.mcu_probe.change_settings(gcmd)
        return super().run_probe(gcmd)
