"""[replicape]: the Replicape B3 on a BeagleBone: outputs, currents and modes of its motor drivers.

    replicape:power_hotbed, power_e, power_h, power_fan0 ... 3   PWM by a PCA9685 on I2C
    replicape:stepper_x_enable ... h                             all motors at once: the board has one line
    replicape:servo0, servo1                                     pins gpio1_18, gpio1_19 of the board

Channels of the PCA9685, bits of the shift registers (one byte a driver, the last one first on the wire) and the
reference of the current, 2.5 V for 1.92 A of a PWM of 5 V, are those that the maker's own program Redeem uses. The
drivers are TMC2100: their data sheet has the meaning of CFG0 to CFG6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper

from . import bus

PCA9685_BUS, PCA9685_ADDRESS, CYCLE_S = 2, 0x70, 0.001
SPI_BUS, SPI_SPEED = "spidev1.1", 50000000
POWER_CHANNELS = {
    "power_e": 5, "power_h": 3, "power_hotbed": 4, "power_fan0": 7, "power_fan1": 8, "power_fan2": 9,
    "power_fan3": 10,
}  # fmt: skip
MOTORS = "xyzeh"
CURRENT_CHANNELS = {motor: 11 + number for number, motor in enumerate(MOTORS)}
SERVOS = {"servo0": "gpio1_18", "servo1": "gpio1_19"}
AMPS_FULL = 1.92 * 5.0 / 2.5  # of a duty cycle of 1
MAX_CURRENT_A = 1.92
# TMC2100, tables of CFG1 and CFG2: each is low, high or open
CFG1_DRIVEN, CFG1_HIGH, CFG2_DRIVEN, CFG2_HIGH = 0x80, 0x40, 0x20, 0x10
CFG0_HIGH, CFG4_HIGH, CFG5_HIGH, NOT_ENABLED = 0x08, 0x04, 0x02, 0x01
_CFG1 = {"low": CFG1_DRIVEN, "high": CFG1_DRIVEN | CFG1_HIGH, "open": 0}
_CFG2 = {"low": CFG2_DRIVEN, "high": CFG2_DRIVEN | CFG2_HIGH, "open": 0}
MODES = {
    name: _CFG1[cfg1] | _CFG2[cfg2]
    for name, cfg1, cfg2 in (
        ("1", "low", "low"), ("2", "high", "low"), ("spread2", "open", "low"), ("4", "low", "high"),
        ("16", "high", "high"), ("spread4", "open", "high"), ("spread16", "low", "open"), ("stealth4", "high", "open"),
        ("stealth16", "open", "open"),
    )
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Driver:
    """Its byte in the chain of shift registers, and its current; None: not in use."""

    bits: int
    current_a: float | None


def _read_driver(config: ConfigWrapper, motor: str) -> Driver:
    prefix = f"stepper_{motor}"
    mode = config.getchoice(f"{prefix}_microstep_mode", ["disable", *MODES], "disable")
    bits = 0 if mode == "disable" else MODES[mode]
    for option, bit, default in (
        (f"{prefix}_chopper_off_time_high", CFG0_HIGH, False),
        (f"{prefix}_chopper_hysteresis_high", CFG4_HIGH, False),
        (f"{prefix}_chopper_blank_time_high", CFG5_HIGH, True),
    ):
        bits |= bit if config.getboolean(option, default) else 0
    current = None
    if mode != "disable":
        current = config.getfloat(f"{prefix}_current", above=0.0, maxval=MAX_CURRENT_A)
    return Driver(bits, current)


class Replicape:
    """The board."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        config.getchoice("revision", ["B3"])
        pins = self.printer.lookup_object("pins")
        pins.register_chip("replicape", self)
        self._error = pins.error
        self.host_mcu = self._find_host(config)
        self._enable_pin = config.get("enable_pin", "!gpio0_20")
        self._enable: Any = None
        drivers = {motor: _read_driver(config, motor) for motor in MOTORS}
        self._used = {motor for motor, driver in drivers.items() if driver.current_a is not None}
        for motor, driver in drivers.items():
            Pca9685Pin(self.host_mcu, CURRENT_CHANNELS[motor], (driver.current_a or 0.0) / AMPS_FULL)
        self._send_modes(drivers, config.getboolean("standstill_power_down", False))

    def _find_host(self, config: ConfigWrapper) -> Any:
        name = config.get("host_mcu")
        host = self.printer.lookup_object("mcu" if name == "mcu" else f"mcu {name}", None)
        if host is None:
            raise config.error(
                f"Option 'host_mcu' in section '{config.get_name()}' ({config.where('host_mcu')}): there is no"
                f" [mcu {name}], the linux process on the BeagleBone."
            )
        return host

    def _send_modes(self, drivers: dict[str, Driver], power_down: bool) -> None:
        """The shift registers, at each start. The first bit enables: of X, Y and Z, of E and H, and the standstill."""
        bits = {motor: driver.bits for motor, driver in drivers.items()}
        for owner, motors in (("x", "xyz"), ("e", "eh")):
            if not self._used.intersection(motors):
                bits[owner] |= NOT_ENABLED
        if power_down:
            bits["h"] |= NOT_ENABLED
        spi = bus.MCU_SPI(self.host_mcu, SPI_BUS, None, 0, SPI_SPEED)
        spi.spi_send([bits[motor] for motor in reversed(MOTORS)])

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for replicape:NAME."""
        name = pin_params["pin"]
        if name in SERVOS:
            return self._board_pin(pin_type, SERVOS[name], pin_params)
        motor = name.removeprefix("stepper_").removesuffix("_enable")
        if name == f"stepper_{motor}_enable" and motor in MOTORS and pin_type == "digital_out":
            if motor not in self._used:
                raise self._error(
                    f"replicape:{name} needs stepper_{motor}_microstep_mode and stepper_{motor}_current in [replicape]."
                )
            return self._share_enable(pin_params)
        if name not in POWER_CHANNELS or pin_type not in ("pwm", "digital_out"):
            names = [*POWER_CHANNELS, *(f"stepper_{motor}_enable" for motor in MOTORS), *SERVOS]
            raise self._error(
                f"replicape has no pin {name} for '{pin_type}'. Its outputs are {', '.join(names)}."
            )
        return Pca9685Pin(self.host_mcu, POWER_CHANNELS[name], 0.0, bool(pin_params["invert"]))

    def _board_pin(self, pin_type: str, pin: str, pin_params: dict[str, Any]) -> Any:
        prefix = "!" if pin_params["invert"] else ""
        return self.printer.lookup_object("pins").setup_pin(pin_type, f"{prefix}{pin}")

    def _share_enable(self, pin_params: dict[str, Any]) -> SharedEnable:
        if pin_params["invert"]:
            raise self._error(
                f"replicape:{pin_params['pin']} cannot be inverted; enable_pin of [replicape] can."
            )
        if self._enable is None:
            self._enable = self.printer.lookup_object("pins").setup_pin("digital_out", self._enable_pin)
            self._enable.setup_max_duration(0.0)
            self._lines = EnableLine(self._enable)
        return SharedEnable(self._lines)


class EnableLine:
    """The one line of all drivers: on while any motor is."""

    def __init__(self, pin: Any) -> None:
        self.pin = pin
        self._on: set[SharedEnable] = set()
        self._last_time = 0.0

    def set(self, owner: SharedEnable, print_time: float, value: int) -> None:
        was_on = bool(self._on)
        (self._on.add if value else self._on.discard)(owner)
        if bool(self._on) != was_on:
            self._last_time = max(self._last_time, print_time)
            self.pin.set_digital(self._last_time, int(bool(self._on)))


class SharedEnable:
    """The enable pin of one motor."""

    def __init__(self, line: EnableLine) -> None:
        self._line = line

    def get_mcu(self) -> Any:
        return self._line.pin.get_mcu()

    def setup_max_duration(self, max_duration: float) -> None:
        """The line has none."""

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        """The line is off at start and in a shutdown."""

    def set_digital(self, print_time: float, value: int) -> None:
        self._line.set(self, print_time, value)


class Pca9685Pin:
    """A channel of the PCA9685; off in a shutdown, and after `max_duration` without a refresh."""

    def __init__(self, mcu: Any, channel: int, start_value: float, invert: bool = False) -> None:
        self._mcu, self._channel, self._invert = mcu, channel, invert
        self._start = self._shutdown = 1.0 - start_value if invert else start_value
        self._max_duration_s = 0.0
        self._oid = mcu.create_oid()
        self._full = 0.0
        self._last_clock = 0
        self._set: Any = None
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Any:
        return self._mcu

    def setup_max_duration(self, max_duration: float) -> None:
        """Longest time without a refresh, s."""
        self._max_duration_s = max_duration

    def setup_cycle_time(self, cycle_time: float, hardware_pwm: bool = False) -> None:
        """All channels have the same cycle of 1 ms."""

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        self._start, self._shutdown = self._level(start_value), self._level(shutdown_value)

    def _level(self, value: float) -> float:
        value = max(0.0, min(1.0, value))
        return 1.0 - value if self._invert else value

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        mcu.request_move_queue_slot()
        self._full = mcu.get_constant_float("PCA9685_MAX")
        mcu.add_config_cmd(
            f"config_pca9685 oid={oid} bus={PCA9685_BUS} addr={PCA9685_ADDRESS} channel={self._channel}"
            f" cycle_ticks={mcu.seconds_to_clock(CYCLE_S)} value={round(self._start * self._full)}"
            f" default_value={round(self._shutdown * self._full)}"
            f" max_duration={mcu.seconds_to_clock(self._max_duration_s)}"
        )
        self._set = mcu.lookup_command(
            "queue_pca9685_out oid=%c clock=%u value=%hu", cq=mcu.alloc_command_queue()
        )

    def set_pwm(self, print_time: float, value: float) -> None:
        """The duty cycle from print_time on."""
        clock = self._mcu.print_time_to_clock(print_time)
        data = [self._oid, clock, round(self._level(value) * self._full)]
        self._set.send(data, minclock=self._last_clock, reqclock=clock)
        self._last_clock = clock

    def set_digital(self, print_time: float, value: int) -> None:
        """On or off from print_time on."""
        self.set_pwm(print_time, float(bool(value)))


def load_config(config: ConfigWrapper) -> Replicape:
    return Replicape(config)
