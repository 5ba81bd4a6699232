"""Motion queues for plugins that move motors of their own: `load_object(config, "motion_queuing")`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import chelper
import stepstream
from configfile import ConfigWrapper
from roles import Printer


class MotionQueuing:
    """Printer object 'motion_queuing'."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._streams = stepstream.lookup_streams(printer)
        self._generators: dict[Any, Callable[[float], None]] = {}

    def _toolhead(self) -> Any:
        return self.printer.lookup_object("toolhead")

    def allocate_trapq(self) -> Any:
        """A new motion queue."""
        return self._streams.new_trapq()

    def lookup_trapq_append(self) -> Any:
        """The function that adds a move to a queue."""
        return chelper.get_ffi()[1].trapq_append

    def wipe_trapq(self, trapq: Any) -> None:
        """Forget the motion of which no steps have been worked out."""
        self._streams.cut(trapq, self._streams.worked_out_time)

    def note_mcu_movequeue_activity(self, mq_time: float, is_step_gen: bool = True) -> None:
        """There is motion, or another use of an MCU's move queue, until mq_time."""
        self._toolhead().note_mcu_movequeue_activity(mq_time, set_step_gen_time=is_step_gen)

    def drip_update_time(self, start_time: float, end_time: float, drip_completion: Any) -> None:
        """Work out the steps of a move only just in time, until the completion is set."""
        self._toolhead().flush_step_generation()
        mcu = self.printer.lookup_object("mcu")
        self._streams.drip(mcu, start_time, end_time, drip_completion)

    def flush_all_steps(self) -> None:
        """All that is queued becomes steps."""
        self._toolhead().flush_step_generation()

    def register_flush_callback(self, callback: Callable[..., None], can_add_trapq: bool = False) -> None:
        """Call callback(flush_time, step_gen_time) whenever steps have been worked out up to that time."""

        def generator(print_time: float) -> None:
            callback(print_time, print_time)

        self._generators[callback] = generator
        self._streams.generators.append(generator)

    def unregister_flush_callback(self, callback: Callable[..., None]) -> None:
        generator = self._generators.pop(callback, None)
        if generator is not None:
            self._streams.generators.remove(generator)

    def setup_lookahead_flush_callback(self, callback: Callable[..., None]) -> None:
        """A plugin's toolhead plans its moves by itself."""

    def check_step_generation_scan_windows(self) -> None:
        """How far ahead steppers look is asked anew whenever steps are worked out."""


def load_config(config: ConfigWrapper) -> MotionQueuing:
    return MotionQueuing(config.get_printer())
