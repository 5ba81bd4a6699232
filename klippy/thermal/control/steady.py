"""While nothing happens the host is told in bulk, and the MCU watches that it stays so.

What a block reads while nothing happens is known beforehand: the reading of the target at the phase that is being sent.
So the MCU need not say it six hundred times a second; it is given the expected reading, and interrupts as soon as
blocks stray from it ("send on delta": Miskowicz, Sensors 2006, 6(1), 49, doi:10.3390/s6010049). It judges an
exponentially weighted mean of the blocks (src/attention.h), whose noise is a quarter of a block's: a slow beginning is
noticed long before any single block is out of the ordinary (Lucas and Saccucci, Technometrics 1990, 32(1), 1).

The host then steps once for each lot of messages, and a plan feeds the bridge's watchdog ahead of time:

    messages ···|·······|·······|·······|·······|·······|   a lot: one step
    plan            phase ──────────────────────── same ──────────────────── same
                    ^ lead_s after the step        ^ fed                     ^ fed, should the host be late

On a simulated reference nozzle, lots of 22 ms without and of 67 ms with somebody who watches: an extrusion of 25 mm^3/s
that nobody told of costs 0.67 and 0.63 degC, one of 5 mm^3/s 0.35 and 0.31, a fan switched on by hand 0.24 and 0.23;
with lots of 67 ms and nobody watching the first costs 1.0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from thermal.records import PhaseCommand

CALM_C = 0.3  # nearer than this to a target that stays, with no extrusion planned ...
CALM_S = 0.5  # ... for so long: nothing happens
LOT_S = 0.067  # from one step to the next: six messages of seven blocks of 192 samples
STALL_S = 0.150  # a host later than its lot by so much trips nothing
FEED_SHARE = 0.8  # of the watchdog's patience, from one feeding to the next

MEAN_SHARE = 0.258  # noise of the MCU's mean over that of a block: sqrt(a / (2 - a)), a = 1/8
STRAY_SIGMA = 4.5  # a mean farther than so many of its own standard deviations from what is expected ...
STRAY_C = (
    0.12  # ... and farther than this, seven standard deviations of what a calm nozzle does: something happens
)
STRAY_S = 0.2  # for so long at least; a false alarm, one in ten seconds, so costs forty messages


class Calm(NamedTuple):
    """What the MCU shall expect of a block; limit_raw 0: nothing, it only tells in bulk."""

    phase_ticks: int
    expected_raw: float  # mean ADC code of a block
    limit_raw: float  # how far the mean of blocks may be from it


NOTHING_EXPECTED = Calm(0, 0.0, 0.0)


def limit_raw(raw_per_c: float, noise_raw: float) -> float:
    """How far a mean of blocks may be from what is expected; `noise_raw` one standard deviation of a block."""
    return max(STRAY_C * raw_per_c, STRAY_SIGMA * MEAN_SHARE * noise_raw)


def feedings(command: PhaseCommand, max_duration_s: float) -> list[PhaseCommand]:
    """The same phase again, as often as keeps the bridge on until a host late by STALL_S has spoken."""
    feed_s = FEED_SHARE * max_duration_s
    times = max(0, math.ceil((LOT_S + STALL_S - max_duration_s) / feed_s))
    return [command._replace(time_s=command.time_s + (i + 1) * feed_s) for i in range(times)]
