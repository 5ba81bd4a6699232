"""In what Trinamic's stepper drivers differ, as tables: registers, fields, options and their defaults, stalls.

Addresses and fields of all six chips were compared, bit by bit, with the vendor's headers (Analog Devices' TMC-API);
the masks found there are the data of test/unit/bus/test_tmc_vendor.py, with their commits. Not in those headers, by the
datasheet of the TMC2209 only: the widths of TCOOLTHRS, SGTHRS and SG_RESULT, and spread_en in IOIN. Not compared with a
document: which registers can only be read or written, the clocks of TMC2130, TMC5160 and TMC2240 (12 MHz of the others
is in their headers), and the values of WAVE_OPTIONS. No chip has been connected. Defaults of driver_... options are
those of the configuration reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from .registers import Field, table

MOTION = {
    "IHOLD_IRUN": 0x10, "TPOWERDOWN": 0x11, "TSTEP": 0x12, "TPWMTHRS": 0x13,
    "MSCNT": 0x6A, "MSCURACT": 0x6B, "CHOPCONF": 0x6C, "DRV_STATUS": 0x6F, "PWMCONF": 0x70, "PWM_SCALE": 0x71,
}  # fmt: skip
WAVE_REGISTERS = {f"MSLUT{n}": 0x60 + n for n in range(8)} | {"MSLUTSEL": 0x68, "MSLUTSTART": 0x69}
WAVE = (
    "\n".join(f"MSLUT{n}: mslut{n} 0 32" for n in range(8))
    + """
    MSLUTSEL: w0 0 2, w1 2 2, w2 4 2, w3 6 2, x1 8 8, x2 16 8, x3 24 8"""
)
# a quarter of a sine, as the chips have it after power-on
WAVE_OPTIONS = dict(
    zip(
        [f"mslut{n}" for n in range(8)],
        [2863314260, 1251300522, 608774441, 269500962, 4227858431, 3048961917, 1227445590, 4211234],
        strict=True,
    )
) | {"w0": 2, "w1": 1, "w2": 1, "w3": 1, "x1": 128, "x2": 255, "x3": 255, "start_sin": 0, "start_sin90": 247}
COMMON = """
    TSTEP: tstep 0 20
    TPWMTHRS: tpwmthrs 0 20
    TPOWERDOWN: tpowerdown 0 8
    MSCNT: mscnt 0 10"""
SCALE2 = "\n    PWM_SCALE: pwm_scale_sum 0 8, pwm_scale_auto 16 9"
COILS = "\n    MSCURACT: cur_a 0 9, cur_b 16 9"
STEALTH2 = """
    PWMCONF: pwm_ofs 0 8, pwm_grad 8 8, pwm_freq 16 2, pwm_autoscale 18, pwm_autograd 19, freewheel 20 2, \
pwm_reg 24 4, pwm_lim 28 4"""
COOL = "TCOOLTHRS: tcoolthrs 0 20\n    COOLCONF: semin 0 4, seup 5 2, semax 8 4, sedn 13 2, seimin 15"
HOLD = "\n    IHOLD_IRUN: ihold 0 5, irun 8 5, iholddelay 16 4"
UART_GCONF = """
    GCONF: i_scale_analog 0, internal_rsense 1, en_spreadcycle 2, shaft 3, index_otpw 4, index_step 5, pdn_disable 6, \
mstep_reg_select 7, multistep_filt 8, test_mode 9
    IFCNT: ifcnt 0 8
    SLAVECONF: senddelay 8 4
    CHOPCONF: toff 0 4, hstrt 4 3, hend 7 4, tbl 15 2, vsense 17, mres 24 4, intpol 28, dedge 29, diss2g 30, diss2vs 31
    DRV_STATUS: otpw 0, ot 1, s2ga 2, s2gb 3, s2vsa 4, s2vsb 5, ola 6, olb 7, t120 8, t143 9, t150 10, t157 11, \
cs_actual 16 5, stealth 30, stst 31"""
SPI_GCONF = """en_pwm_mode 2, shaft 4, diag0_error 5, diag0_otpw 6, diag0_stall 7, diag1_stall 8, diag1_index 9, \
diag1_onstate 10, diag0_pushpull 12, diag1_pushpull 13, small_hysteresis 14, stop_enable 15, direct_mode 16"""
SPI_STATUS = """sg_result 0 10, fsactive 15, cs_actual 16 5, stallguard 24, ot 25, otpw 26, s2ga 27, s2gb 28, ola 29, \
olb 30, stst 31"""
SPI_CHOP = """toff 0 4, hstrt 4 3, hend 7 4, fd3 11, disfdcc 12, chm 14, tbl 15 2, vhighfs 18, vhighchm 19, mres 24 4, \
intpol 28, dedge 29, diss2g 30"""
SPI_MORE = """
    THIGH: thigh 0 20
    COOLCONF: sgt 16 7, sfilt 24"""
UART_OPTIONS = {
    "multistep_filt": 1, "iholddelay": 8, "tpowerdown": 20, "tbl": 2, "toff": 3, "hend": 0, "hstrt": 5,
    "pwm_autograd": 1, "pwm_autoscale": 1, "pwm_lim": 12, "pwm_reg": 8, "pwm_freq": 1, "pwm_grad": 14, "pwm_ofs": 36,
    "freewheel": 0,
}  # fmt: skip
COOL_OPTIONS = {"semin": 0, "seup": 0, "semax": 0, "sedn": 0, "seimin": 0}
SPI_OPTIONS = {
    "multistep_filt": 1, "iholddelay": 6, "tpowerdown": 10, "tbl": 2, "toff": 3, "hend": 2, "hstrt": 5, "fd3": 0,
    "tpfd": 4, "chm": 0, "vhighfs": 0, "vhighchm": 0, "diss2g": 0, "diss2vs": 0, "pwm_autoscale": 1, "pwm_autograd": 1,
    "pwm_freq": 0, "freewheel": 0, "pwm_grad": 0, "pwm_ofs": 30, "pwm_reg": 4, "pwm_lim": 12, "sgt": 0, "sfilt": 0,
    **COOL_OPTIONS, **WAVE_OPTIONS,
}  # fmt: skip
SPI_CHIP = {
    "GCONF": 0x00, "GSTAT": 0x01, "IOIN": 0x04, **MOTION, "TCOOLTHRS": 0x14, "THIGH": 0x15, **WAVE_REGISTERS,
    "COOLCONF": 0x6D,
}  # fmt: skip
SIGNED = ("sgt", "offset_sin90")  # fields in two's complement
FLAGS = ("multistep_filt", "pwm_autograd", "pwm_autoscale")  # options that are True or False


@dataclass(frozen=True, slots=True)
class Stall:
    """How homing without a switch works on a chip: fields while homing, and those of the pin that signals a stall."""

    homing: Mapping[str, int]
    pins: Mapping[str, str]  # option → field that puts the stall on that pin ("": it always is)
    quiet_threshold: str = ""  # a field: if it is not 0, StallGuard works in StealthChop ...
    quiet: Mapping[str, int] = field(default_factory=dict)  # ... with these fields while homing


@dataclass(frozen=True, slots=True)
class Chip:
    """One kind of driver. `fixed`: fields that are set whatever the options say."""

    name: str
    registers: Mapping[str, int]
    write_only: tuple[str, ...]
    read_only: tuple[str, ...]
    fields: Mapping[str, Field]
    options: Mapping[str, int]
    fixed: Mapping[str, int]
    stealth_field: tuple[str, int] | None  # the field that chooses StealthChop, and its value then
    clock_hz: float
    stall: Stall | None = None
    interpolated: int = 0  # the one number of microsteps that can be interpolated; 0: all

    @property
    def written(self) -> tuple[str, ...]:
        """CHOPCONF last: it lets the current flow."""
        names = [r for r in self.registers if r not in self.read_only and r not in ("CHOPCONF", "GSTAT")]
        return (*names, "CHOPCONF")

    @property
    def readable(self) -> tuple[str, ...]:
        return tuple(r for r in self.registers if r not in self.write_only)


READ_ONLY = (
    "IFCNT",
    "IOIN",
    "TSTEP",
    "SG_RESULT",
    "MSCNT",
    "MSCURACT",
    "DRV_STATUS",
    "PWM_SCALE",
    "ADC_TEMP",
    "SG4_RESULT",
)
UART_WRITE_ONLY = ("SLAVECONF", "IHOLD_IRUN", "TPOWERDOWN", "TPWMTHRS")
GSTAT = "GSTAT: reset 0, drv_err 1, uv_cp 2"
UART_CHIP = {"SLAVECONF": 0x03, "GCONF": 0x00, "GSTAT": 0x01, "IFCNT": 0x02, "IOIN": 0x06, **MOTION}
# With several drivers on a wire the answers must not come at once (datasheet 5.1, SLAVECONF).
UART_FIXED = {"pdn_disable": 1, "mstep_reg_select": 1, "senddelay": 2}
TSTEP_MAX = 0xFFFFF
SPI_STALL = Stall(
    {"en_pwm_mode": 0, "tcoolthrs": TSTEP_MAX}, {"diag0_pin": "diag0_stall", "diag1_pin": "diag1_stall"}
)

TMC2208 = Chip(
    "tmc2208", UART_CHIP, UART_WRITE_ONLY, READ_ONLY,
    table(f"{GSTAT}{UART_GCONF}{HOLD}{COMMON}{COILS}{STEALTH2}{SCALE2}\n"
          "    IOIN: enn 0, ms1 2, ms2 3, diag 4, pdn_uart 6, step 7, sel_a 8, dir 9, version 24 8"),
    UART_OPTIONS, UART_FIXED, ("en_spreadcycle", 0), 12e6,
)  # fmt: skip
TMC2209 = Chip(
    "tmc2209", {**UART_CHIP, "TCOOLTHRS": 0x14, "SGTHRS": 0x40, "SG_RESULT": 0x41, "COOLCONF": 0x42},
    (*UART_WRITE_ONLY, "TCOOLTHRS", "SGTHRS", "COOLCONF"), READ_ONLY,
    table(f"{GSTAT}{UART_GCONF}{HOLD}{COMMON}{COILS}{STEALTH2}{SCALE2}\n"
          f"    {COOL}\n    SGTHRS: sgthrs 0 8\n    SG_RESULT: sg_result 0 10\n"
          "    IOIN: enn 0, ms1 2, ms2 3, diag 4, pdn_uart 6, step 7, spread_en 8, dir 9, version 24 8"),
    {**UART_OPTIONS, "sgthrs": 0, **COOL_OPTIONS}, UART_FIXED, ("en_spreadcycle", 0), 12e6,
    # StallGuard4 works in StealthChop
    Stall({"en_spreadcycle": 0, "tpwmthrs": 0, "tcoolthrs": TSTEP_MAX}, {"diag_pin": ""}),
)  # fmt: skip
TMC2130 = Chip(
    "tmc2130", SPI_CHIP,
    ("IHOLD_IRUN", "TPOWERDOWN", "TPWMTHRS", "TCOOLTHRS", "THIGH", *WAVE_REGISTERS, "COOLCONF", "PWMCONF"), READ_ONLY,
    table(f"{GSTAT}{HOLD}{COMMON}{COILS}\n    {COOL}{SPI_MORE}\n{WAVE}\n"
          "    MSLUTSTART: start_sin 0 8, start_sin90 16 8\n"
          f"GCONF: i_scale_analog 0, internal_rsense 1, diag1_steps_skipped 11, {SPI_GCONF}\n"
          "    IOIN: step 0, dir 1, dcen_cfg4 2, dcin_cfg5 3, drv_enn_cfg6 4, dco 5, version 24 8\n"
          f"    DRV_STATUS: {SPI_STATUS}\n    CHOPCONF: {SPI_CHOP}, rndtf 13, vsense 17, sync 20 4\n"
          "    PWMCONF: pwm_ampl 0 8, pwm_grad 8 8, pwm_freq 16 2, pwm_autoscale 18, pwm_symmetric 19, freewheel 20 2\n"
          "    PWM_SCALE: pwm_scale 0 8"),
    {"iholddelay": 8, "tpowerdown": 0, "tbl": 1, "toff": 4, "hend": 7, "hstrt": 0, "pwm_autoscale": 1, "pwm_freq": 1,
     "pwm_grad": 4, "pwm_ampl": 128, "freewheel": 0, "vhighfs": 0, "vhighchm": 0, "sgt": 0, "sfilt": 0,
     **COOL_OPTIONS, **WAVE_OPTIONS},
    {}, ("en_pwm_mode", 1), 13.2e6, SPI_STALL,
)  # fmt: skip
TMC5160 = Chip(
    "tmc5160", {**SPI_CHIP, "DRV_CONF": 0x0A, "GLOBALSCALER": 0x0B},
    ("IHOLD_IRUN", "TPOWERDOWN", "TPWMTHRS", "TCOOLTHRS", "THIGH", *WAVE_REGISTERS, "COOLCONF", "PWMCONF", "DRV_CONF",
     "GLOBALSCALER"), READ_ONLY,
    table(f"{GSTAT}{HOLD}{COMMON}{COILS}\n    {COOL}{SPI_MORE}{STEALTH2}{SCALE2}\n{WAVE}\n"
          "    MSLUTSTART: start_sin 0 8, start_sin90 16 8\n"
          f"GCONF: recalibrate 0, faststandstill 1, multistep_filt 3, diag1_steps_skipped 11, {SPI_GCONF}\n"
          "    IOIN: step 0, dir 1, dcen_cfg4 2, dcin_cfg5 3, drv_enn 4, dco_cfg6 5, sd_mode 6, swcomp_in 7, "
          f"version 24 8\n        DRV_STATUS: {SPI_STATUS}, s2vsa 12, s2vsb 13, stealth 14\n"
          f"    CHOPCONF: {SPI_CHOP}, tpfd 20 4, diss2vs 31\n    GLOBALSCALER: globalscaler 0 8\n"
          "    DRV_CONF: bbmtime 0 5, bbmclks 8 4, otselect 16 2, drvstrength 18 2, filt_isense 20 2"),
    {**SPI_OPTIONS, "drvstrength": 0, "bbmclks": 4, "bbmtime": 0, "filt_isense": 0},
    {}, ("en_pwm_mode", 1), 12e6, SPI_STALL,
)  # fmt: skip
TMC2240 = Chip(
    "tmc2240", {**SPI_CHIP, "DRV_CONF": 0x0A, "GLOBALSCALER": 0x0B, "ADC_TEMP": 0x51, "SG4_THRS": 0x74,
                "SG4_RESULT": 0x75},
    (), READ_ONLY,
    table(f"{GSTAT}, register_reset 3, vm_uvlo 4{HOLD}, irundelay 24 4{COMMON}\n"
          f"    {COOL}{SPI_MORE}{STEALTH2}, pwm_meas_sd_enable 22, pwm_dis_reg_stst 23\n{WAVE}\n"
          "    MSCURACT: cur_b 0 9, cur_a 16 9\n    PWM_SCALE: pwm_scale_sum 0 10, pwm_scale_auto 16 9\n"
          "    MSLUTSTART: start_sin 0 8, start_sin90 16 8, offset_sin90 24 8\n"
          f"GCONF: fast_standstill 1, multistep_filt 3, {SPI_GCONF}\n"
          "    IOIN: step 0, dir 1, encb 2, enca 3, drv_enn 4, encn 5, uart_en 6, comp_a 8, comp_b 9, output 12, \
ext_res_det 13, ext_clk 14, adc_err 15, silicon_rv 16 3, version 24 8\n"
          f"    DRV_STATUS: {SPI_STATUS}, s2vsa 12, s2vsb 13, stealth 14\n"
          f"    CHOPCONF: {SPI_CHOP}, tpfd 20 4, diss2vs 31\n    GLOBALSCALER: globalscaler 0 8\n"
          "    DRV_CONF: current_range 0 2, slope_control 4 2\n    ADC_TEMP: adc_temp 0 13\n"
          "    SG4_THRS: sg4_thrs 0 8, sg4_filt_en 8, sg4_angle_offset 9\n    SG4_RESULT: sg4_result 0 10"),
    {**SPI_OPTIONS, "pwm_ofs": 29, "irundelay": 4, "offset_sin90": 0, "sg4_thrs": 0, "sg4_angle_offset": 1,
     "slope_control": 0},
    {}, ("en_pwm_mode", 1), 12.5e6,
    replace(SPI_STALL, quiet_threshold="sg4_thrs",
            quiet={"en_pwm_mode": 1, "tpwmthrs": 0, "tcoolthrs": TSTEP_MAX}),
)  # fmt: skip
# On its UART it counts datagrams and waits before an answer, as the others there.
TMC2240_UART = replace(
    TMC2240, registers={**TMC2240.registers, "IFCNT": 0x02, "NODECONF": 0x03},
    fields={**TMC2240.fields, **table("IFCNT: ifcnt 0 8\nNODECONF: senddelay 8 4")}, fixed={"senddelay": 2},
)  # fmt: skip
# Registers numbered as in the vendor's header, those that can be read by RDSEL: RESPONSE0 to 2.
TMC2660 = Chip(
    "tmc2660",
    {"MSCNT": 0, "SG_RESULT": 1, "DRV_STATUS": 2, "DRVCONF": 15, "DRVCTRL": 8, "SMARTEN": 13, "SGCSCONF": 14,
     "CHOPCONF": 12},
    ("DRVCONF", "DRVCTRL", "SMARTEN", "SGCSCONF", "CHOPCONF"), READ_ONLY,
    table("MSCNT: mscnt 10 10\nSG_RESULT: sg_result 10 10\n"
          "DRV_STATUS: sg 0, ot 1, otpw 2, s2ga 3, s2gb 4, ola 5, olb 6, stst 7, se 10 5, sg_result_high 15 5\n"
          "DRVCTRL: mres 0 4, dedge 8, intpol 9\n"
          "CHOPCONF: toff 0 4, hstrt 4 3, hend 7 4, hdec 11 2, rndtf 13, chm 14, tbl 15 2\n"
          "SMARTEN: semin 0 4, seup 5 2, semax 8 4, sedn 13 2, seimin 15\n"
          "SGCSCONF: cs 0 5, sgt 8 7, sfilt 16\n"
          "DRVCONF: rdsel 4 2, vsense 6, sdoff 7, ts2g 8 2, diss2g 10, slpl 12 2, slph 14 2, tst 16"),
    {"tbl": 2, "rndtf": 0, "hdec": 0, "chm": 0, "hend": 3, "hstrt": 3, "toff": 4, **COOL_OPTIONS, "sfilt": 0, "sgt": 0,
     "slph": 0, "slpl": 0, "diss2g": 0, "ts2g": 3},
    {}, None, 15e6, interpolated=16,
)  # fmt: skip
