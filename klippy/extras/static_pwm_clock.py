"""[static_pwm_clock NAME]: a clock for another chip on a hardware PWM pin, half of each cycle on."""

from __future__ import annotations

from configfile import ConfigWrapper

FREQUENCY_MAX_HZ = 520000000
LOW_MAX_S = 0.300  # a cycle of the slowest


class StaticPwmClock:
    """The object `static_pwm_clock NAME`. The board makes the nearest frequency that it can."""

    def __init__(self, config: ConfigWrapper) -> None:
        pins = config.get_printer().lookup_object("pins")
        params = pins.lookup_pin(config.get("pin"), can_invert=True)
        self.mcu = params["chip"]
        self.pin = params["pin"]
        self.frequency_hz = config.getfloat(
            "frequency", 100.0, above=1.0 / LOW_MAX_S, maxval=FREQUENCY_MAX_HZ
        )
        self._section = config
        self.mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu = self.mcu
        cycle_ticks = round(mcu.seconds_to_clock(1.0) / self.frequency_hz)
        if cycle_ticks < 2:
            config = self._section
            raise config.error(
                f"Option 'frequency' in section '{config.get_name()}': board '{mcu.get_name()}' makes half of its clock"
                f" at most, {mcu.seconds_to_clock(1.0) // 2} Hz ({config.where('frequency')})."
            )
        half = int(mcu.get_constant_float("PWM_MAX") / 2.0)
        mcu.add_config_cmd(f"set_pwm_out pin={self.pin} cycle_ticks={cycle_ticks} value={half}")


def load_config_prefix(config: ConfigWrapper) -> StaticPwmClock:
    return StaticPwmClock(config)
