"""Streams of what has been planned and stepped: motion_report/dump_stepper and motion_report/dump_trapq.

Both read the history that the C helper keeps anyway, up to the present moment, so nothing is collected while nobody
listens. All clients of one source get the same messages, each with its own template around them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import chelper
from roles import Printer

PERIOD_S = 0.25
RECORDS_MAX = 1024  # records in one message; more follow in the next ones at once

Rows = dict[str, Any] | None


class Stream:
    """One source of messages and its clients. `read()` gives the news since the last call, None if there is none."""

    def __init__(
        self, printer: Printer, header: tuple[str, ...], start: Callable[[], None], read: Callable[[], Rows]
    ):
        self._reactor = printer.get_reactor()
        self._header = header
        self._start, self._read = start, read
        self._clients: dict[Any, dict[str, Any]] = {}  # with the template of each
        self._timer: Any = None

    def serve(self, request: Any) -> None:
        """Endpoint: answer with the header, and send messages from now on."""
        template = request.get_dict("response_template", {})
        if self._timer is None:
            self._start()
            self._timer = self._reactor.register_timer(self._on_timer, self._reactor.monotonic() + PERIOD_S)
        self._clients[request.get_client_connection()] = template
        request.send({"header": list(self._header)})

    def _on_timer(self, eventtime: float) -> float:
        self._clients = {c: template for c, template in self._clients.items() if not c.is_closed()}
        if not self._clients:
            self._reactor.unregister_timer(self._timer)
            self._timer = None
            return float(self._reactor.NEVER)
        try:
            while (rows := self._read()) is not None:
                for client, template in self._clients.items():
                    client.send({**template, "params": rows})
        except Exception:
            logging.exception("motion_report: a stream ends")
            self._clients.clear()
        return eventtime + PERIOD_S


class StepperSource:
    """The commands sent for one stepper. A count below 0 means steps backwards."""

    HEADER = ("interval", "count", "add")

    def __init__(self, printer: Printer, stepper: Any) -> None:
        self._stepper = stepper
        self._mcu = stepper.get_mcu()
        self._reactor = printer.get_reactor()
        self._next_clock = 0

    def _now_clock(self) -> int:
        return self._mcu.print_time_to_clock(self._mcu.estimated_print_time(self._reactor.monotonic()))

    def start(self) -> None:
        """What comes from now on."""
        self._next_clock = self._now_clock()

    def read(self) -> Rows:
        """Commands that have begun by now."""
        records, count = self._stepper.dump_steps(RECORDS_MAX, self._next_clock, self._now_clock())
        if not count:
            return None
        first, last = records[0], records[count - 1]
        self._next_clock = last.last_clock + 1
        to_time = self._mcu.clock_to_print_time
        first_time, last_time = to_time(first.first_clock), to_time(last.last_clock)
        position = self._stepper.mcu_to_commanded_position(first.start_position)
        return {
            "data": [(r.interval, r.step_count, r.add) for r in records[0:count]],
            "first_clock": first.first_clock,
            "first_time": first_time,
            "first_step_time": first_time,
            "first_position": position,
            "start_position": position,
            "start_mcu_position": first.start_position,
            "step_distance": self._stepper.get_step_dist(),
            "last_clock": last.last_clock,
            "last_time": last_time,
            "last_step_time": last_time,
        }


class TrapqSource:
    """The planned motion of a motion queue, in stretches of constant acceleration."""

    HEADER = ("time", "duration", "start_velocity", "acceleration", "start_position", "direction")

    def __init__(self, printer: Printer, trapq: Any) -> None:
        self._mcu = printer.lookup_object("mcu")
        self._reactor = printer.get_reactor()
        self._trapq = trapq
        ffi, self._lib = chelper.get_ffi()
        self._spans = ffi.new("struct trapq_span[]", RECORDS_MAX)
        self._next_time = 0.0

    def _now(self) -> float:
        return float(self._mcu.estimated_print_time(self._reactor.monotonic()))

    def start(self) -> None:
        """What comes from now on."""
        self._next_time = self._now()

    def read(self) -> Rows:
        """Stretches that have begun by now."""
        now = self._now()
        if now <= self._next_time:
            return None
        count = self._lib.trapq_extract(self._trapq, self._spans, RECORDS_MAX, self._next_time, now)
        new = [s for s in self._spans[0:count] if s.print_time >= self._next_time - 1e-9 and s.duration > 0.0]
        self._next_time = now if count < RECORDS_MAX else self._spans[count - 1].print_time + 1e-6
        if not new:
            return None
        return {
            "data": [
                (
                    s.print_time, s.duration, s.start_v, s.accel,
                    (s.start_x, s.start_y, s.start_z), (s.x_r, s.y_r, s.z_r),
                )
                for s in new
            ]
        }  # fmt: skip


def register(printer: Printer, steppers: dict[str, Any], trapqs: dict[str, Any]) -> None:
    """Both endpoints, for steppers and motion queues by name."""
    hooks = printer.lookup_object("webhooks", None)
    if hooks is None:
        return
    for name, stepper in steppers.items():
        steps = StepperSource(printer, stepper)
        stream = Stream(printer, steps.HEADER, steps.start, steps.read)
        hooks.register_mux_endpoint("motion_report/dump_stepper", "name", name, stream.serve)
    for name, trapq in trapqs.items():
        plan = TrapqSource(printer, trapq)
        stream = Stream(printer, plan.HEADER, plan.start, plan.read)
        hooks.register_mux_endpoint("motion_report/dump_trapq", "name", name, stream.serve)
