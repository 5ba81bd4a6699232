"""The induction heater's face: names, limits, targets, commands to the board, and what status says after a stop."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import pytest

from configtext import ConfigError
from extras.heater import tuning as heater_tuning
from extras.induction.signal_limits import seen_cause
from heater_fakes import CommandError, FakeCommand, FakePrinter
from nozzle_rig import CONFIG, LOADERS, deliver, machine, nozzle
from thermal.sensing.features import FeatureParameters


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
        assert printer.lookup_object("heaters").lookup_heater(name) is heater
    for sole_nozzle in (True, False):
        assert heater_tuning.heater_of(printer, FakeCommand(printer.gcode), sole_nozzle) is heater
    mux["SET_HEATER_TEMPERATURE", None](FakeCommand(printer.gcode, TARGET="150"))
    assert heater.get_temp(0.0)[1] == 150.0


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
    heater = {"sensor_type": "induction", "control": "model", "smooth_time": 0.05, "max_power": 1.0}
    assert heater.items() <= printer.settings("extruder").items()


@pytest.mark.parametrize("option", ["min_temp", "max_temp", "sensor_type", "control"])
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
        "config_induction_test oid=3 moved_low=451 moved_high=4060 off_low=246 off_high=266 interval=1008"
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
        "temperature_source": "measured",
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


def stopped_nozzle(target_c: float = 250.0) -> tuple[FakePrinter, Any]:
    printer, heater = nozzle()
    deliver(printer, 0, 200.0, 2012)
    heater.set_temp(target_c)
    printer.invoke_shutdown("Shutdown due to M112 command")
    return printer, heater


def cool(printer: FakePrinter, seconds: int) -> None:
    tick = printer.reactor.timers[-1]
    for _ in range(2 * seconds):
        printer.reactor.now_s += 0.5
        tick(printer.reactor.now_s)


def test_after_a_shutdown_the_temperature_goes_on_as_modelled_and_says_so() -> None:
    printer, heater = stopped_nozzle()
    assert "// Induction heater 'nozzle': its temperature is modelled from here on" in printer.gcode.lines
    cool(printer, 10)
    after_10_s = heater.get_status(0.0)["temperature"]
    cool(printer, 90)
    after_100_s = heater.get_status(0.0)["temperature"]
    assert 120.0 < after_10_s < 190.0 and 30.0 < after_100_s < 80.0
    assert heater.get_status(0.0)["temperature_source"] == "modelled"
    assert not heater.can_extrude
    printer.send("klippy:disconnect")
    assert not printer.reactor.timers


def test_after_a_shutdown_it_is_never_below_what_still_reads_and_a_rise_is_alarmed() -> None:
    printer, heater = stopped_nozzle()
    reading_c = [190.0]
    heater.stopped.sensor = SimpleNamespace(get_temp=lambda eventtime: (reading_c[0], 0.0))
    for _ in range(10):
        cool(printer, 1)
        reading_c[0] -= 0.5
    assert heater.get_temp(0.0)[0] > 184.0
    assert not any(line.startswith("!!") for line in printer.gcode.lines)
    for _ in range(10):
        cool(printer, 1)
        reading_c[0] += 5.0
    alarms = [line for line in printer.gcode.lines if line.startswith("!!")]
    assert len(alarms) == 3 and "gets hotter after the stop (200 C)" in alarms[0]
    assert heater.get_temp(0.0)[0] > 225.0


def test_after_a_shutdown_current_in_the_coil_is_alarmed_once() -> None:
    printer, heater = stopped_nozzle()
    zero = round(heater.parameters.front.adc_zero_raw) << 4
    for raw, phase in ((zero, 0), (zero + 400, 2012)):
        printer.mcu.response({"phase": phase, "value": raw})
        cool(printer, 2)
        assert not heater.notices.kept
    for _ in range(2):
        printer.mcu.response({"phase": 0, "value": zero + 400})
    assert [3] in printer.mcu.sent, "it was asked for"
    (notice,) = heater.notices.kept
    assert notice.startswith("current flows in the coil after the stop")


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


@pytest.mark.parametrize(
    ("raw", "wide", "says"),
    [
        (258.0, 2, "no current: coil, bridge, its supply or sensing lead open"),
        (440.0, 0, "stands still"),
        (440.0, 1, ""),
    ],
)
def test_the_last_driven_blocks_show_the_cause_of_a_trip(raw: float, wide: int, says: str) -> None:
    front = FeatureParameters()
    driven = SimpleNamespace(phase_ticks=2012, mean_raw=raw, min_raw=int(raw) - wide, max_raw=int(raw) + wide)
    idle = SimpleNamespace(phase_ticks=0, mean_raw=256.0, min_raw=256, max_raw=256)
    seen = seen_cause([driven] * 4 + [idle] * 4, front)
    assert says in seen and bool(says) == bool(seen)
    assert seen_cause([idle] * 8, front) == ""


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
