"""Registers and fields of the stepper drivers against the vendor's own masks, currents against a datasheet's table.

The masks are facts read from the headers of Analog Devices' TMC-API (tmc/ic/CHIP/CHIP_HW_Abstraction.h, at the commits
named below; TMC2208: CHIP_Fields.h, and 'unchecked' by its own words). Where the vendor's name of a field is another,
it is given as ours=theirs in a comment of the line. Nothing here is computed from klippy/extras/tmc/chips.py.
"""

from __future__ import annotations

import math

import pytest

from extras.tmc.chips import TMC2130, TMC2208, TMC2209, TMC2240, TMC2660, TMC5160, Chip
from extras.tmc.current import ReferenceResistor, TwoRanges

IHOLD_IRUN = "10 IHOLD_IRUN ihold 1F irun 1F00 iholddelay F0000"
TIMES = "11 TPOWERDOWN tpowerdown FF\n12 TSTEP tstep FFFFF\n13 TPWMTHRS tpwmthrs FFFFF"
COUNTER = "6A MSCNT mscnt 3FF"
CUR_A_LOW = "6B MSCURACT cur_a 1FF cur_b 1FF0000"
PWM2 = "pwm_ofs FF pwm_grad FF00 pwm_freq 30000 pwm_autoscale 40000 pwm_autograd 80000 freewheel 300000 \
pwm_reg F000000 pwm_lim F0000000"
COOL = "semin F seup 60 semax F00 sedn 6000 seimin 8000"
WAVE = "\n".join(f"{0x60 + n:X} MSLUT{n} mslut{n} FFFFFFFF" for n in range(8)) + (
    "\n68 MSLUTSEL w0 3 w1 C w2 30 w3 C0 x1 FF00 x2 FF0000 x3 FF000000"
)
START = "69 MSLUTSTART start_sin FF start_sin90 FF0000"

# TMC2209: commit 131bad3db5a12898242c1c99921d2054cfe63f6e (senddelay=SLAVECONF; no fields of SGTHRS and SG_RESULT
# there: datasheet 8 and 10 bits; spread_en is bit 8 of IOIN in the datasheet, SEL_A in the header)
UART = f"""
00 GCONF i_scale_analog 1 internal_rsense 2 en_spreadcycle 4 shaft 8 index_otpw 10 index_step 20 pdn_disable 40 \
mstep_reg_select 80 multistep_filt 100 test_mode 200
01 GSTAT reset 1 drv_err 2 uv_cp 4
02 IFCNT ifcnt FF
03 SLAVECONF senddelay F00
{IHOLD_IRUN}
{TIMES}
{COUNTER}
{CUR_A_LOW}
6C CHOPCONF toff F hstrt 70 hend 780 tbl 18000 vsense 20000 mres F000000 intpol 10000000 dedge 20000000 \
diss2g 40000000 diss2vs 80000000
6F DRV_STATUS otpw 1 ot 2 s2ga 4 s2gb 8 s2vsa 10 s2vsb 20 ola 40 olb 80 t120 100 t143 200 t150 400 t157 800 \
cs_actual 1F0000 stealth 40000000 stst 80000000
70 PWMCONF {PWM2}
71 PWM_SCALE pwm_scale_sum FF pwm_scale_auto 1FF0000"""
IOIN = "06 IOIN enn 1 ms1 4 ms2 8 diag 10 pdn_uart 40 step 80"
VENDOR_2209 = f"""{UART}
{IOIN} spread_en 100 dir 200 version FF000000
14 TCOOLTHRS
40 SGTHRS
41 SG_RESULT
42 COOLCONF {COOL}"""
# TMC2208: addresses of commit 3e3fe5b972818075e1179b23621ebee774268907, fields 339622c84a728dfdb73ed0b2e853f701d983400e
VENDOR_2208 = f"{UART}\n{IOIN} sel_a 100 dir 200 version FF000000"

SPI_GCONF = "en_pwm_mode 4 shaft 10 diag0_error 20 diag0_otpw 40 diag0_stall 80 diag1_stall 100 diag1_index 200 \
diag1_onstate 400 diag0_pushpull 1000 diag1_pushpull 2000 small_hysteresis 4000 stop_enable 8000 direct_mode 10000"
SPI_CHOP = "toff F hstrt 70 hend 780 fd3 800 disfdcc 1000 chm 4000 tbl 18000 vhighfs 40000 vhighchm 80000 \
mres F000000 intpol 10000000 dedge 20000000 diss2g 40000000"
SPI_STATUS = (
    "sg_result 3FF fsactive 8000 cs_actual 1F0000 stallguard 1000000 ot 2000000 otpw 4000000 s2ga 8000000 \
s2gb 10000000 ola 20000000 olb 40000000 stst 80000000"
)
STATUS2 = f"{SPI_STATUS} s2vsa 1000 s2vsb 2000 stealth 4000"
SPI = f"""
{TIMES}
14 TCOOLTHRS tcoolthrs FFFFF
15 THIGH thigh FFFFF
{WAVE}
{COUNTER}
6D COOLCONF {COOL} sgt 7F0000 sfilt 1000000"""
# TMC2130: commit 0890a90c0363dccfa4a0321ede54bf605d25076e (diag0_pushpull=DIAG0_INT_PUSHPULL,
# diag1_pushpull=DIAG1_POSCOMP_PUSHPULL, fd3=TFD___, inputs by the pin's use here: step=REFL_STEP ...)
VENDOR_2130 = f"""{SPI}
{START}
{CUR_A_LOW}
{IHOLD_IRUN}
00 GCONF i_scale_analog 1 internal_rsense 2 diag1_steps_skipped 800 {SPI_GCONF}
01 GSTAT reset 1 drv_err 2 uv_cp 4
04 IOIN step 1 dir 2 dcen_cfg4 4 dcin_cfg5 8 drv_enn_cfg6 10 dco 20 version FF000000
6C CHOPCONF {SPI_CHOP} rndtf 2000 vsense 20000 sync F00000
6F DRV_STATUS {SPI_STATUS}
70 PWMCONF pwm_ampl FF pwm_grad FF00 pwm_freq 30000 pwm_autoscale 40000 pwm_symmetric 80000 freewheel 300000
71 PWM_SCALE pwm_scale FF"""
# TMC5160: commit 452609a2de47e75b24ed59c5af3f5ff9c83534cd (as 2130; drv_enn=DRV_ENN_CFG6, dco_cfg6=ENC_N_DCO,
# globalscaler=GLOBAL_SCALER)
VENDOR_5160 = f"""{SPI}
{START}
{CUR_A_LOW}
{IHOLD_IRUN}
00 GCONF recalibrate 1 faststandstill 2 multistep_filt 8 diag1_steps_skipped 800 {SPI_GCONF}
01 GSTAT reset 1 drv_err 2 uv_cp 4
04 IOIN step 1 dir 2 dcen_cfg4 4 dcin_cfg5 8 drv_enn 10 dco_cfg6 20 sd_mode 40 swcomp_in 80 version FF000000
0A DRV_CONF bbmtime 1F bbmclks F00 otselect 30000 drvstrength C0000 filt_isense 300000
0B GLOBALSCALER globalscaler FF
6C CHOPCONF {SPI_CHOP} tpfd F00000 diss2vs 80000000
6F DRV_STATUS {STATUS2}
70 PWMCONF {PWM2}
71 PWM_SCALE pwm_scale_sum FF pwm_scale_auto 1FF0000"""
# TMC2240: commit 478fd5b9b2f76eda3b030df5771b203859029fdb (hstrt=HSTRT_TFD210, hend=HEND_OFFSET,
# sg4_angle_offset=SG_ANGLE_OFFSET)
VENDOR_2240 = f"""{SPI}
{START} offset_sin90 FF000000
6B MSCURACT cur_b 1FF cur_a 1FF0000
{IHOLD_IRUN} irundelay F000000
00 GCONF fast_standstill 2 multistep_filt 8 {SPI_GCONF}
01 GSTAT reset 1 drv_err 2 uv_cp 4 register_reset 8 vm_uvlo 10
04 IOIN step 1 dir 2 encb 4 enca 8 drv_enn 10 encn 20 uart_en 40 comp_a 100 comp_b 200 output 1000 \
ext_res_det 2000 ext_clk 4000 adc_err 8000 silicon_rv 70000 version FF000000
0A DRV_CONF current_range 3 slope_control 30
0B GLOBALSCALER globalscaler FF
6C CHOPCONF {SPI_CHOP} tpfd F00000 diss2vs 80000000
6F DRV_STATUS {STATUS2}
70 PWMCONF {PWM2} pwm_meas_sd_enable 400000 pwm_dis_reg_stst 800000
71 PWM_SCALE pwm_scale_sum 3FF pwm_scale_auto 1FF0000
51 ADC_TEMP adc_temp 1FFF
74 SG4_THRS sg4_thrs FF sg4_filt_en 100 sg4_angle_offset 200
75 SG4_RESULT sg4_result 3FF"""
# TMC2660: commit 6d8e942b306501c32966550e0e6147aeea9fa809 (MSCNT=RESPONSE0 with mscnt=MSTEP, SG_RESULT=RESPONSE1 with
# sg_result=SG2, DRV_STATUS=RESPONSE2 with sg_result_high=SGU; its lowest byte by the datasheet rev. 1.05, chapter 6.10)
VENDOR_2660 = """
0 MSCNT mscnt FFC00
1 SG_RESULT sg_result FFC00
2 DRV_STATUS sg_result_high F8000 se 7C00 sg 1 ot 2 otpw 4 s2ga 8 s2gb 10 ola 20 olb 40 stst 80
8 DRVCTRL mres F dedge 100 intpol 200
C CHOPCONF toff F hstrt 70 hend 780 hdec 1800 rndtf 2000 chm 4000 tbl 18000
D SMARTEN semin F seup 60 semax F00 sedn 6000 seimin 8000
E SGCSCONF cs 1F sgt 7F00 sfilt 10000
F DRVCONF rdsel 30 vsense 40 sdoff 80 ts2g 300 diss2g 400 slpl 3000 slph C000 tst 10000"""
VENDOR = [
    (TMC2208, VENDOR_2208), (TMC2209, VENDOR_2209), (TMC2130, VENDOR_2130), (TMC5160, VENDOR_5160),
    (TMC2240, VENDOR_2240), (TMC2660, VENDOR_2660),
]  # fmt: skip
# not in the header: by the datasheet (TCOOLTHRS 20 bits, SGTHRS 8, SG_RESULT 10)
ELSEWHERE = {("tmc2209", "tcoolthrs"), ("tmc2209", "sgthrs"), ("tmc2209", "sg_result")}


def parse(text: str) -> tuple[dict[str, int], dict[str, tuple[str, int]]]:
    """Addresses by register, and (register, mask) by field."""
    addresses, masks = {}, {}
    for line in text.strip().splitlines():
        address, register, *rest = line.split()
        addresses[register] = int(address, 16)
        for name, mask in zip(rest[::2], rest[1::2], strict=True):
            masks[name] = (register, int(mask, 16))
    return addresses, masks


@pytest.mark.parametrize(("chip", "text"), VENDOR, ids=lambda value: getattr(value, "name", ""))
def test_every_register_and_field_is_where_the_vendor_has_it(chip: Chip, text: str) -> None:
    addresses, masks = parse(text)
    assert dict(chip.registers) == addresses
    ours = {name: (f.register, ((1 << f.width) - 1) << f.low) for name, f in chip.fields.items()}
    unchecked = set(ours) - set(masks)
    assert {(chip.name, name) for name in unchecked} <= ELSEWHERE
    assert {name: ours[name] for name in masks} == masks


# TMC2209 datasheet rev. 1.03, chapter 8: sense resistor, ohm, and rms current, A, at IRUN = 31 and vsense = 0
SENSE_TABLE = [
    (1.00, 0.23), (0.82, 0.27), (0.75, 0.30), (0.68, 0.33), (0.50, 0.44), (0.47, 0.47), (0.39, 0.56), (0.33, 0.66),
    (0.27, 0.79), (0.22, 0.96), (0.18, 1.15), (0.15, 1.35), (0.12, 1.64), (0.10, 1.92),
]  # fmt: skip


@pytest.mark.parametrize(("sense_ohm", "rms_a"), SENSE_TABLE)
def test_full_current_is_that_of_the_datasheets_table(sense_ohm: float, rms_a: float) -> None:
    # the table has two decimals; the last one is not always the nearest
    assert TwoRanges(sense_ohm, (0.325, 0.180)).largest_a == pytest.approx(rms_a, abs=0.01)


def test_full_current_of_the_2240_is_3_a_peak() -> None:
    # its datasheet's first page: 2.1 A rms, a sine of 3 A peak; 12 kohm is the smallest resistor allowed
    largest_a = ReferenceResistor(12000.0).largest_a
    assert largest_a * math.sqrt(2.0) == pytest.approx(3.0)
    assert largest_a == pytest.approx(2.1, abs=0.05)
