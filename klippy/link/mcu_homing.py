"""Stopping steppers at once when an endstop triggers, on one board or on several.

Each board has a *trsync*: while armed, a trigger (endstop, host, or its time-out) halts the steppers attached to it.

    board A: endstop ──► trsync A ──► steppers of A        trsync_state reports, every 0.3 of the time-out
                            │ report                                │
    host:              TriggerDispatch  ── trsync_trigger ──► trsync B ──► steppers of B
                            └── trsync_set_timeout to all, while *all* report

A trigger reaches the steppers of its own board at once, those of other boards by way of the host, some ms later.
When a board falls silent the time-outs of the others are no longer put off and every stepper stops.
"""

from __future__ import annotations

from typing import Any, Protocol

import pins

from .roles import Mcu

# How long a board goes on without an answer, and how often it reports meanwhile. A single board may lose five reports
# in a row. One of several boards that runs on while another has stopped goes 5 mm at 100 mm/s, and may lose two.
SINGLE_TIMEOUT_S, SINGLE_REPORT_S = 0.250, 0.040
MULTI_TIMEOUT_S, MULTI_REPORT_S = 0.050, 0.015
SHUTDOWN_POLL_S = 0.5
SILENCE_S = 0.5  # without a report: twice the longest time-out, so the board has stopped by itself


class Stepper(Protocol):
    """What homing needs of a stepper (klippy/stepper.py)."""

    def get_mcu(self) -> Mcu: ...
    def get_oid(self) -> int: ...
    def note_homing_end(self) -> None: ...


class Trsync:
    """The trsync of one board and the steppers it stops."""

    REASON_ENDSTOP_HIT = 1
    REASON_HOST_REQUEST = 2
    REASON_PAST_END_TIME = 3
    REASON_COMMS_TIMEOUT = 4

    def __init__(self, mcu: Mcu, dispatch: TriggerDispatch) -> None:
        self._mcu = mcu
        self._dispatch = dispatch
        self._steppers: list[Stepper] = []
        self._oid = mcu.create_oid()
        self._timeout_ticks = 0
        self.alive_clock = 0  # of the last report while armed
        self._cmd_queue: Any = None
        self._start: Any = None
        self._set_timeout: Any = None
        self._trigger: Any = None
        self._attach: Any = None
        self._trigger_query: Any = None
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Mcu:
        return self._mcu

    def get_oid(self) -> int:
        return self._oid

    def get_command_queue(self) -> Any:
        return self._cmd_queue

    def add_stepper(self, stepper: Stepper) -> None:
        if stepper not in self._steppers:
            self._steppers.append(stepper)

    def get_steppers(self) -> list[Stepper]:
        return list(self._steppers)

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        mcu.add_config_cmd(f"config_trsync oid={oid}")
        # after a restart of the host alone, an armed trsync of the last session must not report into this one
        mcu.add_config_cmd(
            f"trsync_start oid={oid} report_clock=0 report_ticks=0 expire_reason=0", on_restart=True
        )
        self._cmd_queue = cq = mcu.alloc_command_queue()
        self._start = mcu.lookup_command(
            "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c", cq=cq
        )
        self._set_timeout = mcu.lookup_command("trsync_set_timeout oid=%c clock=%u", cq=cq)
        self._trigger = mcu.lookup_command("trsync_trigger oid=%c reason=%c", cq=cq)
        self._attach = mcu.lookup_command("stepper_stop_on_trigger oid=%c trsync_oid=%c", cq=cq)
        self._trigger_query = mcu.lookup_query_command(
            "trsync_trigger oid=%c reason=%c",
            "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u",
            oid=oid,
            cq=cq,
        )

    def start(self, print_time: float, report_offset: float, timeout_s: float, report_s: float) -> None:
        """Arm from print_time on. report_offset (0..1 of a report interval) spreads the reports of several boards."""
        mcu = self._mcu
        clock = self.alive_clock = mcu.print_time_to_clock(print_time)
        self._timeout_ticks = mcu.seconds_to_clock(timeout_s)
        report_ticks = mcu.seconds_to_clock(report_s)
        first_report = clock + int(report_ticks * (1.0 + report_offset))
        mcu.register_response(self._on_state, "trsync_state", self._oid)
        self._start.send([self._oid, first_report, report_ticks, self.REASON_COMMS_TIMEOUT], reqclock=clock)
        for stepper in self._steppers:
            self._attach.send([stepper.get_oid(), self._oid], reqclock=clock)
        self._set_timeout.send([self._oid, clock + self._timeout_ticks], reqclock=clock)

    def _on_state(self, params: dict[str, Any]) -> None:
        if params["can_trigger"]:
            self.alive_clock = self._mcu.clock32_to_clock64(params["clock"])
            self._dispatch.note_alive()
        else:
            self._dispatch.note_trigger(self, params["trigger_reason"])

    def alive_time(self) -> float:
        """Print time of the last report."""
        return self._mcu.clock_to_print_time(self.alive_clock)

    def put_off_timeout(self, alive_time: float) -> None:
        """All boards were there at alive_time: run on for another time-out from then."""
        clock = self._mcu.print_time_to_clock(alive_time) + self._timeout_ticks
        self._set_timeout.send([self._oid, clock], reqclock=self.alive_clock)

    def trigger(self, reason: int) -> None:
        """Stop the steppers of this board now."""
        self._trigger.send([self._oid, reason])

    def stop(self) -> int:
        """End the watch; returns the reason of the trigger (HOST_REQUEST: none before this call)."""
        self._mcu.register_response(None, "trsync_state", self._oid)
        params = self._trigger_query.send([self._oid, self.REASON_HOST_REQUEST])
        for stepper in self._steppers:
            stepper.note_homing_end()
        return int(params["trigger_reason"])


class TriggerDispatch:
    """All boards that take part in stopping; the first one has the endstop."""

    def __init__(self, mcu: Mcu, trsyncs: list[Trsync] | None = None) -> None:
        self._mcu = mcu
        self._reactor = mcu.get_printer().get_reactor()
        self._trsyncs = [Trsync(mcu, self)] if trsyncs is None else trsyncs
        self._completion: Any = None
        self._end_clock = 0  # of the board with the endstop; 0: not yet known
        self._silence_timer: Any = None

    def get_oid(self) -> int:
        """Object id of the trsync that the endstop must trigger."""
        return self._trsyncs[0].get_oid()

    def get_command_queue(self) -> Any:
        return self._trsyncs[0].get_command_queue()

    def add_stepper(self, stepper: Stepper) -> None:
        """The stepper is stopped too, on whichever board it is."""
        for trsync in self._trsyncs:
            if trsync.get_mcu() is stepper.get_mcu():
                trsync.add_stepper(stepper)
                return
        trsync = Trsync(stepper.get_mcu(), self)
        trsync.add_stepper(stepper)
        self._trsyncs.append(trsync)

    def add_trsync(self, trsync: Trsync) -> None:
        self._trsyncs.append(trsync)

    def get_steppers(self) -> list[Stepper]:
        return [s for trsync in self._trsyncs for s in trsync.get_steppers()]

    def begin(self, completion: Any) -> None:
        """The completion is given the reason of the next trigger."""
        self._completion = completion
        self._end_clock = 0

    def start(self, print_time: float) -> Any:
        """Arm all boards; returns a completion that is given the reason of the trigger."""
        self.begin(self._reactor.completion())
        several = len(self._trsyncs) > 1
        times_s = (MULTI_TIMEOUT_S, MULTI_REPORT_S) if several else (SINGLE_TIMEOUT_S, SINGLE_REPORT_S)
        for number, trsync in enumerate(self._trsyncs):
            trsync.start(print_time, number / len(self._trsyncs), *times_s)
        if self._mcu.is_fileoutput():
            self._completion.complete(Trsync.REASON_ENDSTOP_HIT)
        else:
            self._silence_timer = self._reactor.register_timer(self._check_silence, self._reactor.NOW)
        return self._completion

    def _check_silence(self, eventtime: float) -> float:
        """Timer. A board reports until it stops, and once then; that last report may be lost on the line.

        A board this long silent has stopped, by its trigger or by its own time-out: `stop` asks it which.
        """
        if self._completion is None or self._completion.test():
            return float(self._reactor.NEVER)
        for trsync in self._trsyncs:
            if trsync.get_mcu().estimated_print_time(eventtime) > trsync.alive_time() + SILENCE_S:
                self._stop_all(None, Trsync.REASON_COMMS_TIMEOUT)
                return float(self._reactor.NEVER)
        return eventtime + SHUTDOWN_POLL_S

    def note_alive(self) -> None:
        """A board has reported. Put off the time-outs, or stop all if the move is over."""
        if self._completion is None or self._completion.test():
            return
        if self._end_clock and self._trsyncs[0].alive_clock >= self._end_clock:
            self._stop_all(None, Trsync.REASON_PAST_END_TIME)
            return
        alive_time = min(trsync.alive_time() for trsync in self._trsyncs)
        for trsync in self._trsyncs:
            trsync.put_off_timeout(alive_time)

    def note_trigger(self, source: Trsync, reason: int) -> None:
        """A board has stopped: stop the others."""
        if self._completion is not None and not self._completion.test():
            self._stop_all(source, reason)

    def _stop_all(self, source: Trsync | None, reason: int) -> None:
        self._completion.complete(reason)
        passed_on = reason if source is None else Trsync.REASON_HOST_REQUEST
        for trsync in self._trsyncs:
            if trsync is not source:
                trsync.trigger(passed_on)

    def set_end(self, end_time: float) -> None:
        """The move ends at this print time."""
        self._end_clock = self._mcu.print_time_to_clock(end_time)

    def wait_end(self, end_time: float) -> None:
        """Wait for the trigger, or for the end of the move at print time end_time."""
        self.set_end(end_time)
        while self._completion.wait(self._reactor.monotonic() + SHUTDOWN_POLL_S) is None:
            if any(trsync.get_mcu().is_shutdown() for trsync in self._trsyncs):
                raise self._mcu.get_printer().command_error("Homing was interrupted by a shutdown.")

    def stop(self) -> int:
        """End the watch on all boards; returns the reason why the first one stopped, or a time-out of any."""
        if self._completion is None:
            return 0
        if self._silence_timer is not None:
            self._reactor.unregister_timer(self._silence_timer)
            self._silence_timer = None
        reasons = [trsync.stop() for trsync in self._trsyncs]
        self.end()
        if Trsync.REASON_COMMS_TIMEOUT in reasons:
            return Trsync.REASON_COMMS_TIMEOUT
        return reasons[0]

    def end(self) -> None:
        """Reports that are still on their way count no more."""
        self._completion = None


class MCU_endstop:
    """A switch that ends a homing move."""

    def __init__(self, mcu: Mcu, pin_params: dict[str, Any]) -> None:
        self._mcu = mcu
        self._pin: str = pin_params["pin"]
        self._pullup = int(pin_params["pullup"])
        self._invert = int(pin_params["invert"])
        self._oid = mcu.create_oid()
        self._rest_ticks = 0
        self._home: Any = None
        self._query: Any = None
        self._dispatch = TriggerDispatch(mcu)
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Mcu:
        return self._mcu

    def add_stepper(self, stepper: Stepper) -> None:
        """The stepper is stopped by this endstop."""
        self._dispatch.add_stepper(stepper)

    def get_steppers(self) -> list[Stepper]:
        return self._dispatch.get_steppers()

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        mcu.add_config_cmd(f"config_endstop oid={oid} pin={self._pin} pull_up={self._pullup}")
        mcu.add_config_cmd(
            f"endstop_home oid={oid} clock=0 sample_ticks=0 sample_count=0 rest_ticks=0 pin_value=0"
            f" trsync_oid=0 trigger_reason=0",
            on_restart=True,
        )
        cq = self._dispatch.get_command_queue()
        self._home = mcu.lookup_command(
            "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c"
            " trsync_oid=%c trigger_reason=%c",
            cq=cq,
        )
        self._query = mcu.lookup_query_command(
            "endstop_query_state oid=%c",
            "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c",
            oid=oid,
            cq=cq,
        )

    def home_start(
        self,
        print_time: float,
        sample_time: float,
        sample_count: int,
        rest_time: float,
        triggered: bool = True,
    ) -> Any:
        """Watch from print_time on: every rest_time s, and sample_count times sample_time s apart to confirm.

        Returns a completion that ends when the steppers have been stopped.
        """
        if sample_count < 1:
            raise pins.error("an endstop needs at least one sample")
        mcu = self._mcu
        mcu.require_connected()
        clock = mcu.print_time_to_clock(print_time)
        self._rest_ticks = mcu.print_time_to_clock(print_time + rest_time) - clock
        completion = self._dispatch.start(print_time)
        self._home.send(
            [
                self._oid,
                clock,
                mcu.seconds_to_clock(sample_time),
                sample_count,
                self._rest_ticks,
                int(triggered) ^ self._invert,
                self._dispatch.get_oid(),
                Trsync.REASON_ENDSTOP_HIT,
            ],
            reqclock=clock,
        )
        return completion

    def home_wait(self, home_end_time: float) -> float:
        """Wait for the trigger; returns its print time, 0 if the move ended without one."""
        self._dispatch.wait_end(home_end_time)
        self._home.send([self._oid, 0, 0, 0, 0, 0, 0, 0])  # sample_count 0: no longer watched
        reason = self._dispatch.stop()
        if self._mcu.is_fileoutput():
            return home_end_time
        if reason == Trsync.REASON_COMMS_TIMEOUT:
            raise self._mcu.get_printer().command_error("Communication timeout during homing")
        if reason != Trsync.REASON_ENDSTOP_HIT:
            return 0.0
        params = self._query.send([self._oid])
        next_clock = self._mcu.clock32_to_clock64(params["next_clock"])
        return self._mcu.clock_to_print_time(next_clock - self._rest_ticks)

    def query_endstop(self, print_time: float) -> int:
        """1 if the switch is triggered (not before print_time)."""
        if self._mcu.is_fileoutput():
            return 0
        clock = self._mcu.print_time_to_clock(print_time)
        params = self._query.send([self._oid], minclock=clock)
        return int(params["pin_value"]) ^ self._invert
