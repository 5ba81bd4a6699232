"""The host's link against the simulated firmware: identify, configure, query, restart, and what goes wrong."""

from __future__ import annotations

import itertools
import logging
import re
import zlib
from pathlib import Path
from typing import Any

import pytest

import serialhdl
from link import serialport
from link_rig import LinkSession
from mcu import MCU

PIN = {"chip_name": "mcu", "share_type": None, "invert": 0, "pullup": 0}


# Pins of each build that have what a test needs of them.
CHIP_PINS = {"pwm": "PC6", "adc": "PC5", "endstop": "PC10"}
PINS = {
    "simulator": CHIP_PINS,
    "stm32f334": CHIP_PINS,
    "atmega2560": {"pwm": "PH3", "adc": "PF1", "endstop": "PC4"},
}


def pin(kind: str) -> str:
    """Of the build under test."""
    return PINS[LinkSession.BUILD][kind]


@pytest.fixture(autouse=True, params=PINS)
def build(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """All of this on the simulator port and on the images for the chips."""
    monkeypatch.setattr(LinkSession, "BUILD", request.param)
    return str(request.param)


@pytest.fixture
def session(tmp_path: Path) -> LinkSession:
    return LinkSession(tmp_path)


def nothing(printer: Any) -> None:
    pass


def outputs(printer: Any) -> None:
    """Some pins, as modules would set them up."""
    pins = printer.lookup_object("pins")
    led = pins.setup_pin("digital_out", "PB0")
    led.setup_max_duration(0.0)
    heater = pins.setup_pin("pwm", "!PB1")
    heater.setup_cycle_time(0.010)
    fan = pins.setup_pin("pwm", pin("pwm"))
    fan.setup_max_duration(0.0)
    fan.setup_cycle_time(0.001, True)
    printer.add_object("led", led)
    printer.add_object("heater", heater)
    printer.add_object("fan", fan)


# --- start ---


def test_dictionary_is_fetched_and_the_status_reports_it(session: LinkSession, build: str) -> None:
    status: dict[str, Any] = {}

    def note(printer: Any) -> None:
        if (
            build == "atmega2560"
        ):  # which answers find it awake is chance: half a second of them may be 90 ppm off
            session.reactor.pause(session.reactor.monotonic() + 4.0)
        status.update(printer.lookup_object("mcu").get_status(0.0))

    state, _ = session.host(note)
    assert state == "ready"
    assert (
        status["mcu_constants"]["CLOCK_FREQ"] == session.clock_hz and status["mcu_constants"]["MCU"] == build
    )
    assert status["mcu_version"] and status["mcu_build_versions"]
    # 80 ppm fast: after half a second (Mega: four) that is known to a few ppm. The Mega reads its clock 35 us earlier
    # (gathering and checking a block takes so long) in answer to a message that finds it awake: a few ppm more.
    few = 15e-6 if build == "atmega2560" else 10e-6
    assert status["last_stats"]["freq"] == pytest.approx(session.clock_hz * (1 + 80e-6), rel=few)


@pytest.mark.parametrize("seed", [1, 2])
def test_start_and_queries_survive_a_bad_line(tmp_path: Path, seed: int) -> None:
    session = LinkSession(tmp_path, seed=seed, corrupt=0.002, drop=0.002, duplicate=0.001)

    def body(printer: Any) -> None:
        mcu: MCU = printer.lookup_object("mcu")
        query = mcu.lookup_query_command("debug_read order=%c addr=%u", "debug_result val=%u")
        ping = mcu.lookup_query_command("debug_ping data=%*s", "pong data=%*s")
        for n in range(200):
            data = bytes((n + i) & 0xFF for i in range(n % 40))
            assert ping.send([data])["data"] == data
        assert query is not None
        assert mcu.get_status(0.0)["last_stats"]["bytes_retransmit"] > 0

    assert session.host(body, outputs)[0] == "ready"


def test_configuration_is_sent_once_and_kept_over_a_restart_of_the_host(
    session: LinkSession, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    assert session.host(nothing, outputs)[0] == "ready"
    assert "Sending MCU 'mcu' printer configuration" in caplog.text
    caplog.clear()
    assert session.host(nothing, outputs, start_reason="restart")[0] == "ready"
    assert re.search(r"Configured MCU 'mcu' \(\d{3,4} moves\)", caplog.text)
    assert "Sending MCU" not in caplog.text


def test_crc_is_that_of_the_command_text(session: LinkSession) -> None:
    seen: dict[str, Any] = {}

    def body(printer: Any) -> None:
        mcu = printer.lookup_object("mcu")
        seen.update(mcu.lookup_query_command(
            "get_config", "config is_config=%c crc=%u is_shutdown=%c move_count=%hu").send())  # fmt: skip
        seen["text"] = "\n".join(mcu._script.config_cmds[:-1])

    session.host(body, outputs)
    assert seen["is_config"] == 1 and seen["text"].startswith(
        "allocate_oids count=3\nconfig_digital_out oid=0 pin=PB0"
    )
    assert seen["crc"] == zlib.crc32(seen["text"].encode())


def test_changed_configuration_resets_the_mcu_and_the_next_start_configures_it(session: LinkSession) -> None:
    assert session.host(nothing, outputs)[0] == "ready"
    session.host(nothing, start_reason="restart")  # another configuration: none
    assert session.exit == "firmware_restart"
    assert session.host(nothing, start_reason="firmware_restart")[0] == "ready"


def test_unknown_pin_is_named(session: LinkSession) -> None:
    state, text = session.host(nothing, lambda p: p.lookup_object("pins").setup_pin("digital_out", "PZ9"))
    assert state == "error" and "Pin 'PZ9' is not a valid pin name on mcu 'mcu'" in text


def test_command_the_firmware_lacks_is_named_with_the_board(session: LinkSession) -> None:
    def prepare(printer: Any) -> None:
        mcu = printer.lookup_object("mcu")
        mcu.register_config_callback(lambda: mcu.lookup_command("config_flux_capacitor oid=%c pin=%u"))

    state, text = session.host(nothing, prepare)
    assert state == "error"
    assert "'config_flux_capacitor'" in text and "[mcu]" in text and "Traceback" not in text


def test_config_command_in_another_form_than_the_firmwares_is_refused(session: LinkSession) -> None:
    def prepare(printer: Any) -> None:
        mcu = printer.lookup_object("mcu")
        mcu.register_config_callback(
            lambda: mcu.add_config_cmd(f"config_endstop oid={mcu.create_oid()} pin=PA0")
        )

    state, text = session.host(nothing, prepare)
    assert state == "error" and "config_endstop" in text and "pull_up" in text


def test_port_that_does_not_answer_says_what_to_check(tmp_path: Path) -> None:
    session = LinkSession(tmp_path, drop=1.0)
    start = session.world.now
    state, text = session.host(nothing)
    assert state == "error"
    assert text.startswith("mcu 'mcu': Unable to connect.") and "'serial'" in text and "'baud'" in text
    assert session.world.now - start < serialhdl.CONNECT_TIMEOUT_S + 2.0


def test_port_that_is_not_there_says_so(session: LinkSession) -> None:
    config = "[mcu]\nserial: /dev/serial/by-id/no-such-board\n"
    state, text = session.host(nothing, config=config, open_port=serialport.open_port)
    assert state == "error"
    assert "no such device" in text and "/dev/serial/by-id/no-such-board" in text


def test_a_can_bus_that_is_not_there_is_named(session: LinkSession) -> None:
    state, text = session.host(nothing, config="[mcu]\ncanbus_uuid: 11aa22bb33cc\n")
    assert state == "error" and "Unable to use the CAN interface 'can0'" in text
    assert "canbus_query.py" in text


# --- running ---


def test_outputs_change_at_their_print_time(session: LinkSession) -> None:
    def body(printer: Any) -> None:
        led = printer.lookup_object("led")
        mcu: MCU = led.get_mcu()
        start = mcu.estimated_print_time(session.reactor.monotonic()) + 0.5
        for n in range(10):
            led.set_digital(start + n * 0.1, n & 1)
        printer.lookup_object("heater").set_pwm(start, 0.25)
        printer.lookup_object("fan").set_pwm(start, 0.5)
        session.reactor.pause(session.reactor.monotonic() + 1.7)
        assert not printer.is_shutdown()

    assert session.host(body, outputs)[0] == "ready"


def test_unrefreshed_heater_shuts_down_with_a_reason_for_people(session: LinkSession, build: str) -> None:
    moments: list[float] = []

    def body(printer: Any) -> None:
        heater = printer.lookup_object("heater")
        mcu: MCU = heater.get_mcu()
        # past the wrap of 32 bits, which costs an emulated chip too much
        now = session.reactor.pause(session.reactor.monotonic() + (65.0 if build == "simulator" else 0.0))
        assert mcu.get_shutdown_clock() == 0
        heater.set_pwm(mcu.estimated_print_time(now) + 0.2, 0.5)
        session.reactor.pause(now + 4.0)
        moments.extend([mcu.estimated_print_time(now), mcu.clock_to_print_time(mcu.get_shutdown_clock())])

    state, text = session.host(body, outputs)
    assert state == "shutdown"
    assert "Missed scheduling of next" in text and "FIRMWARE_RESTART" in text
    set_s, shutdown_s = moments
    assert shutdown_s == pytest.approx(set_s + 0.2 + 2.0, abs=0.002)  # max_duration is 2 s


def test_host_shutdown_stops_the_mcu_and_only_a_firmware_restart_revives_it(session: LinkSession) -> None:
    def stop(printer: Any) -> None:
        printer.invoke_shutdown("test")
        session.reactor.pause(session.reactor.monotonic() + 0.2)

    assert session.host(stop, outputs)[0] == "shutdown"
    state, text = session.host(nothing, outputs, start_reason="restart")
    assert state == "error" and "shutdown" in text and "FIRMWARE_RESTART" in text

    session.host(lambda p: p.request_exit("firmware_restart"), outputs, even_failed=True)
    assert session.host(nothing, outputs)[0] == "ready"


@pytest.mark.parametrize("left", ["configured", "shut down"])
def test_a_host_that_was_killed_leaves_an_mcu_the_next_one_resets_by_itself(
    session: LinkSession, left: str, caplog: pytest.LogCaptureFixture
) -> None:
    def die(printer: Any) -> None:
        if left == "shut down":
            printer.invoke_shutdown("test")
            session.reactor.pause(session.reactor.monotonic() + 0.2)

    caplog.set_level(logging.INFO)
    session.host(die, outputs)
    session.host(nothing, outputs)
    assert session.exit == "firmware_restart"
    assert "Transition to shutdown" not in caplog.text.partition("automated")[2], "clients see no shutdown"
    assert session.host(nothing, outputs, start_reason="firmware_restart")[0] == "ready"


def test_silent_mcu_is_noticed_within_seconds(session: LinkSession) -> None:
    def body(printer: Any) -> None:
        printer.lookup_object("mcu")._serial.port.close()  # the cable is pulled
        session.reactor.pause(session.reactor.monotonic() + 8.0)

    state, text = session.host(body)
    assert state == "shutdown" and "Lost communication with MCU 'mcu'" in text


def test_query_without_answer_fails_with_its_name(session: LinkSession) -> None:
    def body(printer: Any) -> None:
        mcu = printer.lookup_object("mcu")
        query = mcu.lookup_query_command("debug_nop", "pong data=%*s")
        with pytest.raises(printer.command_error, match="Unable to obtain 'pong' response"):
            query.send()

    assert session.host(body)[0] == "ready"


def test_adc_reports_value_and_time(session: LinkSession) -> None:
    reports: list[tuple[float, float]] = []

    def prepare(printer: Any) -> None:
        adc = printer.lookup_object("pins").setup_pin("adc", pin("adc"))
        adc.setup_adc_sample(0.001, 8)
        adc.setup_adc_callback(0.1, lambda t, v: reports.append((t, v)))

    def body(printer: Any) -> None:
        session.reactor.pause(session.reactor.monotonic() + 3.0)

    assert session.host(body, prepare)[0] == "ready"
    assert len(reports) >= 10 and all(0.0 <= value <= 1.0 for _, value in reports)
    gaps = [b - a for (a, _), (b, _) in itertools.pairwise(reports)]
    assert gaps == pytest.approx([0.1] * len(gaps), abs=1e-6)


# --- endstops ---


class FakeStepper:
    """What homing needs of a stepper; a real config_stepper on the board."""

    def __init__(self, mcu: MCU, letter: str) -> None:
        self.mcu, self.oid, self.ended = mcu, mcu.create_oid(), 0
        mcu.register_config_callback(
            lambda: mcu.add_config_cmd(
                f"config_stepper oid={self.oid} step_pin=P{letter}0 dir_pin=P{letter}1 invert_step=0"
                " step_pulse_ticks=100"
            )
        )

    def get_mcu(self) -> MCU:
        return self.mcu

    def get_oid(self) -> int:
        return self.oid

    def note_homing_end(self) -> None:
        self.ended += 1


def homing(printer: Any, boards: int) -> None:
    """An endstop on the first board (it follows the level of an output on that pin: open = 0), a stepper on each."""
    endstop = printer.lookup_object("pins").setup_pin("endstop", pin("endstop"))
    steppers = [FakeStepper(mcu, "B") for _, mcu in printer.lookup_objects("mcu")]
    for stepper in steppers[:boards]:
        endstop.add_stepper(stepper)
    printer.add_object("endstop", endstop)
    printer.add_object("steppers", steppers)


@pytest.mark.parametrize("boards", [1, 2])
def test_triggered_endstop_ends_homing_at_the_time_of_the_touch(tmp_path: Path, boards: int) -> None:
    session = LinkSession(tmp_path, mcus=boards)

    def body(printer: Any) -> None:
        endstop = printer.lookup_object("endstop")
        mcu = endstop.get_mcu()
        # a floating simulated input reads 0: wait for "not triggered", so that it triggers at once
        start = mcu.estimated_print_time(session.reactor.monotonic()) + 0.2
        endstop.home_start(start, 0.000015, 4, 0.001, triggered=False)
        assert endstop.home_wait(start + 5.0) == pytest.approx(start, abs=1e-6)
        assert mcu.estimated_print_time(session.reactor.monotonic()) < start + 0.1
        assert [s.ended for s in printer.lookup_object("steppers")] == [1] * boards

    assert session.host(body, lambda p: homing(p, boards))[0] == "ready"


@pytest.mark.parametrize("boards", [1, 2])
def test_move_that_meets_no_endstop_ends_at_its_end_and_says_so(tmp_path: Path, boards: int) -> None:
    session = LinkSession(tmp_path, mcus=boards)

    def body(printer: Any) -> None:
        endstop = printer.lookup_object("endstop")
        mcu = endstop.get_mcu()
        start = mcu.estimated_print_time(session.reactor.monotonic()) + 0.2
        endstop.home_start(start, 0.000015, 4, 0.001)
        assert endstop.home_wait(start + 2.0) == 0.0
        over = mcu.estimated_print_time(session.reactor.monotonic()) - start - 2.0
        assert 0.0 <= over < 0.15, "noticed at the next report, every 75 ms"
        assert endstop.query_endstop(start + 2.5) == 0

    assert session.host(body, lambda p: homing(p, boards))[0] == "ready"


def test_board_that_falls_silent_stops_the_others(tmp_path: Path) -> None:
    session = LinkSession(tmp_path, mcus=2)

    def body(printer: Any) -> None:
        endstop = printer.lookup_object("endstop")
        mcu = endstop.get_mcu()
        start = mcu.estimated_print_time(session.reactor.monotonic()) + 0.2
        completion = endstop.home_start(start, 0.000015, 4, 0.001)
        session.reactor.pause(session.reactor.monotonic() + 1.0)
        assert not completion.test()
        printer.lookup_object("mcu board1")._serial.port.close()
        session.reactor.pause(session.reactor.monotonic() + 0.2)
        assert completion.test(), "the first board's time-out is no longer put off"

    session.host(body, lambda p: homing(p, 2))


def test_second_board_follows_print_time_although_it_drifts(tmp_path: Path) -> None:
    session = LinkSession(tmp_path, mcus=2, jitter_s=0.0001)
    errors: list[float] = []

    def body(printer: Any) -> None:
        first, second = printer.lookup_object("mcu"), printer.lookup_object("mcu board1")
        for _ in range(60):
            now = session.reactor.monotonic()
            second.check_active(first.estimated_print_time(now), now)
            session.reactor.pause(now + 1.0)
            now = session.reactor.monotonic()
            print_time = first.estimated_print_time(now)
            # truth: the world runs the clocks at +80 and -50 ppm from its start
            true_system = session.world.start_s + print_time / (1 + 80e-6)
            true_clock = (true_system - session.world.start_s) * session.clock_hz * (1 - 50e-6)
            errors.append((second.print_time_to_clock(print_time) - true_clock) / session.clock_hz)

    assert session.host(body)[0] == "ready"
    # each way takes up to 100 us longer than the shortest; a wrong slope would show as a trend of 130 us a second
    assert max(abs(e) for e in errors) < 100e-6
    # and an 8-bit chip's own computing adds some tens
    settled = 20e-6 if session.clock_hz > 20e6 else 40e-6
    assert max(abs(e) for e in errors[30:]) < settled


@pytest.mark.parametrize("seed", range(1, 11))
def test_a_host_connects_over_a_line_that_damages_and_loses_a_byte_in_a_hundred(
    tmp_path: Path, seed: int
) -> None:
    """Three answers of 47 bytes in five do not arrive; an answer to a shorter question does."""
    session = LinkSession(tmp_path, seed=seed, corrupt=0.01, drop=0.01)
    state, message = session.host(lambda printer: None)
    assert state == "ready", message
