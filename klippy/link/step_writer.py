"""Finished step commands of one MCU on their way into its link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import serialhdl


class StepWriter:
    """Where the finished step commands of one MCU go (see serialqueue_send_batch)."""

    def __init__(self, serial: serialhdl.SerialReader, move_count: Callable[[], int]) -> None:
        self.move_count = move_count  # places in the move queue for steps, once the MCU is configured
        self._serial = serial
        self._lib = serial._lib
        self.sq = serial.get_serialqueue()
        self.cq = serial.alloc_command_queue()

    def send(self, messages: Any) -> None:
        """Queue a list of struct queue_message; takes ownership."""
        if self._lib.serialqueue_send_batch(self.sq, self.cq, messages) < 0:
            raise serialhdl.error("a step command has an impossible length")
        self.notify()

    def notify(self) -> None:
        """C code has queued something by itself."""
        port = self._serial.port
        if port is not None:
            port.notify()
