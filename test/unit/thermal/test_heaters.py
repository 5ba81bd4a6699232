"""Heaters as G-code and status see them: targets, waiting, limits, PWM, the watch, the induction heater's face."""

from __future__ import annotations

import itertools
import struct
from types import SimpleNamespace
from typing import Any

import pytest

import chelper
from block_codec import Row, content, pack
from configtext import ConfigError
from extras import heater_bed, heater_generic, heaters, induction_heater, temperature_sensor, verify_heater
from extras.heater import tuning as heater_tuning
from extras.heater.ordinary import HeaterSettings
from heater_fakes import CommandError, FakeCommand, FakePrinter
from thermal.sensing import laws

CONFIG = """
[heater_bed]
heater_pin: PE0
sensor_type: Generic 3950
sensor_pin: PE1
control: {control}
pid_Kp: 60
pid_Ki: 1
pid_Kd: 100
max_delta: 3
min_temp: 0
max_temp: 120
[heater_generic chamber]
heater_pin: PE2
sensor_type: Generic 3950
sensor_pin: PE3
control: watermark
min_temp: 0
max_temp: 80
gcode_id: C
[temperature_sensor board]
sensor_type: PT1000
sensor_pin: PE4
[induction_heater nozzle]
sense_pin: PA0
min_temp: 0
max_temp: 320
[extruder]
heater: nozzle
min_extrude_temp: 160
[bad_sensor]
sensor_type: Nothing
"""
LOADERS = {
    "heaters": heaters.load_config,
    "heater_bed": heater_bed.load_config,
    "heater_generic": heater_generic.load_config_prefix,
    "temperature_sensor": temperature_sensor.load_config_prefix,
    "verify_heater": verify_heater.load_config_prefix,
    "induction_heater": induction_heater.load_config_prefix,
    "extruder": lambda config: config.get_printer().load_object(config, "heaters").setup_heater(config, "T0"),
}


def machine(control: str = "pid", **start_args: Any) -> FakePrinter:
    return FakePrinter(CONFIG.replace("{control}", control), LOADERS, **start_args)


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


# The induction heater's face


def blocks(temp: float, phase: int, count: int = 2) -> bytes:
    error = laws.ExpLaw().error(temp, phase)
    value = int((256.0 + error) * 192) >> 4
    code = int(256.0 + error)
    return pack([Row(192, value, phase, code - 2, code + 3)] * count, 192)  # 0.9 LSB of noise


def nozzle(more: str = "") -> tuple[FakePrinter, Any]:
    printer = FakePrinter(
        CONFIG.replace("{control}", "pid").replace("sense_pin: PA0", f"sense_pin: PA0\n{more}"), LOADERS
    )
    heater = printer.load("extruder")
    printer.mcu.configure()
    printer.send("klippy:connect")
    printer.send("klippy:ready")
    return printer, heater


def deliver(printer: FakePrinter, sequence: int, temp: float, phase: int) -> None:
    clock = int((printer.reactor.now_s - 0.020) * 72e6)
    packed = content(sequence, clock, blocks(temp, phase))
    pulled = chelper.get_ffi()[0].new("struct pull_message[]", 1)
    pulled[0].len, pulled[0].data, pulled[0].receive_time = len(packed), packed, printer.reactor.now_s
    printer.mcu.on_batch(pulled, 1)


def test_extruder_uses_the_induction_heater_under_its_own_name() -> None:
    printer, heater = nozzle()
    assert heater.name == "extruder"
    assert printer.lookup_object("heaters").lookup_heater("extruder") is heater


NOZZLE_COMMANDS = (
    "INDUCTION_CALIBRATE",
    "INDUCTION_STATUS",
    "INDUCTION_ZERO",
    "INDUCTION_REFERENCE",
    "INDUCTION_DUMP",
)


def test_commands_take_the_name_of_the_section_that_of_the_extruder_or_of_the_only_nozzle_none() -> None:
    printer, heater = nozzle()
    mux = printer.gcode.mux
    for command in NOZZLE_COMMANDS:
        assert mux[command, "nozzle"] == mux[command, "extruder"] == mux[command, None]
    for name in ("nozzle", "extruder"):
        mux["SET_HEATER_TEMPERATURE", name](FakeCommand(printer.gcode, TARGET="200"))
        assert heater.get_temp(0.0)[1] == 200.0
        heater.set_temp(0.0)
        assert heater_tuning.heater_of(printer, FakeCommand(printer.gcode, HEATER=name)) is heater
    assert heater_tuning.heater_of(printer, FakeCommand(printer.gcode), sole_nozzle=True) is heater


TWO = (
    CONFIG
    + """
[induction_heater {second}]
sense_pin: PA1
max_temp: 300
[extruder1]
heater: {second}
"""
)


def two_nozzles(second: str) -> FakePrinter:
    loaders = {**LOADERS, "extruder1": LOADERS["extruder"]}
    printer = FakePrinter(TWO.replace("{control}", "pid").replace("{second}", second), loaders)
    printer.load("extruder")
    heaters_of = printer.lookup_object("heaters")
    heaters_of.setup_heater(printer.config("extruder1"), "T1")
    printer.send("klippy:mcu_identify")
    printer.send("klippy:connect")
    return printer


def test_of_two_nozzles_one_must_be_named() -> None:
    printer = two_nozzles("other")
    for command in NOZZLE_COMMANDS:
        names = {name for cmd, name in printer.gcode.mux if cmd == command}
        assert names == {"nozzle", "extruder", "other", "extruder1"}
    with pytest.raises(CommandError, match=r"missing HEATER \(choices: nozzle, other\)"):
        heater_tuning.heater_of(printer, FakeCommand(printer.gcode), sole_nozzle=True)


def test_a_nozzle_named_like_another_heater_is_refused() -> None:
    """HEATER=extruder could be either."""
    with pytest.raises(
        ConfigError, match=r"'induction_heater extruder' \(printer.cfg, line \d+\): .* another name"
    ):
        two_nozzles("extruder")


def test_the_extruder_s_settings_show_the_limits_of_its_nozzle() -> None:
    """Front ends refuse every target without them."""
    printer, _ = nozzle()
    limits = {"min_temp": 0.0, "max_temp": 320.0, "min_extrude_temp": 160.0}
    assert limits.items() <= printer.settings("extruder").items()


@pytest.mark.parametrize("option", ["min_temp", "max_temp"])
def test_a_limit_at_the_extruder_of_a_nozzle_is_sent_to_its_place(option: str) -> None:
    text = CONFIG.replace("{control}", "pid").replace("min_extrude_temp: 160", f"{option}: 0.5")
    where = rf"'{option}' in section 'extruder' \(printer.cfg, line \d+\).*\[induction_heater nozzle\]"
    with pytest.raises(ConfigError, match=where):
        FakePrinter(text, LOADERS).load("extruder")


def test_an_unused_induction_heater_is_a_heater_of_its_own() -> None:
    printer = machine()
    printer.load("induction_heater nozzle")
    printer.send("klippy:connect")
    assert ("SET_HEATER_TEMPERATURE", "nozzle") in printer.gcode.mux


def test_two_extruders_cannot_share_one_nozzle() -> None:
    printer, _ = nozzle()
    with pytest.raises(ConfigError, match="used by"):
        printer.lookup_object("induction_heater nozzle").serve(printer.config("extruder"))


def test_the_units_own_tests_are_configured_unless_turned_off() -> None:
    printer, _ = nozzle()
    off, _ = nozzle("signal_test_interval: 0")
    assert off.mcu.config == printer.mcu.config[:-1]
    assert printer.mcu.config[-1] == (
        "config_induction_test oid=3 moved_low=451 moved_high=4060 off_low=246 off_high=266 interval=1200"
        " phase=2012 jump=240 rise=15 fall=1 tolerance=20 slack=16"
    )


def test_the_unit_is_configured_before_it_may_heat() -> None:
    printer, _ = nozzle()
    first, sense, block, *limits, _tests = printer.mcu.config
    assert first == (
        "config_induction oid=3 bridge=0 adc_pin=PA0 period_ticks=600 phase_max=45000 max_duration=7200000"
    )
    assert sense == "config_induction_sense oid=3 oversample=4 settle_samples=20 ema_shift=0"
    assert block == "config_induction_block oid=3 samples=192 records=3"
    assert limits
    assert all(line.startswith("config_induction_limit oid=3 phase=") for line in limits)
    assert printer.mcu.init == ["induction_report oid=3 enable=1"]


def test_the_board_learns_how_hot_a_nozzle_may_be_that_is_driven_hard() -> None:
    printer, heater = nozzle()
    deliver(printer, 0, 200.0, 2012)
    heater.set_temp(250.0)
    heater.set_temp(150.0)
    ceilings = printer.mcu.others["induction_ceiling"].sent
    shares = [share for oid, phase, share in ceilings if (oid, phase) == (3, 20125)]
    assert len(shares) == len(ceilings) == 3 and shares[0] < shares[2] < shares[1] < 0xFFFF


def test_blocks_become_temperature_and_phase_commands_ahead_of_time() -> None:
    printer, heater = nozzle()
    deliver(printer, 0, 200.0, 2012)
    heater.set_temp(250.0)
    assert heater.get_status(100.0) == {
        "temperature": pytest.approx(200.0, abs=0.1),
        "target": 250.0,
        "power": 1.0,
    }
    plans = [message for message in printer.mcu.sent if len(message) == 3]
    clocks = [clock for _, clock, _ in plans]
    assert len(clocks) == 2  # the second takes the place of the first, which was for later
    assert struct.unpack("<HH", plans[-1][2][:4]) == (0, 45000)
    assert clocks[-1] > 100.0 * 72e6 + 0.004 * 72e6
    detail = printer.lookup_object("induction_heater nozzle").get_status(100.0)
    assert detail["estimate"] == pytest.approx(200.0, abs=0.1)
    assert detail["blocks_lost"] == 0
    assert detail["phase"] == 45000


def held_nozzle() -> tuple[FakePrinter, Any]:
    """Held at 250 for a second."""
    printer, heater = nozzle()
    heater.set_temp(250.0)
    for n in range(100):
        printer.reactor.now_s += 0.010
        phase = heater.loop.state.commanded.phase_ticks
        deliver(printer, 2 * n, 250.0, phase or 2012)
    return printer, heater


def test_messages_of_a_held_nozzle_come_in_batches_until_it_gets_a_new_target() -> None:
    printer, heater = held_nozzle()
    assert printer.mcu.batch_max == 4
    heater.set_temp(255.0)
    assert not printer.mcu.batch_max


def test_a_dump_gets_each_message_at_once() -> None:
    printer, heater = held_nozzle()
    heater.loop.listeners.append(lambda block, found, now_s: None)
    deliver(printer, 200, 250.0, heater.loop.state.commanded.phase_ticks)
    assert not printer.mcu.batch_max


def test_cold_extrusion_is_reported_by_the_extruder_s_limit() -> None:
    printer, heater = nozzle()
    deliver(printer, 0, 150.0, 2012)
    assert not heater.can_extrude
    heater.set_temp(170.0)
    for n in range(1, 40):
        printer.reactor.now_s += 0.017
        deliver(printer, 2 * n, 170.0, 2012)
    assert heater.can_extrude


def test_target_above_max_temp_is_refused() -> None:
    _, heater = nozzle()
    with pytest.raises(CommandError, match=r"\(400\.0\) out of range \(0\.0:320\.0\)"):
        heater.set_temp(400.0)


def test_a_target_of_max_temp_is_taken() -> None:
    _, heater = nozzle()
    heater.set_temp(320.0)
    assert heater.get_temp(0.0)[1] == 320.0


@pytest.mark.parametrize(("law", "highest_c"), [("watermark", 313.0), ("two_period", 300.0)])
def test_a_law_that_swings_keeps_away_from_max_temp_and_says_so(law: str, highest_c: float) -> None:
    text = CONFIG.replace("{control}", "pid").replace("sense_pin: PA0", f"sense_pin: PA0\ncontrol: {law}")
    heater = FakePrinter(text, LOADERS).load("extruder")
    heater.set_temp(highest_c)
    with pytest.raises(
        CommandError, match=rf"\(0\.0:{highest_c}\): control: {law} swings, .* below max_temp"
    ):
        heater.set_temp(highest_c + 1.0)
    heater.alter_target(320.0)
    assert heater.get_temp(0.0)[1] == highest_c


def test_after_a_shutdown_status_shows_no_power_and_a_reading_that_ages() -> None:
    printer, heater = nozzle()
    deliver(printer, 0, 200.0, 2012)
    heater.set_temp(250.0)
    detail = printer.lookup_object("induction_heater nozzle").get_status
    assert detail(100.0)["valid"] and detail(100.0)["phase"] == 45000 and detail(100.0)["power_w"] > 50.0
    printer.invoke_shutdown("Shutdown due to M112 command")
    after = detail(105.0)
    assert (after["power"], after["power_w"], after["phase"], after["target"]) == (0.0, 0.0, 0, 0.0)
    assert heater.get_status(105.0)["power"] == 0.0
    assert "pwm=0.000 power_w=0.00 phase=0" in heater.stats(105.0)[1]
    assert (after["valid"], after["guard"], after["calibrating"]) == (False, "off", False)
    assert after["estimate_age"] == pytest.approx(5.0, abs=0.1)


def test_a_reading_without_news_is_no_longer_valid() -> None:
    printer, _ = nozzle()
    deliver(printer, 0, 200.0, 2012)
    detail = printer.lookup_object("induction_heater nozzle").get_status
    assert detail(100.5)["valid"] and not detail(103.0)["valid"]


def test_a_stop_by_the_board_s_guard_names_the_heater_and_its_last_reading() -> None:
    printer, _ = nozzle()
    deliver(printer, 0, 200.0, 2012)
    (explain,) = printer.events["mcu:explain_shutdown"]
    words = explain(printer.mcu, "Induction coil signal stands still")
    assert words == "Induction heater 'nozzle': its last reading was 200 C."
    assert (
        explain(printer.mcu, "Timer too close")
        == explain(object(), "Induction coil signal stands still")
        == ""
    )


def test_too_hot_shuts_the_printer_down_and_nothing_more_is_sent() -> None:
    printer, heater = nozzle()
    for n in range(3):
        printer.reactor.now_s += 0.017
        deliver(printer, 2 * n, 330.0, 2012)
    assert "Induction heater 'nozzle'" in printer.shutdown_text
    assert "above max_temp" in printer.shutdown_text
    sent = len(printer.mcu.sent)
    deliver(printer, 6, 330.0, 2012)
    assert len(printer.mcu.sent) == sent
    assert heater.get_temp(0.0)[1] == 0.0


def test_silence_shuts_the_printer_down() -> None:
    printer, _ = nozzle()
    tick = printer.reactor.timers[-1]
    while not printer.shutdown_text and printer.reactor.now_s < 105.0:
        printer.reactor.now_s += 0.033
        tick(printer.reactor.now_s)
    assert "no samples" in printer.shutdown_text
    assert printer.reactor.now_s == pytest.approx(101.0, abs=0.1)
