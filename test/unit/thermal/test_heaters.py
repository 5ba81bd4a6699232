"""Heaters as G-code and status see them: targets, waiting, limits, PWM, the watch."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from configtext import ConfigError
from extras import heaters, verify_heater
from extras.heater.ordinary import HeaterSettings
from heater_fakes import CommandError, FakeCommand, FakePrinter
from nozzle_rig import machine


def report(printer: FakePrinter, pin: str, temp: float, time_s: float, curve: Any) -> None:
    callback = printer.pins[pin].callback
    assert callback is not None
    callback(time_s, curve.calc_adc(temp))


def bed_with(control: str = "pid") -> tuple[FakePrinter, Any]:
    printer = machine(control)
    bed = printer.load("heater_bed")
    return printer, bed.heater


def warm(
    printer: FakePrinter, heater: Any, temp: float, start_s: float = 100.0, seconds: float = 12.0
) -> float:
    """Readings of a constant temperature until smoothing has settled; the time after them."""
    time_s = start_s
    while time_s < start_s + seconds:
        report(printer, "PE1", temp, time_s, heater.sensor.curve)
        time_s += 0.3
    printer.reactor.now_s = time_s
    return time_s


def test_temperature_follows_the_sensor_and_status_has_the_usual_fields() -> None:
    printer, heater = bed_with()
    time_s = warm(printer, heater, 60.0)
    assert heater.get_temp(time_s) == (pytest.approx(60.0, abs=0.1), 0.0)
    assert heater.get_status(time_s) == {
        "temperature": pytest.approx(60.0, abs=0.1),
        "target": 0.0,
        "power": 0.0,
    }
    assert heater.get_temp(time_s + 6.0)[0] == 0.0  # readings have stopped


def test_target_out_of_range_is_refused_in_plain_words() -> None:
    _, heater = bed_with()
    with pytest.raises(CommandError, match=r"Requested temperature \(130\.0\) out of range \(0\.0:120\.0\)"):
        heater.set_temp(130.0)
    assert heater.get_temp(0.0)[1] == 0.0
    heater.alter_target(130.0)
    assert heater.get_temp(0.0)[1] == 120.0


class Probe:
    """A sensor whose readings the test makes up."""

    def setup_minmax(self, min_temp: float, max_temp: float) -> None: ...

    def setup_callback(self, callback: Any) -> None:
        self.read = callback


def extruding(min_extrude_c: float, **start_args: Any) -> tuple[Any, Probe]:
    printer, probe = machine(**start_args), Probe()
    settings = HeaterSettings("extruder", -50.0, 300.0, 1.0, 1.0, min_extrude_c, 0.1)
    law, pwm = SimpleNamespace(decide=lambda *a: 0.0), SimpleNamespace(set_pwm=lambda *a: None)
    return heaters.Heater(printer, settings, probe, law, pwm), probe


def test_filament_is_pushed_from_the_smoothed_minimum_on_and_not_below() -> None:
    heater, probe = extruding(170.0)
    assert not heater.can_extrude  # nothing was read yet
    for time_s, temp_c, may in ((10.0, 169.9, False), (11.0, 170.0, True), (12.0, 169.9, False)):
        probe.read(time_s, temp_c)  # smoothed over a second: as read
        assert heater.can_extrude is may
    probe.read(12.5, 170.0)
    assert not heater.can_extrude  # half way there
    probe.read(13.5, 170.0)
    assert heater.can_extrude


@pytest.mark.parametrize(("min_extrude_c", "may"), [(0.0, True), (-10.0, True), (0.1, False)])
def test_before_the_first_reading_filament_is_pushed_only_where_no_heat_is_asked_for(
    min_extrude_c: float, may: bool
) -> None:
    assert extruding(min_extrude_c)[0].can_extrude is may


def test_commands_written_to_a_file_extrude_cold() -> None:
    heater, probe = extruding(170.0, debugoutput="out")
    assert heater.can_extrude
    probe.read(10.0, 20.0)
    assert heater.can_extrude


def test_pin_is_reported_its_limits() -> None:
    printer, _ = bed_with()
    assert (printer.pins["PE0"].max_duration, printer.pins["PE0"].cycle_time) == (3.0, 0.1)
    limits = printer.pins["PE1"].sample
    assert 0.0 < limits["minval"] < limits["maxval"] < 1.0
    assert limits["range_check_count"] == 4


def test_pwm_follows_the_sample_by_a_fixed_delay_and_is_refreshed_within_max_duration() -> None:
    printer, heater = bed_with()
    heater.set_temp(100.0)
    warm(printer, heater, 20.0)
    sent = printer.pins["PE0"].sent
    assert sent[0][1] == 1.0
    # sample + 8 ms of sampling + one report + the fixed delay
    assert sent[0][0] == pytest.approx(100.0 + 0.008 + 0.3 + 0.3)
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(sent)]
    assert 2.0 <= max(gaps) < 3.0


def test_off_means_off_with_the_next_reading() -> None:
    printer, heater = bed_with()
    heater.set_temp(100.0)
    time_s = warm(printer, heater, 20.0)
    heater.set_temp(0.0)
    warm(printer, heater, 20.0, time_s, 0.3)
    assert printer.pins["PE0"].sent[-1][1] == 0.0


def test_shutdown_ends_the_heating() -> None:
    printer, heater = bed_with()
    heater.set_temp(100.0)
    time_s = warm(printer, heater, 20.0)
    printer.send("klippy:shutdown")
    warm(printer, heater, 20.0, time_s, 0.3)
    assert printer.pins["PE0"].sent[-1][1] == 0.0


def test_watermark_heats_below_and_rests_above() -> None:
    printer, heater = bed_with("watermark")
    heater.set_temp(60.0)
    time_s = warm(printer, heater, 50.0)
    assert printer.pins["PE0"].sent[-1][1] == 1.0
    assert heater.check_busy(time_s)
    time_s = warm(printer, heater, 63.5, time_s)
    assert printer.pins["PE0"].sent[-1][1] == 0.0
    assert not heater.check_busy(time_s)


def test_m190_waits_until_the_bed_is_there_and_reports_temperatures() -> None:
    printer, heater = bed_with()
    printer.send("klippy:ready")
    warm(printer, heater, 20.0)
    printer.reactor.on_pause = lambda now: (
        warm(printer, heater, min(60.0, 20.0 + 10 * (now - 112)), now, 0.3) and None
    )
    printer.gcode.commands["M190"](FakeCommand(printer.gcode, S="60"))
    assert heater.get_temp(printer.reactor.now_s)[0] == pytest.approx(60.0, abs=1.0)
    assert len(printer.gcode.lines) > 3
    assert all(line.startswith("B:") and line.endswith("/60.0") for line in printer.gcode.lines)


def test_m140_does_not_wait() -> None:
    printer, heater = bed_with()
    printer.gcode.commands["M140"](FakeCommand(printer.gcode, S="60"))
    assert heater.get_temp(0.0)[1] == 60.0
    assert printer.gcode.lines == []


def test_batch_mode_waits_for_nothing() -> None:
    printer = machine(debugoutput="out")
    printer.load("heater_bed")
    printer.gcode.commands["M190"](FakeCommand(printer.gcode, S="60"))
    assert printer.reactor.now_s == 100.0


def test_registry_lists_and_addresses_heaters() -> None:
    printer = machine()
    for section in ("heater_bed", "heater_generic chamber", "temperature_sensor board", "extruder"):
        printer.load(section)
    registry = printer.lookup_object("heaters")
    status = registry.get_status(0.0)
    assert status["available_heaters"] == ["heater_bed", "heater_generic chamber", "extruder"]
    assert status["available_sensors"] == [
        "heater_bed",
        "heater_generic chamber",
        "temperature_sensor board",
        "extruder",
    ]
    printer.gcode.mux["SET_HEATER_TEMPERATURE", "chamber"](FakeCommand(printer.gcode, TARGET="45"))
    assert registry.lookup_heater("chamber").get_temp(0.0)[1] == 45.0
    printer.gcode.commands["TURN_OFF_HEATERS"](FakeCommand(printer.gcode))
    assert registry.lookup_heater("chamber").get_temp(0.0)[1] == 0.0
    with pytest.raises(CommandError, match="Unknown heater 'oven'"):
        registry.lookup_heater("oven")


def test_m105_before_ready_and_after() -> None:
    printer = machine()
    printer.load("heater_bed")
    printer.load("heater_generic chamber")
    m105 = printer.gcode.commands["M105"]
    m105(FakeCommand(printer.gcode))
    printer.send("klippy:ready")
    m105(FakeCommand(printer.gcode))
    assert printer.gcode.lines == ["ok T:0", "ok B:0.0 /0.0 C:0.0 /0.0"]


def test_temperature_wait_needs_a_known_sensor_and_a_limit() -> None:
    printer = machine()
    printer.load("heater_bed")
    wait = printer.gcode.commands["TEMPERATURE_WAIT"]
    with pytest.raises(CommandError, match="Unknown sensor 'oven'"):
        wait(FakeCommand(printer.gcode, SENSOR="oven", MINIMUM="50"))
    with pytest.raises(CommandError, match="MINIMUM or MAXIMUM"):
        wait(FakeCommand(printer.gcode, SENSOR="heater_bed"))
    wait(FakeCommand(printer.gcode, SENSOR="heater_bed", MAXIMUM="50"))  # 0 degC: within, returns


def test_an_unknown_sensor_type_names_the_known_ones() -> None:
    printer = machine()
    registry = printer.load("heaters")
    with pytest.raises(ConfigError, match=r"Unknown temperature sensor 'Nothing'.*Generic 3950"):
        registry.setup_sensor(printer.config("bad_sensor"))


# verify_heater

VERIFY = verify_heater.VerifyParameters(
    hysteresis_c=5.0, max_error_c_s=120.0, heating_gain_c=2.0, check_gain_s=20.0
)


def first_fault(temps: list[float], target: float = 200.0) -> int | None:
    state = verify_heater.VerifyState()
    for second, temp in enumerate(temps):
        if not verify_heater.check(VERIFY, state, float(second), temp, target):
            return second
    return None


def test_a_heater_that_does_not_warm_fails_after_check_gain_time() -> None:
    assert first_fault([25.0] * 40) == 20


def test_a_heater_that_warms_passes() -> None:
    assert first_fault([min(200.0, 25.0 + 0.2 * t) for t in range(2000)]) is None


def test_a_heater_that_falls_away_uses_up_max_error() -> None:
    # 15 below target is 10 beyond the hysteresis: 120 degree-seconds are reached in the 12th second.
    assert first_fault([200.0] * 10 + [185.0] * 40) == 10 + 12 - 1


def test_verify_shuts_the_printer_down_in_plain_words() -> None:
    printer, heater = bed_with()
    printer.send("klippy:connect")
    heater.set_temp(100.0)
    warm(printer, heater, 20.0)
    tick = printer.reactor.timers[0]
    for second in range(120):
        printer.reactor.now_s = 112.0 + second
        report(printer, "PE1", 20.0, printer.reactor.now_s, heater.sensor.curve)
        tick(printer.reactor.now_s)
        if printer.shutdown_text:
            break
    assert "Heater heater_bed not heating at expected rate" in printer.shutdown_text
    assert 60 <= second <= 62  # the bed's check_gain_time
