"""A Trinamic stepper driver with registers: currents, thresholds, its faults, its phase, StallGuard as an endstop.

In what the kinds differ is in chips.py and current.py; how to reach the registers in uart.py and
spi.py. At start-up all registers are written. `tmcXXXX_STEPPER:virtual_endstop` is a pin for endstop_pin: while
homing, the driver works in the mode its StallGuard needs and signals a stall on its DIAG pin.
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .chips import FLAGS, SIGNED, Chip
from .current import CurrentModel
from .registers import Fields, adc_temp_c, microstep_bits, speed_threshold
from .surface import CurrentView, FieldView, RegisterView

STEP_PULSE_S = 0.000000100
PHASES_PER_CYCLE = 1024  # of MSCNT
# While the motor is on, the driver is asked for faults this often.
CHECK_PERIOD_S = 1.0
GSTAT_ALL = 0x1F
SPEED_FIELDS = ("tpwmthrs", "tcoolthrs", "thigh")
FAULTS = {
    "ot": "it is too hot and has switched off",
    "s2ga": "short of coil A to ground",
    "s2gb": "short of coil B to ground",
    "s2vsa": "short of coil A to the supply",
    "s2vsb": "short of coil B to the supply",
}


class Link(Protocol):
    """The way to one driver's registers."""

    mcu: Any

    def read(self, register: int) -> int: ...

    def write(self, register: int, value: int) -> None: ...


class StepperDriver:
    """Printer object 'tmcXXXX STEPPER'."""

    def __init__(self, config: ConfigWrapper, chip: Chip, link: Link, current: CurrentModel) -> None:
        self.printer = config.get_printer()
        self.stepper_name = config.get_name().split(None, 1)[-1]
        self.name = self.stepper_name.split()[-1]
        self.chip, self.link, self.current = chip, link, current
        self.values = Fields(chip.fields)
        self.stepper: Any = None
        # for plugins
        self.fields = FieldView(self.values)
        self.mcu_tmc = RegisterView(self.fields, chip.clock_hz, self._read, self._write)
        self.current_helper = CurrentView(self)
        self.read_registers, self.read_translate = chip.readable, None
        largest = current.largest_a
        self.run_current = config.getfloat("run_current", above=0.0, maxval=largest)
        self.hold_current = self._read_hold_current(config)
        self._stealth_speed: float | None = None
        if chip.stealth_field is not None:
            self._stealth_speed = config.getfloat("stealthchop_threshold", None, minval=0.0)
        self._speeds: dict[str, float] = {}
        for option, field in (("coolstep_threshold", "tcoolthrs"), ("high_velocity_threshold", "thigh")):
            if field in chip.fields and (speed := config.getfloat(option, None, minval=0.0)) is not None:
                self._speeds[field] = speed
        self._read_driver_options(config)
        self._read_microsteps(config)
        self._phase_offset: int | None = None
        self._stall_field = ""
        self._saved: dict[str, int] = {}
        self._endstop: Any = None
        self._is_hot = False
        # None while the motor is off
        self._drv_status: dict[str, int] | None = None  # fields that are not 0
        self._temp_c: float | None = None
        self._reactor = self.printer.get_reactor()
        self._check_timer = self._reactor.register_timer(self._check_faults)
        self._chip_name = f"{chip.name}_{self.name}"
        self._diag_pin = self._read_diag_pin(config)

    def _read_hold_current(self, config: ConfigWrapper) -> float:
        largest = self.current.largest_a
        return float(config.getfloat("hold_current", self.run_current, above=0.0, maxval=largest))

    def _read_driver_options(self, config: ConfigWrapper) -> None:
        for name, value in self.chip.fixed.items():
            self.values.set(name, value)
        for name, default in self.chip.options.items():
            option, size = f"driver_{name}", 1 << self.chip.fields[name].width
            if name in FLAGS:
                value = int(config.getboolean(option, bool(default)))
            elif name in SIGNED:
                value = config.getint(option, default, minval=-size // 2, maxval=size // 2 - 1) % size
            else:
                value = config.getint(option, default, minval=0, maxval=size - 1)
            self.values.set(name, value)

    def _read_microsteps(self, config: ConfigWrapper) -> None:
        if not config.has_section(self.stepper_name):
            raise config.error(
                f"Section '{config.get_name()}': there is no section [{self.stepper_name}] for its motor"
            )
        section = config.getsection(self.stepper_name)
        self.microsteps = section.getint("microsteps", note_valid=False)
        try:
            self.values.set("mres", microstep_bits(self.microsteps))
        except ValueError as e:
            raise config.error(f"Option 'microsteps' in section '{self.stepper_name}': {e}") from None
        can_interpolate = self.microsteps == (self.chip.interpolated or self.microsteps)
        self.values.set("intpol", int(config.getboolean("interpolate", True) and can_interpolate))

    def _read_diag_pin(self, config: ConfigWrapper) -> str | None:
        """The pin that signals a stall, if there is one."""
        if self.chip.stall is None:
            return None
        for option, field in self.chip.stall.pins.items():
            pin: str | None = config.get(option, None)
            if pin is None:
                continue
            self._stall_field = field
            self.printer.lookup_object("pins").register_chip(self._chip_name, self)
            return pin
        return None

    def register(self) -> None:
        """Events and commands."""
        for event, handler in (
            ("klippy:mcu_identify", self._handle_identify),
            ("klippy:connect", self._handle_connect),
            ("homing:homing_move_begin", self._handle_homing_begin),
            ("homing:homing_move_end", self._handle_homing_end),
        ):
            self.printer.register_event_handler(event, handler)
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("INIT_TMC", "Initialize TMC stepper driver registers"),
            ("DUMP_TMC", "Read and display TMC stepper driver registers"),
            ("SET_TMC_FIELD", "Set a register field of a TMC driver"),
            ("SET_TMC_CURRENT", "Set the current of a TMC driver"),
        ):
            gcode.register_mux_command(name, "STEPPER", self.name, getattr(self, f"cmd_{name}"), desc=text)

    # -- start-up --

    def _handle_identify(self) -> None:
        """Before the motor is configured: the driver needs short pulses only, and can step on both edges."""
        self.stepper = self.printer.lookup_object("force_move").lookup_stepper(self.stepper_name)
        self.stepper.setup_default_pulse_duration(STEP_PULSE_S, True)

    def _handle_connect(self) -> None:
        self.values.set("dedge", int(self.stepper.get_pulse_duration()[1]))
        self._set_currents(self.run_current, self.hold_current)
        self._set_thresholds()
        self._write_all()
        if not self.link.mcu.is_fileoutput():
            enable = self.printer.lookup_object("stepper_enable").lookup_enable(self.stepper_name)
            enable.register_state_callback(self._handle_enable)

    def _threshold(self, speed: float) -> int:
        return speed_threshold(speed, self.stepper.get_step_dist(), self.microsteps, self.chip.clock_hz)

    def _set_thresholds(self) -> None:
        """StealthChop up to stealthchop_threshold, CoolStep from coolstep_threshold on.

        A written 0 allows StealthChop at no speed, but its mode is on, as with Klipper.
        """
        if self.chip.stealth_field is None:
            return
        field, on = self.chip.stealth_field
        self.values.set(field, 1 - on if self._stealth_speed is None else on)
        self.values.set("tpwmthrs", self._threshold(self._stealth_speed or 0.0))
        for name, speed in self._speeds.items():
            self.values.set(name, self._threshold(speed))

    def _set_currents(self, run_a: float, hold_a: float) -> set[str]:
        """Returns the registers concerned."""
        self.run_current, self.hold_current = run_a, hold_a
        return {self.values.set(name, value) for name, value in self.current.fields(run_a, hold_a).items()}

    def set_currents(self, run_a: float, hold_a: float) -> None:
        """From now on."""
        self.printer.lookup_object("toolhead").get_last_move_time()
        for register in sorted(self._set_currents(run_a, hold_a)):
            self._write(register)

    def _write(self, register: str) -> None:
        self.link.write(self.chip.registers[register], self.values.words.get(register, 0))

    def _read(self, register: str) -> int:
        return self.link.read(self.chip.registers[register])

    def _write_all(self) -> None:
        for register in self.chip.written:
            self._write(register)
        if "GSTAT" in self.chip.registers:  # writing ones clears what was before: above all `reset`
            self.link.write(self.chip.registers["GSTAT"], GSTAT_ALL)
        self._learn_phase()

    # -- faults --

    def _handle_enable(self, print_time: float, is_enabled: bool) -> None:
        wake = self._reactor.monotonic() + CHECK_PERIOD_S if is_enabled else self._reactor.NEVER
        if not is_enabled:
            self._drv_status = self._temp_c = None
        # called while steps are worked out: the timer itself asks the driver
        self._reactor.update_timer(self._check_timer, wake)

    def _check_faults(self, eventtime: float) -> float:
        """Timer: stop the printer if the driver has lost its settings or switched off."""
        try:
            status = self._read("DRV_STATUS")
            self._drv_status = self.values.parts("DRV_STATUS", status)
            if "ADC_TEMP" in self.chip.registers:
                self._temp_c = adc_temp_c(self.chip.fields["adc_temp"].extract(self._read("ADC_TEMP")))
            if "reset" in self.chip.fields and self.chip.fields["reset"].extract(self._read("GSTAT")):
                raise self.printer.command_error(
                    f"The driver of '{self.stepper_name}' has lost its settings: it was without power for a moment"
                )
            for name, text in FAULTS.items():
                if name in self.chip.fields and self.chip.fields[name].extract(status):
                    raise self.printer.command_error(f"The driver of '{self.stepper_name}' reports: {text}")
        except self.printer.command_error as e:
            self.printer.invoke_shutdown(str(e))
            return self._reactor.NEVER
        hot = bool(self.chip.fields["otpw"].extract(status))
        if hot and not self._is_hot:
            logging.warning("The driver of '%s' is close to switching off for heat", self.stepper_name)
        self._is_hot = hot
        return self._reactor.monotonic() + CHECK_PERIOD_S

    # -- the motor's phase --

    def get_phase_offset(self) -> tuple[int | None, int]:
        """(phase at position 0 of the step count, phases): for endstop_phase."""
        return self._phase_offset, 4 * self.microsteps

    def _learn_phase(self) -> None:
        """MSCNT beside the count of steps; the motor must rest."""
        if self.link.mcu.is_fileoutput():
            return
        count = self.chip.fields["mscnt"].extract(self._read("MSCNT"))
        if self.stepper.get_dir_inverted()[0]:
            count = PHASES_PER_CYCLE - 1 - count
        phases = 4 * self.microsteps
        phase = count * phases // PHASES_PER_CYCLE
        self._phase_offset = (phase - self.stepper.get_mcu_position()) % phases
        logging.info("Driver of '%s': phase offset %d of %d", self.stepper_name, self._phase_offset, phases)

    # -- StallGuard as an endstop --

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for `tmcXXXX_STEPPER:virtual_endstop`."""
        pins = self.printer.lookup_object("pins")
        if pin_type != "endstop" or pin_params["pin"] != "virtual_endstop":
            raise pins.error(f"{self._chip_name} has one pin only, virtual_endstop, which is an endstop")
        if pin_params["invert"] or pin_params["pullup"]:
            raise pins.error(
                f"Can not pullup or invert {self._chip_name}:virtual_endstop; do so with the diag pin"
            )
        if self._endstop is None:
            self._endstop = pins.setup_pin("endstop", self._diag_pin)
        return self._endstop

    def _handle_homing_begin(self, hmove: Any) -> None:
        if self.printer.lookup_object("endstop_phase", None) is not None:
            self.printer.lookup_object("toolhead").wait_moves()
            self._learn_phase()
        if self._endstop is None or self._endstop not in hmove.get_mcu_endstops():
            return
        stall = self.chip.stall
        assert stall is not None
        is_quiet = stall.quiet_threshold and self.values.get(stall.quiet_threshold)
        fields = dict(stall.quiet if is_quiet else stall.homing)
        if self._stall_field:
            fields[self._stall_field] = 1
        self._saved = {name: self.values.get(name) for name in fields}
        self._change(fields)

    def _handle_homing_end(self, hmove: Any) -> None:
        if self._saved and self._endstop in hmove.get_mcu_endstops():
            saved, self._saved = self._saved, {}
            self._change(saved)

    def _change(self, settings: dict[str, int]) -> None:
        for name, value in settings.items():
            self._write(self.values.set(name, value))

    # -- status and commands --

    def get_status(self, eventtime: float) -> dict[str, Any]:
        phase, _phases = self.get_phase_offset()
        return {
            "mcu_phase_offset": phase,
            "phase_offset_position": None
            if phase is None or self.stepper is None
            else phase * self.stepper.get_step_dist(),
            "run_current": self.run_current,
            "hold_current": self.hold_current,
            "drv_status": self._drv_status,
            "temperature": self._temp_c,
        }

    def cmd_INIT_TMC(self, gcmd: GCodeCommand) -> None:
        """INIT_TMC STEPPER=<name>."""
        self.printer.lookup_object("toolhead").wait_moves()
        self._write_all()

    def cmd_DUMP_TMC(self, gcmd: GCodeCommand) -> None:
        """DUMP_TMC STEPPER=<name> [REGISTER=<name>]."""
        wanted, chip = gcmd.get("REGISTER", None), self.chip
        self.printer.lookup_object("toolhead").get_last_move_time()
        if wanted is not None:
            register = wanted.upper()
            if register not in chip.registers:
                raise gcmd.error(f"Unknown register name '{wanted}' (known: {', '.join(chip.registers)})")
            is_kept = register in chip.write_only
            word = self.values.words.get(register, 0) if is_kept else self._read(register)
            gcmd.respond_info(self.values.describe(register, word))
            return
        lines = ["========== Write-only registers =========="]
        lines += [
            self.values.describe(r, self.values.words.get(r, 0)) for r in chip.written if r in chip.write_only
        ]
        lines.append("========== Queried registers ==========")
        lines += [self.values.describe(r, self._read(r)) for r in chip.readable]
        gcmd.respond_info("\n".join(lines))

    def cmd_SET_TMC_FIELD(self, gcmd: GCodeCommand) -> None:
        """SET_TMC_FIELD STEPPER= FIELD= VALUE=<number> | VELOCITY=<mm/s>."""
        name = gcmd.get("FIELD").lower()
        fields = self.chip.fields
        if name not in fields or fields[name].register not in self.chip.written:
            known = ", ".join(n for n, field in fields.items() if field.register in self.chip.written)
            raise gcmd.error(f"Unknown field name '{name}' (known: {known})")
        value = gcmd.get_int("VALUE", None)
        speed = gcmd.get_float("VELOCITY", None, minval=0.0)
        if (value is None) == (speed is None):
            raise gcmd.error("Specify either FIELD value or velocity, not both or none")
        if speed is not None:
            if name not in SPEED_FIELDS:
                raise gcmd.error(f"VELOCITY is for the fields {', '.join(SPEED_FIELDS)}, not for {name}")
            value = self._threshold(speed)
        assert value is not None
        half = 1 << fields[name].width - 1
        if name in SIGNED and -half <= value < half:
            value %= 2 * half
        self.printer.lookup_object("toolhead").wait_moves()
        try:
            register = self.values.set(name, value)
        except ValueError as e:
            raise gcmd.error(str(e)) from None
        self._write(register)

    def cmd_SET_TMC_CURRENT(self, gcmd: GCodeCommand) -> None:
        """SET_TMC_CURRENT STEPPER= [CURRENT=<A>] [HOLDCURRENT=<A>]."""
        largest = self.current.largest_a
        run = gcmd.get_float("CURRENT", None, above=0.0, maxval=largest)
        hold = gcmd.get_float("HOLDCURRENT", None, above=0.0, maxval=largest)
        if run is not None or hold is not None:
            self.set_currents(run or self.run_current, hold or self.hold_current)
        gcmd.respond_info(f"Run Current: {self.run_current:0.2f}A Hold Current: {self.hold_current:0.2f}A")
