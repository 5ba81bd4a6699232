"""[tmc2209 STEPPER]: a stepper driver on a single-wire UART, with StallGuard as an endstop.

At start-up all registers are written. `tmc2209_STEPPER:virtual_endstop` is a pin for endstop_pin: while homing, the
driver works in StealthChop at all speeds and pulls DIAG when SG_RESULT falls to 2 * SGTHRS: the motor has stalled.
"""

from __future__ import annotations

import logging
from typing import Any

from . import tmc_uart
from .tmc_registers import (
    TSTEP_MAX,
    Fields,
    current_bits,
    largest_current_a,
    microstep_bits,
    scale_current_a,
    speed_threshold,
    table,
)

REGISTERS = {
    "GCONF": 0x00, "GSTAT": 0x01, "IFCNT": 0x02, "SLAVECONF": 0x03, "IOIN": 0x06, "IHOLD_IRUN": 0x10,
    "TPOWERDOWN": 0x11, "TSTEP": 0x12, "TPWMTHRS": 0x13, "TCOOLTHRS": 0x14, "SGTHRS": 0x40, "SG_RESULT": 0x41,
    "COOLCONF": 0x42, "MSCNT": 0x6A, "MSCURACT": 0x6B, "CHOPCONF": 0x6C, "DRV_STATUS": 0x6F, "PWMCONF": 0x70,
    "PWM_SCALE": 0x71,
}  # fmt: skip
READABLE = (
    "GCONF", "GSTAT", "IFCNT", "IOIN", "TSTEP", "SG_RESULT", "MSCNT", "MSCURACT", "CHOPCONF", "DRV_STATUS", "PWMCONF",
    "PWM_SCALE",
)  # fmt: skip
FIELDS = table("""
    GCONF: i_scale_analog 0, internal_rsense 1, en_spreadcycle 2, shaft 3, index_otpw 4, index_step 5, pdn_disable 6, \
mstep_reg_select 7, multistep_filt 8, test_mode 9
    GSTAT: reset 0, drv_err 1, uv_cp 2
    IFCNT: ifcnt 0 8
    SLAVECONF: senddelay 8 4
    IOIN: enn 0, ms1 2, ms2 3, diag 4, pdn_uart 6, step 7, spread_en 8, dir 9, version 24 8
    IHOLD_IRUN: ihold 0 5, irun 8 5, iholddelay 16 4
    TPOWERDOWN: tpowerdown 0 8
    TSTEP: tstep 0 20
    TPWMTHRS: tpwmthrs 0 20
    TCOOLTHRS: tcoolthrs 0 20
    SGTHRS: sgthrs 0 8
    SG_RESULT: sg_result 0 10
    COOLCONF: semin 0 4, seup 5 2, semax 8 4, sedn 13 2, seimin 15
    MSCNT: mscnt 0 10
    MSCURACT: cur_a 0 9, cur_b 16 9
    CHOPCONF: toff 0 4, hstrt 4 3, hend 7 4, tbl 15 2, vsense 17, mres 24 4, intpol 28, dedge 29, diss2g 30, diss2vs 31
    DRV_STATUS: otpw 0, ot 1, s2ga 2, s2gb 3, s2vsa 4, s2vsb 5, ola 6, olb 7, t120 8, t143 9, t150 10, t157 11, \
cs_actual 16 5, stealth 30, stst 31
    PWMCONF: pwm_ofs 0 8, pwm_grad 8 8, pwm_freq 16 2, pwm_autoscale 18, pwm_autograd 19, freewheel 20 2, \
pwm_reg 24 4, pwm_lim 28 4
    PWM_SCALE: pwm_scale_sum 0 8, pwm_scale_auto 16 9
""")
# Options driver_NAME and their defaults (those of the documentation).
DRIVER_OPTIONS = {
    "multistep_filt": 1, "iholddelay": 8, "tpowerdown": 20, "tbl": 2, "toff": 3, "hend": 0, "hstrt": 5,
    "pwm_autograd": 1, "pwm_autoscale": 1, "pwm_lim": 12, "pwm_reg": 8, "pwm_freq": 1, "pwm_grad": 14, "pwm_ofs": 36,
    "freewheel": 0, "sgthrs": 0, "semin": 0, "seup": 0, "semax": 0, "sedn": 0, "seimin": 0,
}  # fmt: skip
FLAGS = ("multistep_filt", "pwm_autograd", "pwm_autoscale")
WRITTEN = (
    "SLAVECONF", "GCONF", "IHOLD_IRUN", "TPOWERDOWN", "TPWMTHRS", "TCOOLTHRS", "SGTHRS", "COOLCONF", "PWMCONF",
    "CHOPCONF",
)  # fmt: skip
DEFAULT_SENSE_OHM = 0.110
STEP_PULSE_S = 0.000000100
PHASES_PER_CYCLE = 1024  # of MSCNT
# With several drivers on a wire the answers must not come at once (datasheet 5.1, SLAVECONF).
SEND_DELAY = 2
# While the motor is on, the driver is asked for faults this often.
CHECK_PERIOD_S = 1.0
FAULTS = {
    "ot": "it is too hot and has switched off",
    "s2ga": "short of coil A to ground",
    "s2gb": "short of coil B to ground",
    "s2vsa": "short of coil A to the supply",
    "s2vsb": "short of coil B to the supply",
}


class TMC2209:
    """Printer object 'tmc2209 STEPPER'."""

    def __init__(self, config: Any) -> None:
        self.printer = config.get_printer()
        self.stepper_name = config.get_name().split(None, 1)[-1]
        self.name = self.stepper_name.split()[-1]
        self.link = tmc_uart.RegisterLink(config)
        self.values = Fields(FIELDS)
        self.stepper: Any = None
        self.sense_ohm = config.getfloat("sense_resistor", DEFAULT_SENSE_OHM, above=0.0)
        largest = largest_current_a(self.sense_ohm)
        self.run_current = config.getfloat("run_current", above=0.0, maxval=largest)
        self.hold_current = config.getfloat("hold_current", self.run_current, above=0.0, maxval=largest)
        self._stealth_speed = config.getfloat("stealthchop_threshold", 0.0, minval=0.0)
        self._cool_speed = config.getfloat("coolstep_threshold", None, minval=0.0)
        self._read_driver_options(config)
        self._read_microsteps(config)
        self._phase_offset: int | None = None
        self._saved: dict[str, int] = {}
        self._endstop: Any = None
        self._is_hot = False
        self._reactor = self.printer.get_reactor()
        self._check_timer = self._reactor.register_timer(self._check_faults)
        self._diag_pin = config.get("diag_pin", None)
        self._chip_name = f"tmc2209_{self.name}"
        if self._diag_pin is not None:
            self.printer.lookup_object("pins").register_chip(self._chip_name, self)

    def _read_driver_options(self, config: Any) -> None:
        self.values.set("pdn_disable", 1)  # the UART's pin is not the power-down pin
        self.values.set("mstep_reg_select", 1)  # microsteps from the register, not from MS1 and MS2
        self.values.set("senddelay", SEND_DELAY)
        for name, default in DRIVER_OPTIONS.items():
            option = f"driver_{name}"
            if name in FLAGS:
                value = int(config.getboolean(option, bool(default)))
            else:
                value = config.getint(option, default, minval=0, maxval=(1 << FIELDS[name].width) - 1)
            self.values.set(name, value)

    def _read_microsteps(self, config: Any) -> None:
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
        self.values.set("intpol", int(config.getboolean("interpolate", True)))

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
        if not self.link.wire.mcu.is_fileoutput():
            enable = self.printer.lookup_object("stepper_enable").lookup_enable(self.stepper_name)
            enable.register_state_callback(self._handle_enable)

    def _threshold(self, speed: float) -> int:
        return speed_threshold(speed, self.stepper.get_step_dist(), self.microsteps)

    def _set_thresholds(self) -> None:
        """StealthChop up to stealthchop_threshold (0: never), CoolStep from coolstep_threshold on."""
        self.values.set("en_spreadcycle", int(not self._stealth_speed))
        self.values.set("tpwmthrs", self._threshold(self._stealth_speed))
        if self._cool_speed is not None:
            self.values.set("tcoolthrs", self._threshold(self._cool_speed))

    def _set_currents(self, run_a: float, hold_a: float) -> None:
        vsense, run = current_bits(run_a, self.sense_ohm)
        full_a = scale_current_a(vsense, 31, self.sense_ohm)
        hold = min(31, max(0, round(min(hold_a, run_a) / full_a * 32) - 1))
        self.run_current, self.hold_current = run_a, hold_a
        for name, value in (("vsense", vsense), ("irun", run), ("ihold", hold)):
            self.values.set(name, value)

    def _write(self, register: str) -> None:
        self.link.write(REGISTERS[register], self.values.words.get(register, 0))

    def _read(self, register: str) -> int:
        return self.link.read(REGISTERS[register])

    def _write_all(self) -> None:
        for register in WRITTEN:
            self._write(register)
        self.link.write(REGISTERS["GSTAT"], 7)  # writing ones clears what was before: above all `reset`
        self._learn_phase()

    # -- faults --

    def _handle_enable(self, print_time: float, is_enabled: bool) -> None:
        wake = self._reactor.monotonic() + CHECK_PERIOD_S if is_enabled else self._reactor.NEVER
        # called while steps are worked out: the timer itself asks the driver
        self._reactor.update_timer(self._check_timer, wake)

    def _check_faults(self, eventtime: float) -> float:
        """Timer: stop the printer if the driver has lost its settings or switched off."""
        try:
            status = self._read("DRV_STATUS")
            if FIELDS["reset"].extract(self._read("GSTAT")):
                raise self.printer.command_error(
                    f"The driver of '{self.stepper_name}' has lost its settings: it was without power for a moment"
                )
            for name, text in FAULTS.items():
                if FIELDS[name].extract(status):
                    raise self.printer.command_error(f"The driver of '{self.stepper_name}' reports: {text}")
        except self.printer.command_error as e:
            self.printer.invoke_shutdown(str(e))
            return self._reactor.NEVER
        hot = bool(FIELDS["otpw"].extract(status))
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
        if self.link.wire.mcu.is_fileoutput():
            return
        count = FIELDS["mscnt"].extract(self._read("MSCNT"))
        if self.stepper.get_dir_inverted()[0]:
            count = PHASES_PER_CYCLE - 1 - count
        phases = 4 * self.microsteps
        phase = count * phases // PHASES_PER_CYCLE
        self._phase_offset = (phase - self.stepper.get_mcu_position()) % phases
        logging.info("Driver of '%s': phase offset %d of %d", self.stepper_name, self._phase_offset, phases)

    # -- StallGuard as an endstop --

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for `tmc2209_STEPPER:virtual_endstop`."""
        pins = self.printer.lookup_object("pins")
        if pin_type != "endstop" or pin_params["pin"] != "virtual_endstop":
            raise pins.error(f"{self._chip_name} has one pin only, virtual_endstop, which is an endstop")
        if pin_params["invert"] or pin_params["pullup"]:
            raise pins.error(
                f"Can not pullup or invert {self._chip_name}:virtual_endstop; do so with diag_pin"
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
        self._saved = {name: self.values.get(name) for name in ("en_spreadcycle", "tpwmthrs", "tcoolthrs")}
        self._change({"en_spreadcycle": 0, "tpwmthrs": 0, "tcoolthrs": TSTEP_MAX})

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
        }

    def cmd_INIT_TMC(self, gcmd: Any) -> None:
        """INIT_TMC STEPPER=<name>."""
        self.printer.lookup_object("toolhead").wait_moves()
        self._write_all()

    def cmd_DUMP_TMC(self, gcmd: Any) -> None:
        """DUMP_TMC STEPPER=<name> [REGISTER=<name>]."""
        wanted = gcmd.get("REGISTER", None)
        self.printer.lookup_object("toolhead").get_last_move_time()
        if wanted is not None:
            register = wanted.upper()
            if register not in REGISTERS:
                raise gcmd.error(f"Unknown register name '{wanted}' (known: {', '.join(REGISTERS)})")
            word = self._read(register) if register in READABLE else self.values.words.get(register, 0)
            gcmd.respond_info(self.values.describe(register, word))
            return
        lines = ["========== Write-only registers =========="]
        lines += [self.values.describe(r, self.values.words.get(r, 0)) for r in WRITTEN if r not in READABLE]
        lines.append("========== Queried registers ==========")
        lines += [self.values.describe(r, self._read(r)) for r in READABLE]
        gcmd.respond_info("\n".join(lines))

    def cmd_SET_TMC_FIELD(self, gcmd: Any) -> None:
        """SET_TMC_FIELD STEPPER= FIELD= VALUE=<number> | VELOCITY=<mm/s>."""
        name = gcmd.get("FIELD").lower()
        if name not in FIELDS or FIELDS[name].register not in WRITTEN:
            known = ", ".join(n for n, field in FIELDS.items() if field.register in WRITTEN)
            raise gcmd.error(f"Unknown field name '{name}' (known: {known})")
        value = gcmd.get_int("VALUE", None)
        speed = gcmd.get_float("VELOCITY", None, minval=0.0)
        if (value is None) == (speed is None):
            raise gcmd.error("Specify either FIELD value or velocity, not both or none")
        if speed is not None:
            if name not in ("tpwmthrs", "tcoolthrs"):
                raise gcmd.error(f"VELOCITY is for the fields tpwmthrs and tcoolthrs, not for {name}")
            value = self._threshold(speed)
        self.printer.lookup_object("toolhead").wait_moves()
        try:
            register = self.values.set(name, value if value is not None else 0)
        except ValueError as e:
            raise gcmd.error(str(e)) from None
        self._write(register)

    def cmd_SET_TMC_CURRENT(self, gcmd: Any) -> None:
        """SET_TMC_CURRENT STEPPER= [CURRENT=<A>] [HOLDCURRENT=<A>]."""
        largest = largest_current_a(self.sense_ohm)
        run = gcmd.get_float("CURRENT", None, above=0.0, maxval=largest)
        hold = gcmd.get_float("HOLDCURRENT", None, above=0.0, maxval=largest)
        if run is not None or hold is not None:
            self.printer.lookup_object("toolhead").get_last_move_time()
            self._set_currents(run or self.run_current, hold or self.hold_current)
            self._write("IHOLD_IRUN")
            self._write("CHOPCONF")
        gcmd.respond_info(f"Run Current: {self.run_current:0.2f}A Hold Current: {self.hold_current:0.2f}A")


def load_config_prefix(config: Any) -> TMC2209:
    driver = TMC2209(config)
    driver.register()
    return driver
