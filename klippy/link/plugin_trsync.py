"""MCU_trsync as plugins use it that stop motors by a sensor of their own.

They make one for each board with what `trdispatch_alloc` of the C helper gave them, start and stop each of them, and
send the board of their sensor a command that triggers the first. The group of boards is a TriggerDispatch.
"""

from __future__ import annotations

import weakref
from typing import Any

from .mcu_homing import MULTI_REPORT_S, SINGLE_REPORT_S, SINGLE_TIMEOUT_S, TriggerDispatch, Trsync
from .roles import Mcu

# By the plugin's object; it goes with the plugin.
_groups: weakref.WeakKeyDictionary[Any, TriggerDispatch] = weakref.WeakKeyDictionary()


class MCU_trsync(Trsync):
    """The trsync of one board and the steppers it stops."""

    def __init__(self, mcu: Mcu, trdispatch: Any) -> None:
        group = _groups.get(trdispatch)
        if group is None:
            group = _groups[trdispatch] = TriggerDispatch(mcu, [])
        super().__init__(mcu, group)
        group.add_trsync(self)

    def start(self, print_time: float, *options: Any) -> None:
        """start(print_time, [report_offset,] completion, time-out in s)."""
        *offset, completion, timeout_s = options
        self._dispatch.begin(completion)
        report_s = SINGLE_REPORT_S if timeout_s >= SINGLE_TIMEOUT_S else MULTI_REPORT_S
        super().start(print_time, offset[0] if offset else 0.0, timeout_s, report_s)

    def set_home_end_time(self, home_end_time: float) -> None:
        """The move ends then."""
        self._dispatch.set_end(home_end_time)

    def stop(self) -> int:
        self._dispatch.end()
        return super().stop()
