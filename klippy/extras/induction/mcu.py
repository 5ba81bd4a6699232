"""The induction unit's border: SI and print time on this side, ticks and clocks on the wire. Decides nothing.

    queue_plan([PhaseCommand])     ──> queue_induction_plan clock= steps=    replaces what was pending from then on
    on_blocks(Blocks)              <── induction_block sequence= clock= data=     each at once, or in batches

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

from thermal.records import PHASE_MAX_TICKS, PhaseCommand
from thermal.sensing import convert, guard_limits
from thermal.sensing.blocks import Blocks
from thermal.sensing.features import FeatureParameters
from thermal.sensing.guard_limits import LimitRow

from .signal_limits import off_lsb, signal_limits

PLAN_STEPS_MAX = 10  # of 4 bytes: they fit one message
# Steps that may wait on the MCU at one time: a plan, and what stays of the one before.
MOVE_QUEUE_SLOTS = 24
# In steady state messages of blocks wake the host in batches: waking costs it more than the messages. Less than the
# 25 ms between two steps that AHEAD_S of thermal/control/nozzle_model.py reckons with.
BATCH_SLACK_S = 0.005  # should a message be lost
BLOCK_FORMAT = "induction_block oid=%c sequence=%hu clock=%u data=%*s"
PLAN_STEP = struct.Struct("<HH")
STATE_FORMAT = "induction_query oid=%c"  # answered by induction_state, also after a stop
CEILING_FORMAT = "induction_ceiling oid=%c phase=%hu share=%hu"
TEST_FORMAT = (
    "config_induction_test oid=%c moved_low=%hu moved_high=%hu off_low=%hu off_high=%hu interval=%hu phase=%hu"
    " jump=%hu rise=%hu fall=%hu tolerance=%c slack=%hu"
)

OnBlocks = Callable[[Blocks], None]


@dataclass(frozen=True, slots=True)
class TestSettings:
    """The board's tests of the signal; plain values."""

    interval_s: float  # from test to test; 0: none
    gain_units_deg: float | None  # as measured
    front: FeatureParameters
    phase_ticks: int  # below it nothing is tested


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
    records: int  # blocks to a message


class InductionUnit:
    """One bridge with its synchronous ADC on one MCU."""

    def __init__(
        self,
        mcu: Any,
        sense_pin: str,
        settings: UnitSettings,
        front: FeatureParameters,
        limits: Sequence[LimitRow],
        tests: TestSettings | None = None,
        ceiling: guard_limits.Ceiling | None = None,
    ) -> None:
        self.mcu = mcu
        self.settings = settings
        self._front = front
        self._sense_pin = sense_pin
        self._limits = list(limits)
        self._tests = tests
        self._ceiling = ceiling
        self._oid = mcu.create_oid()
        self._on_blocks: OnBlocks = lambda blocks: None
        self._queue_plan: Any = None
        self._set_ceiling: Any = None
        self._ask_state: Any = None
        self._on_current: Callable[[bool], None] = lambda flows: None
        self._share = 0xFFFF  # of the rows, as the firmware begins ...
        # ... and the target and correction that it is for, and their steps
        self._ceiling_c = self._stepped_c = (math.inf, 0.0)
        self._period_s = math.inf
        self._batch_s = 0.0
        self._stream: convert.Stream | None = None
        mcu.register_config_callback(self._build_config)

    def setup_callback(self, on_blocks: OnBlocks) -> None:
        """`on_blocks(blocks)` in the reactor's thread, for every batch of messages with news."""
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
        self._configure_tests(clock_hz)
        mcu.add_config_cmd(f"induction_report oid={oid} enable=1", is_init=True)
        queue = mcu.alloc_command_queue()
        self._queue_plan = mcu.lookup_command("queue_induction_plan oid=%c clock=%u steps=%*s", cq=queue)
        self._set_ceiling = mcu.try_lookup_command(CEILING_FORMAT) if self._ceiling else None
        self._ask_state = mcu.lookup_command(STATE_FORMAT)
        mcu.register_response(self._on_state, "induction_state", oid)
        self._period_s = period_ticks / clock_hz
        mcu.register_batch(self._take_batch, BLOCK_FORMAT)

    def _configure_tests(self, clock_hz: float) -> None:
        tests, mcu = self._tests, self.mcu
        if tests is None or not tests.interval_s:
            return
        name = mcu.get_name()
        if mcu.try_lookup_command(TEST_FORMAT) is None:
            logging.warning("induction unit on mcu '%s': its firmware has no tests of the signal", name)
            return
        moved_s = float(mcu.get_constants().get("INDUCTION_MOVE_TICKS", 0)) / clock_hz
        if not moved_s:
            logging.warning(
                "induction unit on mcu '%s': cannot move its sampling instant, no test of gain", name
            )
        limits = signal_limits(
            tests.front,
            self.settings.frequency_hz,
            tests.interval_s,
            tests.gain_units_deg,
            moved_s,
            tests.phase_ticks,
        )
        mcu.add_config_cmd(
            f"config_induction_test oid={self._oid} moved_low={limits.moved_low} moved_high={limits.moved_high}"
            f" off_low={limits.off_low} off_high={limits.off_high} interval={limits.interval}"
            f" phase={limits.phase} jump={limits.jump} rise={limits.rise} fall={limits.fall}"
            f" tolerance={limits.tolerance} slack={limits.slack}"
        )

    # Samples up

    def _take_batch(self, messages: Any, count: int) -> None:
        stream = self._stream
        if stream is None:
            return
        blocks = stream.take(messages, count, *self.mcu.dated(messages[count - 1].receive_time))
        if complaint := stream.complaint():
            name = self.mcu.get_name()
            logging.warning("induction unit on mcu '%s': %s; message ignored", name, complaint)
        if blocks.count:
            self._on_blocks(blocks)

    def ask_current(self, on_current: Callable[[bool], None]) -> None:
        """With the bridge commanded off: does current flow in the coil nevertheless? The answer comes later."""
        if self._ask_state is not None:
            self._on_current = on_current
            self._ask_state.send([self._oid])

    def _on_state(self, params: dict[str, Any]) -> None:
        if not params["phase"]:
            raw = params["value"] / (1 << self.settings.oversample)
            self._on_current(abs(raw - self._front.adc_zero_raw) > off_lsb(self._front))

    def set_batched(self, span_s: float) -> None:
        """Messages of blocks may wait for one another for so long; 0: each is to come at once."""
        if span_s == self._batch_s:
            return
        self._batch_s = span_s
        message_s = self.settings.records * self.settings.block_samples / self.settings.frequency_hz
        count = max(1, int(span_s / message_s)) if span_s else 0
        self.mcu.register_batch(self._take_batch, BLOCK_FORMAT, count * message_s + BATCH_SLACK_S, count)

    # Phases down

    def set_ceiling(self, target_c: float, drift_c: float) -> None:
        """The board trips when the nozzle is driven hard and reads far above this target, by a law corrected so."""
        if (target_c, drift_c) == self._ceiling_c or self._set_ceiling is None or self._ceiling is None:
            return
        self._ceiling_c = target_c, drift_c
        stepped_c = guard_limits.stepped(target_c), guard_limits.stepped(drift_c)
        if stepped_c == self._stepped_c:
            return
        self._stepped_c = stepped_c
        share = self._ceiling.share(*stepped_c)
        if share != self._share:
            self._share = share
            self._set_ceiling.send([self._oid, self._ceiling.phase_ticks, share])

    def queue_plan(self, commands: Sequence[PhaseCommand]) -> None:
        """Send phases in order of time, in place of all that is pending from the first of them on."""
        if not commands:
            return
        first_s, ticks, _ = commands[0]
        clock, periods = self.mcu.print_time_to_clock(first_s), 0
        steps = PLAN_STEP.pack(0, ticks)
        for time_s, ticks, _ in commands[1:PLAN_STEPS_MAX]:
            at = max(periods, round((time_s - first_s) / self._period_s))
            steps += PLAN_STEP.pack(min(0xFFFF, at - periods), ticks)
            periods = at
        self._queue_plan.send([self._oid, clock, steps], minclock=0, reqclock=clock)

    def print_time_now(self, eventtime: float) -> float:
        """Estimated present print time of this MCU."""
        return self.mcu.estimated_print_time(eventtime)

    def get_status(self) -> dict[str, int]:
        """Counters of the stream of blocks."""
        names = ("blocks", "missing_blocks", "lost_samples", "discarded_samples")
        counters = self._stream.counters if self._stream is not None else None
        values = [getattr(counters, name, 0) for name in names]
        return dict(zip(("blocks", "blocks_lost", "samples_lost", "samples_discarded"), values, strict=True))
