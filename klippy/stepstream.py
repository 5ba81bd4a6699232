"""From planned motion to each MCU's command stream: one StepStream per MCU, all of them in StepStreams.

The C helper does the work (itersolve, stepcompress, steppersync); this module only says up to which time:

    print_time   ----|=========== steps worked out ============|.. planned ..|
                     |== commands handed to the serialqueue ==|
                                                               ^ HOLD_BACK_S: the last steps wait for
                                                                 their successors, so that one command
                                                                 can hold many
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import chelper

# Steps kept back while motion goes on; far above the 0.75 ms within which a step and its reversal cancel.
HOLD_BACK_S = 0.050
# Between motion whose commands have all gone out and the next: a step and its reversal can not be cancelled across
# that border, so they must not meet there.
BORDER_S = 0.001
# Positions are kept this long for look-ups of the past (homing, reports).
HISTORY_S = 30.0
# Distance of the two points through which the print_time -> clock line of an MCU runs.
CLOCK_BASELINE_S = 10.0
END_OF_TIME_CLOCK = 2**63

# A move that may be cut short is worked out this far ahead of the MCU, in pieces this long.
DRIP_AHEAD_S = 0.100
DRIP_PIECE_S = 0.050

# An MCU with no free place in its move queue at all cannot step; config_stepper would already have failed.
MIN_PLACES = 1


class Stepper(Protocol):
    """What a stream needs of a stepper (klippy/stepper.py); both are objects of the C helper, or None."""

    def get_mcu(self) -> Any: ...
    def get_stepcompress(self) -> Any: ...
    def get_stepper_kinematics(self) -> Any: ...
    def wake(self, print_time: float) -> bool: ...


class StepStream:
    """The steppers of one MCU."""

    def __init__(self, mcu: Any) -> None:
        self.mcu = mcu
        self.steppers: list[Stepper] = []
        self._ffi, self._lib = chelper.get_ffi()
        self._sync: Any = None
        self._writer: Any = None
        self._failed = self._ffi.new("int *", -1)

    def add_stepper(self, stepper: Stepper) -> None:
        self.steppers.append(stepper)

    def _open(self) -> None:
        """First use: the MCU is configured by now and knows the size of its move queue."""
        self._writer = self.mcu.get_step_writer()
        places = max(MIN_PLACES, self._writer.move_count())
        self._sync = self._ffi.gc(self._lib.steppersync_alloc(places), self._lib.steppersync_free)
        for stepper in self.steppers:
            self._lib.steppersync_add_stepper(self._sync, stepper.get_stepcompress())
        self.sync_kinematics()

    def sync_kinematics(self) -> None:
        """Pass the C side which solver feeds which stepper (after set_stepper_kinematics)."""
        if self._sync is None:
            return
        for index, stepper in enumerate(self.steppers):
            solver = stepper.get_stepper_kinematics()
            self._lib.steppersync_set_kinematics(self._sync, index, solver or self._ffi.NULL)

    def _set_time(self, print_time: float) -> None:
        clock0 = self.mcu.print_time_to_clock(print_time)
        clock1 = self.mcu.print_time_to_clock(print_time + CLOCK_BASELINE_S)
        freq = (clock1 - clock0) / CLOCK_BASELINE_S
        self._lib.steppersync_set_time(self._sync, print_time - clock0 / freq, freq)

    def _fail(self, code: int) -> None:
        name = self.steppers[self._failed[0]].get_name() if self._failed[0] >= 0 else "?"
        text = (
            f"The steps of stepper '{name}' could not be put in order of time (internal error {code}). The printer is "
            "stopped because the machine would lose its position."
        )
        printer = self.mcu.get_printer()
        printer.invoke_shutdown(text)
        raise printer.command_error(text)

    def generate(self, print_time: float) -> None:
        """Work out all steps before print_time."""
        if self._sync is None:
            self._open()
        self._set_time(print_time)
        code = self._lib.steppersync_generate(self._sync, print_time, self._failed)
        if code:
            self._fail(code)

    def last_step_time(self) -> float:
        """print_time of the last step worked out; of a long time ago if there was none."""
        return float(self.mcu.clock_to_print_time(self._lib.steppersync_last_clock(self._sync)))

    def flush(self, print_time: float | None) -> None:
        """Hand over the commands needed before print_time (None: all there are)."""
        if self._sync is None:
            self._open()
        clock = END_OF_TIME_CLOCK
        history_clock = 0
        if print_time is not None:
            clock = max(0, self.mcu.print_time_to_clock(print_time))
            history_clock = max(0, self.mcu.print_time_to_clock(print_time - HISTORY_S))
        messages = self._lib.steppersync_flush(self._sync, clock, history_clock, self._failed)
        if messages:
            self._writer.send(messages)
        if self._failed[0] >= 0:
            self._fail(-1)


class Generators(list[Callable[[float], None]]):
    """Called with the print_time up to which steps are worked out."""

    def remove(self, handler: Callable[[float], None]) -> None:
        """Also of one that is not there: plugins take steppers out, which need no call."""
        if handler in self:
            super().remove(handler)


class StepStreams:
    """All MCUs that step. Printer object 'step_streams'."""

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self.streams: dict[Any, StepStream] = {}
        self.generators = Generators()
        self._waking: list[Stepper] = []
        self._done_time = 0.0
        self._ffi, self._lib = chelper.get_ffi()
        self._trapqs: list[Any] = []

    def add_stepper(self, stepper: Stepper) -> None:
        mcu = stepper.get_mcu()
        if mcu not in self.streams:
            self.streams[mcu] = StepStream(mcu)
        self.streams[mcu].add_stepper(stepper)

    def note_kinematics(self, stepper: Stepper) -> None:
        self.streams[stepper.get_mcu()].sync_kinematics()

    def note_active_callback(self, stepper: Stepper) -> None:
        """The stepper has callbacks to run before its next step."""
        if stepper not in self._waking:
            self._waking.append(stepper)

    def new_trapq(self) -> Any:
        """A motion queue whose past is dropped together with the step history."""
        trapq = self._ffi.gc(self._lib.trapq_alloc(), self._lib.trapq_free)
        self._trapqs.append(trapq)
        return trapq

    def look_ahead_s(self) -> float:
        """Motion after a time that steppers need to know to step up to that time (smoothed pressure advance, shaping);
        BORDER_S at least."""
        solvers = (s.get_stepper_kinematics() for stream in self.streams.values() for s in stream.steppers)
        return max(BORDER_S, *(self._lib.itersolve_look_ahead(sk) for sk in solvers if sk), 0.0)

    @property
    def done_time(self) -> float:
        """print_time from which on new motion may begin: steps are worked out up to the look-ahead before it.

        Motion that began sooner would already have had to show in steps that are gone (shaping, pressure advance).
        """
        return self._done_time + self.look_ahead_s()

    @property
    def worked_out_time(self) -> float:
        """print_time up to which there are steps."""
        return self._done_time

    def _follow_clocks(self, print_time: float) -> None:
        """From print_time on, further MCUs may correct their relation to the main one's clock; after a rest (a dwell of
        minutes is worked out at its beginning) from their last step on."""
        eventtime = self._reactor.monotonic()
        for mcu, stream in self.streams.items():
            if not mcu.is_fileoutput():
                mcu.check_active(min(print_time, stream.last_step_time()), eventtime)

    def advance(self, print_time: float, hold_back: bool = True) -> None:
        """Generate up to print_time and send; without hold_back every command goes out."""
        if print_time > self._done_time:
            if self._waking:
                self._waking = [s for s in self._waking if not s.wake(print_time)]
            for stream in self.streams.values():
                stream.generate(print_time)
            for generator in self.generators:
                generator(print_time)
            self._done_time = print_time
            self._follow_clocks(print_time)
        send_time = self._done_time - HOLD_BACK_S if hold_back else None
        for stream in self.streams.values():
            stream.flush(send_time)
        for trapq in self._trapqs:
            self._lib.trapq_forget_before(trapq, self._done_time - HISTORY_S)

    def drip(self, mcu: Any, start: float, end: float, completion: Any) -> float:
        """Work out the steps from start to end only just in time, until the completion is set; returns how far it came.

        In batch mode all of them, at once."""
        if mcu.is_fileoutput():
            self.advance(end, hold_back=False)
            return end
        time = start
        while time < end:
            eventtime = self._reactor.monotonic()
            spare = time - mcu.estimated_print_time(eventtime) - DRIP_AHEAD_S
            if spare > 0.0:
                completion.wait(eventtime + spare)
            if completion.test():
                break
            time = min(end, time + DRIP_PIECE_S)
            self.advance(time, hold_back=False)
        return time

    def cut(self, trapq: Any, print_time: float) -> None:
        """Motion in this queue rests from print_time on, where it is then."""
        place, speed = self._ffi.new("double[3]"), self._ffi.new("double *")
        if self._lib.trapq_state_at(trapq, print_time, place, speed):
            self._lib.trapq_set_position(trapq, print_time, *place)


def lookup_streams(printer: Any) -> StepStreams:
    """The printer's StepStreams, made at the first call."""
    streams = printer.lookup_object("step_streams", None)
    if streams is None:
        streams = StepStreams(printer.get_reactor())
        printer.add_object("step_streams", streams)
    return streams
