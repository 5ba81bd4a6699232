"""[smart_effector]: a probe that feels the force on the nozzle (Duet3D). SET_SMART_EFFECTOR, RESET_SMART_EFFECTOR.

It is a [probe] whose moves may be gentler than others, after a rest. Its sensitivity is programmed over `control_pin`,
1000 bits a second (M672 of RepRapFirmware): for each byte 0 0 1 0, bits 7 to 4, bit 4 inverted, bits 3 to 0, bit 0
inverted. The line rests at 0.

    105 sensitivity (255 - sensitivity)     set; kept without power
    131 131                                 as from the factory
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .probe import PrinterProbe
from .probing.switch import ProbeSwitch

BIT_S = 0.001
START_BITS = (0, 0, 1, 0)
BITS_WAITING = 8  # on the MCU
STORE_S = 0.1  # until the value is in its memory
SET_SENSITIVITY, FACTORY = 105, 131


def frame_bits(data: Sequence[int]) -> Iterator[int]:
    """What the line is, bit time by bit time."""
    for byte in data:
        yield from START_BITS
        for low in (4, 0):
            bits = [byte >> place & 1 for place in range(low + 3, low - 1, -1)]
            yield from bits
            yield 1 - bits[-1]
    yield 0


class SmartEffector(ProbeSwitch):
    """The probe's switch."""

    def __init__(self, config: ConfigWrapper) -> None:
        super().__init__(config)
        self._probe_accel = config.getfloat("probe_accel", 0.0, minval=0.0)
        self._recovery_s = config.getfloat("recovery_time", 0.4, minval=0.0)
        self._own_accel: float | None = None  # of other moves, while probing
        self._control: Any = None
        self._free_at = 0.0  # print time at which the last programming has ended
        if config.get("control_pin", None) is not None:
            self._control = self.printer.lookup_object("pins").setup_pin("pwm", config.get("control_pin"))
            self._control.setup_max_duration(0.0)
            self._control.setup_cycle_time(BIT_S)
            self._control.setup_start_value(0.0, 0.0)
            self._control.setup_waiting(BITS_WAITING)

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "SET_SMART_EFFECTOR", self.cmd_SET_SMART_EFFECTOR, desc="Set SmartEffector parameters"
        )
        if self._control is not None:
            gcode.register_command(
                "RESET_SMART_EFFECTOR",
                self.cmd_RESET_SMART_EFFECTOR,
                desc="Reset SmartEffector settings (sensitivity)",
            )

    def probe_prepare(self, hmove: Any) -> None:
        """Before each move towards the bed."""
        super().probe_prepare(hmove)
        toolhead = self.printer.lookup_object("toolhead")
        if self._probe_accel and self._own_accel is None:
            self._own_accel = toolhead.get_max_velocity()[1]
            toolhead.set_max_velocities(None, min(self._probe_accel, self._own_accel), None, None)
        if self._recovery_s:
            toolhead.dwell(self._recovery_s)

    def probe_finish(self, hmove: Any) -> None:
        """After each move towards the bed."""
        if self._own_accel is not None:
            own, self._own_accel = self._own_accel, None
            self.printer.lookup_object("toolhead").set_max_velocities(None, own, None, None)
        super().probe_finish(hmove)

    def _program(self, data: Sequence[int]) -> None:
        """Send bytes after all queued moves; the head rests until they have arrived."""
        toolhead = self.printer.lookup_object("toolhead")
        start = max(toolhead.get_last_move_time(), self._free_at)
        before = 0
        for number, bit in enumerate(frame_bits(data)):
            if bit != before:
                self._control.set_pwm(start + number * BIT_S, bit)
            before = bit
        self._free_at = start + 14 * len(data) * BIT_S + STORE_S
        toolhead.dwell(self._free_at - toolhead.get_last_move_time())

    def cmd_SET_SMART_EFFECTOR(self, gcmd: GCodeCommand) -> None:
        """SET_SMART_EFFECTOR [SENSITIVITY=0..255] [ACCEL=mm/s^2] [RECOVERY_TIME=s]."""
        sensitivity = gcmd.get_int("SENSITIVITY", None, minval=0, maxval=255)
        accel = gcmd.get_float("ACCEL", self._probe_accel, minval=0.0)
        recovery_s = gcmd.get_float("RECOVERY_TIME", self._recovery_s, minval=0.0)
        if sensitivity is not None:
            if self._control is None:
                raise gcmd.error("SENSITIVITY needs control_pin in section [smart_effector]")
            self._program((SET_SENSITIVITY, sensitivity, 255 - sensitivity))
        self._probe_accel, self._recovery_s = accel, recovery_s
        text = f"probe_accel: {accel:.3f}, recovery_time: {recovery_s:.3f}"
        if sensitivity is not None:
            text = f"sensitivity: {sensitivity}, {text}"
        gcmd.respond_info(f"SmartEffector:\n{text}")

    def cmd_RESET_SMART_EFFECTOR(self, gcmd: GCodeCommand) -> None:
        """The sensitivity of the factory."""
        self._program((FACTORY, FACTORY))
        gcmd.respond_info("SmartEffector sensitivity was reset")


def load_config(config: ConfigWrapper) -> SmartEffector:
    effector = SmartEffector(config)
    effector.register()
    config.get_printer().add_object("probe", PrinterProbe(config, effector))
    return effector
