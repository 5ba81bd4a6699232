"""The conventional hotend and the heated bed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pure_harness import Load


def decoded_c(code: float, pullup_ohm: float = 4700, top: float = 4095) -> float:
    """Temperature from an ADC code by the beta formula, written from the datasheet side."""
    ohm = pullup_ohm * code / (top - code)
    return 1 / (1 / 298.15 + math.log(ohm / 100e3) / 3950) - 273.15


@pytest.mark.parametrize("temp_c", [25, 60, 110, 220, 280])
def test_thermistor_code_decodes_to_the_sensor_temperature(temp_c):
    """4096 readings average the quantisation away; the ADC's share is then below 0.2 degC up to 280 degC."""
    load = Load("hotend", start_c=temp_c)
    assert decoded_c(load.sample(4096).mean()) == pytest.approx(temp_c, abs=0.2)


def test_hotend_heats_at_its_power_over_its_capacity():
    """40 W into 17 J/K is 2.35 K/s less losses; after the cartridge's 4 s lag, at 100 degC, 34.5 W of 40 are left."""
    load = Load("hotend")
    load.duty(1.0)
    while load.read().body_c < 100:
        load.advance(0.01)
    load.advance(1.0)
    before_c = load.read().body_c
    load.advance(1.0)
    assert load.read().body_c - before_c == pytest.approx((40 - 0.0705 * 80) / 17, rel=0.03)


def test_bed_reaches_60_degrees_in_a_few_minutes_and_could_hold_110():
    """200 W on 520 J/K: 110 s by capacity alone; 110 degC needs 1.2 W/K x 87 K = 105 W."""
    load = Load("bed")
    load.duty(1.0)
    seconds = 0.0
    while load.read().sensor_c < 60:
        load.advance(0.5)
        seconds += 0.5
    assert 90 < seconds < 180
    load.advance(3600)
    assert load.read().body_c > 150


def test_sensor_lags_the_body():
    load = Load("hotend", start_c=200)
    load.advance(60)
    before_c = load.read().body_c
    load.advance(0.1)
    out = load.read()
    rate = (out.body_c - before_c) / 0.1
    assert out.sensor_c - out.body_c == pytest.approx(-rate * 1.5, rel=0.02)


def test_extrusion_and_fan_take_heat():
    """5 mm^3/s of filament from 25 to 220 degC is 10.5 mW/K x 195 K x (1 - exp(-60/10.5)) = 2.0 W."""
    rates = {}
    for key, inputs in {"still": {}, "melt": {"flow_mm3_s": 5.0}, "fan": {"fan": 1.0}}.items():
        load = Load("hotend", start_c=220)
        load.inputs(**inputs)
        load.advance(1.0)
        before_c = load.read().body_c
        load.advance(1.0)
        rates[key] = before_c - load.read().body_c
    assert (rates["melt"] - rates["still"]) * 17 == pytest.approx(2.0, rel=0.15)
    assert (rates["fan"] - rates["still"]) * 17 == pytest.approx(0.03 * 195, rel=0.15)


@pytest.mark.parametrize(("fault", "code"), [(1, 4095), (2, 0)])
def test_sensor_faults_sit_at_a_rail(fault, code):
    load = Load("bed", start_c=60)
    load.set_param("fault", fault)
    assert abs(float(np.median(load.sample(101))) - code) <= 1


def test_heater_faults_break_the_link_between_duty_and_heat():
    broken, stuck = Load("hotend", fault=3), Load("hotend", fault=4)
    broken.duty(1.0)
    for load in (broken, stuck):
        load.advance(10)
    assert broken.read().body_c == pytest.approx(22.5, abs=0.01)
    assert stuck.read().body_c > 35


def test_result_does_not_depend_on_the_callers_step():
    ends = []
    for step_s in (1e-3, 0.25):
        load = Load("hotend")
        load.duty(0.7)
        for _ in range(round(60 / step_s)):
            load.advance(step_s)
        ends.append(load.read().body_c)
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


def test_table_of_parameters_is_sound():
    for row in Load("bed").params():
        assert row.doc and row.min <= row.hotend <= row.max and row.min <= row.bed <= row.max, row.name
