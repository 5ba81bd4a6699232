"""The ATmega2560's image on its emulator, with the recording board of test/c.

The emulator counts cycles as the datasheet has them, so costs are exact for the paths taken, and the same on every run.
"""

from __future__ import annotations

from typing import Any

from chip_rig import Firmware

MEGA_HZ = 16_000_000
BOTH_EDGES = 0xFF
# step and direction pins of RAMPS' X, Y, Z and E0: PF0 PF1, PF6 PF7, PL3 PL1, PA4 PA6
STEP_PINS = ((40, 41), (46, 47), (83, 81), (4, 6))


class Mega(Firmware):
    """The Mega, powered on; `clock()` and `since()` go between the board's clock and the chip's own counter."""

    def __init__(self, boot_clock: int = 1000, **options: Any) -> None:
        super().__init__("atmega2560", boot_clock=boot_clock, **options)

    def run(self, seconds: float) -> None:
        self.run_to(self.now + round(seconds * MEGA_HZ))
        self._blocks()
        assert not self.fault(), self.fault()

    def boot_again(self, settle_s: float = 0.05) -> None:
        """The reset the firmware asked for takes place."""
        self.sequence = 0
        self.lib.sim_mcu_boot(self.board, self.now)
        self.run(settle_s)

    @property
    def zero(self) -> int:
        """The board's clock when the chip's counter was 0 last (mod 2^32)."""
        return self.chip.peek("timer5.zero")

    def clock_in(self, seconds: float) -> int:
        """A clock to name in a command: so far ahead."""
        return (self.now - self.zero + round(seconds * MEGA_HZ)) & 0xFFFFFFFF

    def chip_clock(self, board_clock: int) -> int:
        return (board_clock - self.zero) & 0xFFFFFFFF

    def busy_cycles(self) -> int:
        return self.chip.peek("ticks.busy")


def stepping(count: int, invert_step: int = BOTH_EDGES, pulse_ticks: int = 0) -> Mega:
    """A Mega with so many steppers."""
    mega = Mega()
    steppers = [
        ("config_stepper", {"oid": oid, "step_pin": step, "dir_pin": direction, "invert_step": invert_step,
                            "step_pulse_ticks": pulse_ticks})
        for oid, (step, direction) in enumerate(STEP_PINS[:count])
    ]  # fmt: skip
    mega.configure(count, *steppers)
    return mega


def run_steps(mega: Mega, steppers: int, interval: int, count: int, lead_s: float = 0.1) -> int:
    """All steppers alike from the same clock on, to their end; returns that clock."""
    clock = mega.clock_in(lead_s)
    for oid in range(steppers):
        mega.send("reset_step_clock", oid=oid, clock=clock)
        mega.send("queue_step", oid=oid, interval=interval, count=count, add=0)
    mega.run(lead_s + (interval * (count + 1) + 20000) / MEGA_HZ)
    return clock
