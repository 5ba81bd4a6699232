"""The induction unit's border: SI and print time on this side, ticks and clocks on the wire. Decides nothing.

    queue_plan([PhaseCommand])     ──> queue_induction_plan clock= steps=    replaces what was pending from then on
    set_calm(calm)                 ──> induction_batch records=
    queue_phase(PhaseCommand)      ──> queue_induction_phase clock= phase=
    on_blocks(Blocks)              <── induction_block sequence= clock= data=

The MCU turns the bridge off by itself when it hears no phase command for `max_duration`, and trips on its own
table of raw limits, which is sent here once at configuration.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from thermal import convert
from thermal.blocks import Blocks
from thermal.limits import LimitRow
from thermal.records import PHASE_MAX_TICKS, PhaseCommand

PLAN_STEPS_MAX = 10  # of 4 bytes: they fit one message
# Steps that may wait on the MCU at one time: a plan, and what stays of the one before.
MOVE_QUEUE_SLOTS = 24
# While nothing happens two messages of blocks wake the host once: waking costs it more than the messages.
CALM_MESSAGES, CALM_WAIT_S = 2, 0.015
PLAN_STEP = struct.Struct("<HH")

OnBlocks = Callable[[Blocks], None]


@dataclass(frozen=True, slots=True)
class UnitSettings:
    """How one induction unit is wired and sampled; plain values."""

    bridge: int  # index of the full bridge on its MCU
    frequency_hz: float
    oversample: int  # y: 4^y samples a block
    settle_samples: int  # discarded after a phase step
    ema_shift: int  # 0 = no filter on the MCU
    max_duration_s: float  # the bridge's own watchdog
    trip_blocks: int  # consecutive blocks beyond a limit before the guard trips
    block_samples: int  # samples of a whole block, at most 4^oversample
    records: int  # blocks to a message ...
    calm_records: int  # ... and while nothing happens


class InductionUnit:
    """One bridge with its synchronous ADC on one MCU."""

    def __init__(self, mcu: Any, sense_pin: str, settings: UnitSettings, limits: Sequence[LimitRow]) -> None:
        self.mcu = mcu
        self.settings = settings
        self._sense_pin = sense_pin
        self._limits = list(limits)
        self._oid = mcu.create_oid()
        self._on_blocks: OnBlocks | None = None
        self._queue_phase: Any = None
        self._queue_plan: Any = None
        self._period_ticks, self._period_s = 0, math.inf
        self._report: Any = None
        self._batch: Any = None
        self._calm = False
        self._stream: convert.Stream | None = None
        self._last_clock = 0
        mcu.register_config_callback(self._build_config)
        mcu.register_response(self._handle_block, "induction_block", self._oid)

    def setup_callback(self, on_blocks: OnBlocks) -> None:
        """`on_blocks(blocks)` in the reactor's thread, for every message with news."""
        self._on_blocks = on_blocks

    def _build_config(self) -> None:
        mcu, settings, oid = self.mcu, self.settings, self._oid
        clock_hz = mcu.get_constant_float("CLOCK_FREQ")
        period_ticks = round(clock_hz / settings.frequency_hz)
        phase_max = int(mcu.get_constants().get("BRIDGE_PHASE_MAX", PHASE_MAX_TICKS))
        self._stream = convert.Stream(
            convert.ConvertParameters(settings.oversample, period_ticks, clock_hz, settings.block_samples)
        )
        for _ in range(MOVE_QUEUE_SLOTS):
            mcu.request_move_queue_slot()
        mcu.add_config_cmd(
            f"config_induction oid={oid} bridge={settings.bridge} adc_pin={self._sense_pin}"
            f" period_ticks={period_ticks} phase_max={phase_max}"
            f" max_duration={mcu.seconds_to_clock(settings.max_duration_s)}"
        )
        mcu.add_config_cmd(
            f"config_induction_sense oid={oid} oversample={settings.oversample}"
            f" settle_samples={settings.settle_samples} ema_shift={settings.ema_shift}"
        )
        mcu.add_config_cmd(
            f"config_induction_block oid={oid} samples={settings.block_samples} records={settings.records}"
        )
        for row in self._limits:
            mcu.add_config_cmd(
                f"config_induction_limit oid={oid} phase={row.phase_ticks} low={row.low_raw}"
                f" high={row.high_raw} trip_blocks={settings.trip_blocks}"
            )
        mcu.add_config_cmd(f"induction_report oid={oid} enable=1", is_init=True)
        queue = mcu.alloc_command_queue()
        self._queue_phase = mcu.lookup_command("queue_induction_phase oid=%c clock=%u phase=%hu", cq=queue)
        self._queue_plan = mcu.lookup_command("queue_induction_plan oid=%c clock=%u steps=%*s", cq=queue)
        self._period_ticks, self._period_s = period_ticks, period_ticks / clock_hz
        self._batch = mcu.lookup_command("induction_batch oid=%c records=%c", cq=queue)
        self._report = mcu.lookup_command("induction_report oid=%c enable=%c", cq=queue)

    # Samples up

    def _handle_block(self, params: dict[str, Any]) -> None:
        if self._stream is None or self._on_blocks is None:
            return
        clock = self.mcu.clock32_to_clock64(params["clock"])
        start_s = self.mcu.clock_to_print_time(clock)
        try:
            blocks = self._stream.take(params["sequence"], clock, params["data"], start_s)
        except convert.ConvertError as e:
            logging.warning("induction unit on mcu '%s': %s; message ignored", self.mcu.get_name(), e)
            return
        if blocks.count:
            self._on_blocks(blocks)

    # Phases down

    def queue_phase(self, command: PhaseCommand) -> None:
        """Send one time-stamped phase; commands must come in order of time."""
        clock = self.mcu.print_time_to_clock(command.time_s)
        # Rounding must never make a command earlier than the one before it.
        clock = max(clock, self._last_clock + 1)
        self._last_clock = clock
        self._queue_phase.send([self._oid, clock, command.phase_ticks], minclock=0, reqclock=clock)

    def queue_plan(self, commands: Sequence[PhaseCommand]) -> None:
        """Send phases in order of time, in place of all that is pending from the first of them on."""
        if not commands:
            return
        clock = self.mcu.print_time_to_clock(commands[0].time_s)
        steps, periods = b"", 0
        for command in commands[:PLAN_STEPS_MAX]:
            at = max(periods, round((command.time_s - commands[0].time_s) / self._period_s))
            steps += PLAN_STEP.pack(min(0xFFFF, at - periods), command.phase_ticks)
            periods = at
        self._last_clock = clock + periods * self._period_ticks
        self._queue_plan.send([self._oid, clock, steps], minclock=0, reqclock=clock)

    def set_calm(self, calm: bool) -> None:
        """Blocks may come in bulk, or (not calm) each as soon as may be."""
        if calm != self._calm:
            self._calm = calm
            self._batch.send([self._oid, self.settings.calm_records if calm else self.settings.records])
            self.mcu.set_patience("induction_block", CALM_WAIT_S, CALM_MESSAGES if calm else 0)

    def set_report(self, enable: bool) -> None:
        """Start or stop sampling and reports."""
        self._report.send([self._oid, int(enable)])
        if self._stream is not None:
            self._stream.restart()

    def print_time_now(self, eventtime: float) -> float:
        """Estimated present print time of this MCU."""
        return self.mcu.estimated_print_time(eventtime)

    def get_status(self) -> dict[str, int]:
        """Counters of the stream of blocks."""
        names = ("blocks", "missing_blocks", "lost_samples", "discarded_samples")
        counters = self._stream.counters if self._stream is not None else None
        values = [getattr(counters, name, 0) for name in names]
        return dict(zip(("blocks", "blocks_lost", "samples_lost", "samples_discarded"), values, strict=True))
