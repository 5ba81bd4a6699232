"""Configuration, object ids, clock, statistics, shutdown, reset of the simulated MCU."""

from __future__ import annotations

import subprocess
from itertools import pairwise, permutations

import pytest

from block_codec import one_step
from mcu_harness import FREQ, SIM_DIR, Mcu, library_path, make_block

PA0, PA1, PA2 = 0, 1, 2

# Message formats of stock firmware v0.13 (its dictionaries), as far as this firmware has them: the wire interface.
STOCK_COMMANDS = """
allocate_oids count=%c
clear_shutdown
config_analog_in oid=%c pin=%u
config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u
config_endstop oid=%c pin=%c pull_up=%c
config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u
config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u
config_trsync oid=%c
debug_nop
debug_ping data=%*s
debug_read order=%c addr=%u
debug_write order=%c addr=%u val=%u
emergency_stop
endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c trsync_oid=%c trigger_reason=%c
endstop_query_state oid=%c
finalize_config crc=%u
get_clock
get_config
get_uptime
identify offset=%u count=%c
query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c min_value=%hu max_value=%hu range_check_count=%c
queue_digital_out oid=%c clock=%u on_ticks=%u
queue_pwm_out oid=%c clock=%u value=%hu
queue_step oid=%c interval=%u count=%hu add=%hi
reset
reset_step_clock oid=%c clock=%u
set_digital_out pin=%u value=%c
set_digital_out_pwm_cycle oid=%c cycle_ticks=%u
set_next_step_dir oid=%c dir=%c
set_pwm_out pin=%u cycle_ticks=%u value=%hu
stepper_get_position oid=%c
stepper_stop_on_trigger oid=%c trsync_oid=%c
trsync_set_timeout oid=%c clock=%u
trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c
trsync_trigger oid=%c reason=%c
update_digital_out oid=%c value=%c
buttons_ack oid=%c count=%c
buttons_add oid=%c pos=%c pin=%u pull_up=%c
buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c
config_buttons oid=%c button_count=%c
i2c_set_sw_bus oid=%c scl_pin=%u sda_pin=%u pulse_ticks=%u address=%u
config_i2c oid=%c
i2c_set_bus oid=%c i2c_bus=%u rate=%u address=%u
i2c_transfer oid=%c write=%*s read_len=%u
config_hd44780 oid=%c rs_pin=%u e_pin=%u d4_pin=%u d5_pin=%u d6_pin=%u d7_pin=%u delay_ticks=%u
hd44780_send_cmds oid=%c cmds=%*s
hd44780_send_data oid=%c data=%*s
config_st7920 oid=%c cs_pin=%u sclk_pin=%u sid_pin=%u sync_delay_ticks=%u cmd_delay_ticks=%u
st7920_send_cmds oid=%c cmds=%*s
st7920_send_data oid=%c data=%*s
config_neopixel oid=%c pin=%u data_size=%hu bit_max_ticks=%u reset_min_ticks=%u
neopixel_send oid=%c
neopixel_update oid=%c pos=%hu data=%*s
config_counter oid=%c pin=%u pull_up=%c
query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u
spi_set_sw_bus oid=%c miso_pin=%u mosi_pin=%u sclk_pin=%u mode=%u pulse_ticks=%u
config_spi oid=%c pin=%u cs_active_high=%c
config_spi_shutdown oid=%c spi_oid=%c shutdown_msg=%*s
config_spi_without_cs oid=%c
spi_send oid=%c data=%*s
spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u
spi_transfer oid=%c data=%*s
config_thermocouple oid=%c spi_oid=%c thermocouple_type=%c
query_thermocouple oid=%c clock=%u rest_ticks=%u min_value=%u max_value=%u max_invalid_count=%c
config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u
tmcuart_send oid=%c write=%*s read=%c
config_adxl345 oid=%c spi_oid=%c
query_adxl345 oid=%c rest_ticks=%u
query_adxl345_status oid=%c
config_lis2dw oid=%c bus_oid=%c bus_oid_type=%c lis_chip_type=%c
query_lis2dw oid=%c rest_ticks=%u
query_lis2dw_status oid=%c
config_mpu9250 oid=%c i2c_oid=%c
query_mpu9250 oid=%c rest_ticks=%u
query_mpu9250_status oid=%c
config_icm20948 oid=%c i2c_oid=%c
query_icm20948 oid=%c rest_ticks=%u
query_icm20948_status oid=%c
config_bmi160 oid=%c bus_oid=%c bus_oid_type=%c
query_bmi160 oid=%c rest_ticks=%u
query_bmi160_status oid=%c
ads1220_attach_trigger_analog oid=%c trigger_analog_oid=%c
ads131m0x_attach_trigger_analog oid=%c trigger_analog_oid=%c
config_ads1220 oid=%c spi_oid=%c data_ready_pin=%u
config_ads131m0x oid=%c spi_oid=%c channel=%c num_channels=%c data_ready_pin=%u
config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u
config_ldc1612 oid=%c i2c_oid=%c
config_ldc1612_with_intb oid=%c i2c_oid=%c intb_pin=%c
config_sos_filter oid=%c max_sections=%c
config_spi_angle oid=%c spi_oid=%c spi_angle_type=%c
config_trigger_analog oid=%c sos_filter_oid=%c
hx71x_attach_trigger_analog oid=%c trigger_analog_oid=%c
ldc1612_attach_trigger_analog oid=%c trigger_analog_oid=%c
query_ads1220 oid=%c rest_ticks=%u
query_ads1220_status oid=%c
query_ads131m0x oid=%c rest_ticks=%u
query_ads131m0x_status oid=%c
query_hx71x oid=%c rest_ticks=%u
query_hx71x_status oid=%c
query_ldc1612 oid=%c rest_ticks=%u
query_spi_angle oid=%c clock=%u rest_ticks=%u time_shift=%c
query_status_ldc1612 oid=%c
sos_filter_set_active oid=%c n_sections=%c coeff_frac_bits=%c
sos_filter_set_offset_scale oid=%c offset=%i scale=%i scale_frac_bits=%c auto_offset=%c
sos_filter_set_section oid=%c section_idx=%c sos0=%i sos1=%i sos2=%i sos3=%i sos4=%i
sos_filter_set_state oid=%c section_idx=%c state0=%i state1=%i
spi_angle_transfer oid=%c data=%*s
trigger_analog_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u monitor_ticks=%u monitor_max=%u
trigger_analog_query_state oid=%c
trigger_analog_set_raw_range oid=%c raw_min=%i raw_max=%i
trigger_analog_set_trigger oid=%c trigger_analog_type=%c trigger_value=%i
"""  # noqa: E501
STOCK_RESPONSES = """
analog_in_state oid=%c next_clock=%u values=%*s
clock clock=%u
config is_config=%c crc=%u is_shutdown=%c move_count=%hu
debug_result val=%u
endstop_state oid=%c homing=%c next_clock=%u pin_value=%c
identify_response offset=%u data=%.*s
is_shutdown static_string_id=%hu
pong data=%*s
shutdown clock=%u static_string_id=%hu
starting
stats count=%u sum=%u sumsq=%u
stepper_position oid=%c pos=%i
trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u
uptime high=%u clock=%u
buttons_state oid=%c ack_count=%c state=%*s
i2c_response oid=%c i2c_bus_status=%c response=%*s
neopixel_result oid=%c success=%c
counter_state oid=%c next_clock=%u count=%u count_clock=%u
spi_transfer_response oid=%c response=%*s
thermocouple_result oid=%c next_clock=%u value=%u fault=%c
tmcuart_response oid=%c read=%*s
sensor_bulk_data oid=%c sequence=%hu data=%*s
sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%u possible_overflows=%hu
spi_angle_transfer_response oid=%c clock=%u response=%*s
trigger_analog_state oid=%c homing=%c homing_clock=%u
"""


@pytest.fixture
def mcu() -> Mcu:
    mcu = Mcu()
    mcu.run(0.001)
    return mcu


def digital_out(oid: int, pin: int, **changes: int) -> tuple[str, dict[str, int]]:
    values = {"oid": oid, "pin": pin, "value": 0, "default_value": 0, "max_duration": 0} | changes
    return "config_digital_out", values


def test_configuration_is_remembered_with_its_checksum(mcu: Mcu) -> None:
    fresh = mcu.ask("get_config")
    assert (fresh["is_config"], fresh["crc"], fresh["is_shutdown"], fresh["move_count"]) == (0, 0, 0, 0)
    mcu.configure(1, digital_out(0, PA0))
    config = mcu.ask("get_config")
    assert (config["is_config"], config["crc"], config["is_shutdown"]) == (1, 0x12345678, 0)
    assert config["move_count"] >= 1024


@pytest.mark.parametrize(
    ("commands", "reason"),
    [
        ([("allocate_oids", {"count": 2}), ("allocate_oids", {"count": 2})], "oids already allocated"),
        ([("finalize_config", {"crc": 1}), ("finalize_config", {"crc": 1})], "Already finalized"),
        ([("finalize_config", {"crc": 1}), ("allocate_oids", {"count": 1})], "Already finalized"),
        ([digital_out(0, PA0)], "Can't assign oid"),
        ([("allocate_oids", {"count": 2}), digital_out(2, PA0)], "Can't assign oid"),
        ([("allocate_oids", {"count": 2}), digital_out(1, PA0), digital_out(1, PA1)], "Can't assign oid"),
        ([("allocate_oids", {"count": 2}), ("stepper_get_position", {"oid": 0})], "Invalid oid type"),
        (
            [("allocate_oids", {"count": 2}), digital_out(0, PA0), ("stepper_get_position", {"oid": 0})],
            "Invalid oid type",
        ),
        ([("allocate_oids", {"count": 2}), digital_out(0, 128)], "Not an output pin"),
        (
            [("allocate_oids", {"count": 1}), ("config_analog_in", {"oid": 0, "pin": 200})],
            "Not a valid ADC pin",
        ),
        (
            [("allocate_oids", {"count": 1}), ("config_endstop", {"oid": 0, "pin": 999, "pull_up": 0})],
            "Not an input pin",
        ),
        ([("set_pwm_out", {"pin": 128, "cycle_ticks": 1, "value": 0})], "Not a valid PWM pin"),
    ],
)
def test_configuration_mistakes_shut_down_with_their_text(
    mcu: Mcu, commands: list[tuple[str, dict[str, int]]], reason: str
) -> None:
    for name, values in commands:
        assert mcu.shutdown_reason() is None
        mcu.send(name, **values)
    assert mcu.shutdown_reason() == reason


def test_objects_cannot_be_added_after_finalize(mcu: Mcu) -> None:
    mcu.configure(2, digital_out(0, PA0))
    name, values = digital_out(1, PA1)
    mcu.send(name, **values)
    assert mcu.shutdown_reason() == "Can't assign oid"


def test_clock_is_the_low_half_of_the_mcu_clock_and_uptime_counts_its_wraps() -> None:
    mcu = Mcu(boot_clock=5)
    wrap_s = 2**32 / FREQ
    mcu.run(1.0)
    assert mcu.ask("get_clock")["clock"] == mcu.now == 5 + FREQ
    mcu.run(2.5 * wrap_s)
    reply = mcu.ask("get_uptime")
    assert (reply["high"], reply["clock"]) == (mcu.now >> 32, mcu.now & 0xFFFFFFFF)
    assert reply["high"] == 2


def test_statistics_come_every_five_seconds(mcu: Mcu) -> None:
    mcu.run(21)
    clocks = [reply.clock for reply in mcu.replies("stats")]
    gaps = [b - a for a, b in pairwise(clocks)]
    assert len(clocks) == 4
    assert all(5.0 * FREQ <= gap <= 5.1 * FREQ for gap in gaps)  # looked at every 100 ms


def test_emergency_stop_is_answered_by_shutdown_and_not_acknowledged(mcu: Mcu) -> None:
    answer = mcu.send("emergency_stop")
    assert [reply.name for reply in answer] == ["shutdown"]
    assert mcu.replies()[-1].name == "shutdown"  # no ack behind it
    assert mcu.shutdown_reason() == "Command request"
    assert answer[0]["clock"] == mcu.now


def test_shutdown_puts_outputs_to_their_defaults_and_refuses_commands(mcu: Mcu) -> None:
    pwm = {"oid": 2, "pin": PA2, "cycle_ticks": 1000, "value": 0, "default_value": 30, "max_duration": 0}
    mcu.configure(3, digital_out(0, PA0), digital_out(1, PA1, default_value=1), ("config_pwm_out", pwm))
    mcu.send("update_digital_out", oid=0, value=1)
    mcu.send("queue_pwm_out", oid=2, clock=mcu.now + 100, value=200)
    mcu.run(0.01)
    assert mcu.edges(PA0)[-1][1] == 1 and mcu.edges(PA1)[-1][1] == 0 and mcu.pwm_writes[-1][3] == 200
    mcu.send("emergency_stop")
    assert mcu.edges(PA0)[-1][1] == 0 and mcu.edges(PA1)[-1][1] == 1 and mcu.pwm_writes[-1][3] == 30
    (refusal,) = mcu.send("update_digital_out", oid=0, value=1)
    assert refusal.name == "is_shutdown"
    assert mcu.dictionary.shutdown_texts[refusal["static_string_id"]] == "Command request"
    assert mcu.edges(PA0)[-1][1] == 0
    for name in ("get_config", "get_clock", "get_uptime"):
        mcu.ask(name)
    assert mcu.ask("get_config")["is_shutdown"] == 1
    assert mcu.ask("debug_ping", data=b"x")["data"] == b"x"
    assert mcu.ask("identify", offset=0, count=3)["data"]


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_a_shutdown_finds_every_object_in_order_of_oid_however_they_were_configured(
    mcu: Mcu, order: tuple[int, ...]
) -> None:
    pwm = {"cycle_ticks": 1000, "value": 0, "default_value": 30, "max_duration": 0}
    outputs = [digital_out(oid, PA0 + oid, default_value=1) for oid in range(4)]
    outputs += [("config_pwm_out", {"oid": 4 + n, "pin": PA0 + 4 + n} | pwm) for n in range(4)]
    mixed = [outputs[kind + oid] for oid in order for kind in (0, 4)]
    mcu.configure(9, *mixed, ("config_trsync", {"oid": 8}))
    before = len(mcu.pin_writes), len(mcu.pwm_writes)
    mcu.send("emergency_stop")
    assert [(pin, value) for _, pin, value in mcu.pin_writes[before[0] :]][:4] == [(n, 1) for n in range(4)]
    assert [(write[1], write[3]) for write in mcu.pwm_writes[before[1] :]][:4] == [
        (4 + n, 30) for n in range(4)
    ]


def test_the_first_reason_of_a_shutdown_stays(mcu: Mcu) -> None:
    mcu.send("emergency_stop")
    mcu.send_content(bytes([90]))
    assert mcu.shutdown_reason() == "Command request"


def test_what_follows_in_a_block_after_a_shutdown_is_not_executed(mcu: Mcu) -> None:
    pings = mcu.encode("debug_ping", data=b"a"), mcu.encode("debug_ping", data=b"b")
    answer = mcu.send_content(pings[0] + mcu.encode("emergency_stop") + pings[1])
    assert [reply.name for reply in answer] == ["pong", "shutdown"]
    first = mcu.raw(make_block(mcu.sequence, pings[1]))  # the next block is taken as usual
    assert mcu.decode(0, first[:-5]).name == "pong"


def test_blocks_received_together_with_a_shutdown_are_not_lost(mcu: Mcu) -> None:
    first = make_block(mcu.sequence, mcu.encode("emergency_stop"))
    second = make_block(mcu.sequence + 1, mcu.encode("get_config"))
    mcu.raw(first + second)
    assert [reply.name for reply in mcu.replies()][-3:] == ["shutdown", "config", ""] or [
        reply.name for reply in mcu.replies()
    ][-3:] == ["config", "", "shutdown"]
    assert mcu.replies("config")[-1]["is_shutdown"] == 1


def test_clear_shutdown_gives_a_working_mcu_with_its_whole_move_queue(mcu: Mcu) -> None:
    mcu.configure(1, digital_out(0, PA0))
    move_count = mcu.ask("get_config")["move_count"]
    for _ in range(3):
        for i in range(move_count // 2 + 1):  # more than half each round: leaks would overflow
            mcu.send("queue_digital_out", oid=0, clock=mcu.now + FREQ + i, on_ticks=1)
        assert mcu.shutdown_reason() in (None, "Command request")
        mcu.send("emergency_stop")
        mcu.send("clear_shutdown")
        mcu.run(2.0)
    assert mcu.edges(PA0)[-1][1] == 0  # what was queued before the shutdown is forgotten
    mcu.send("update_digital_out", oid=0, value=1)
    assert mcu.edges(PA0)[-1][1] == 1


def test_clear_shutdown_without_shutdown_is_an_error(mcu: Mcu) -> None:
    mcu.send("clear_shutdown")
    assert mcu.shutdown_reason() == "Shutdown cleared when not shutdown"


def test_move_queue_holds_what_it_promises_and_overflows_with_its_text(mcu: Mcu) -> None:
    mcu.configure(1, digital_out(0, PA0))
    move_count = mcu.ask("get_config")["move_count"]
    for i in range(move_count):
        mcu.send("queue_digital_out", oid=0, clock=mcu.now + FREQ + i, on_ticks=1)
    assert mcu.shutdown_reason() is None
    mcu.send("queue_digital_out", oid=0, clock=mcu.now + 2 * FREQ, on_ticks=1)
    assert mcu.shutdown_reason() == "Move queue overflow"


def test_statistics_and_uptime_go_on_while_shut_down(mcu: Mcu) -> None:
    mcu.send("emergency_stop")
    mcu.run(130.0)  # two wraps
    assert len(mcu.replies("stats")) >= 25
    assert mcu.ask("get_uptime")["high"] == mcu.now >> 32 == 2


def test_reset_command_asks_for_a_reset_once_and_boot_starts_afresh(mcu: Mcu) -> None:
    mcu.configure(1, digital_out(0, PA0))
    mcu.send("reset")
    assert mcu.lib.sim_mcu_next_event() == 2**64 - 1
    assert [mcu.lib.sim_mcu_take_reset() for _ in range(2)] == [1, 0]
    mcu.boot(777)
    mcu.run_to(1777)
    assert mcu.replies()[-1].name == "starting"
    assert mcu.ask("get_config")["is_config"] == 0
    assert mcu.ask("get_uptime")["clock"] == 1777


def test_debug_memory_reads_back_and_ignores_addresses_outside(mcu: Mcu) -> None:
    mcu.send("debug_write", order=2, addr=8, val=0xDEADBEEF)
    assert mcu.ask("debug_read", order=2, addr=8)["val"] == 0xDEADBEEF
    assert mcu.ask("debug_read", order=0, addr=9)["val"] == 0xBE
    mcu.send("debug_write", order=2, addr=0xFFFFFFFE, val=1)
    assert mcu.ask("debug_read", order=2, addr=0xFFFFFFFE)["val"] == 0


def test_two_mcus_do_not_share_anything() -> None:
    one, two = Mcu(), Mcu(boot_clock=50_000)
    one.run(0.001)
    two.run(0.001)
    one.send("emergency_stop")
    assert two.ask("get_config")["is_shutdown"] == 0
    assert one.now != two.now


# ---------------------------------------------------------------- booting again in place


def static_data(mcu: Mcu) -> dict[str, bytes]:
    """The content of every static variable of the firmware in this copy of the library, by symbol."""
    listing = subprocess.run(["nm", "-S", library_path()], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listing.splitlines()]
    sized = [(int(r[0], 16), int(r[1], 16), r[3]) for r in rows if len(r) == 4 and r[2] in "bBdD"]
    anchor = next(int(r[0], 16) for r in rows if r[-1] == "sim_mcu_boot")
    base = int(mcu.ffi.cast("uintptr_t", mcu.ffi.addressof(mcu.lib, "sim_mcu_boot"))) - anchor
    return {name: bytes(mcu.ffi.buffer(mcu.ffi.cast("char *", base + at), size)) for at, size, name in sized}


def test_booting_again_leaves_no_trace_of_what_was_before() -> None:
    """After a busy life every byte of static data is as after the first boot of the same library."""
    mcu = Mcu(boot_clock=4321)
    fresh = static_data(mcu)
    assert len(fresh) > 5 and any("chip" in name for name in fresh)
    stepper = {"oid": 1, "step_pin": 3, "dir_pin": 4, "invert_step": 255, "step_pulse_ticks": 0}
    heater = {
        "oid": 3,
        "bridge": 0,
        "adc_pin": 9,
        "period_ticks": 600,
        "phase_max": 45000,
        "max_duration": 7200000,
    }
    mcu.configure(
        4,
        digital_out(0, PA0),
        ("config_stepper", stepper),
        ("config_analog_in", {"oid": 2, "pin": 8}),
        ("config_induction", heater),
    )
    query = {"sample_ticks": 50, "sample_count": 4, "rest_ticks": 10000, "bytes_per_report": 6}
    limits = {"min_value": 0, "max_value": 65535, "range_check_count": 1}
    mcu.send("query_analog_in", oid=2, clock=mcu.now + 1000, **query, **limits)
    mcu.send("reset_step_clock", oid=1, clock=mcu.now + 1000)
    mcu.send("queue_step", oid=1, interval=1000, count=100, add=3)
    mcu.send("induction_report", oid=3, enable=1)
    mcu.send("queue_induction_plan", oid=3, clock=mcu.now + 100, steps=one_step(9000))
    mcu.raw(b"\x20\x10half a block")
    mcu.run(0.0013)
    mcu.send("emergency_stop")
    assert static_data(mcu) != fresh
    mcu.boot(4321)
    again = static_data(mcu)
    assert [name for name in fresh if again[name] != fresh[name]] == []


def test_dictionary_file_lists_everything_a_host_needs(mcu: Mcu) -> None:
    plain = mcu.dictionary.plain
    assert set(plain) == {
        "app", "license", "version", "build_versions", "commands", "responses", "enumerations", "config",
    }  # fmt: skip
    config = plain["config"]
    assert (config["MCU"], config["CLOCK_FREQ"], config["ADC_MAX"], config["PWM_MAX"]) == (
        "simulator", 72_000_000, 4095, 255,
    )  # fmt: skip
    assert (config["RECEIVE_WINDOW"], config["SERIAL_BAUD"], config["STATS_SUMSQ_BASE"]) == (192, 250000, 256)
    assert config["STEPPER_STEP_BOTH_EDGE"] == 1
    pins = plain["enumerations"]["pin"]
    assert {first: pins[first] for first in ("PA0", "PH0")} == {"PA0": [0, 16], "PH0": [112, 16]}
    numbers = [*plain["commands"].values(), *plain["responses"].values()]
    assert len(numbers) == len(set(numbers))
    assert (SIM_DIR / "ferrite.dict").stat().st_size < 20000


def test_messages_are_those_of_stock_firmware_and_of_the_own_units(mcu: Mcu) -> None:
    for kind, stock in (("commands", STOCK_COMMANDS), ("responses", STOCK_RESPONSES)):
        ours = {
            text
            for text in mcu.dictionary.plain[kind]
            if not any(own in text for own in ("induction", "onoff", "supply_switch"))
        }
        assert ours == set(stock.strip().splitlines())
