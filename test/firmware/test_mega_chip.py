"""The ATmega2560's image at work: steps, outputs, inputs at their clocks, and what that costs."""

from __future__ import annotations

from itertools import pairwise

import pytest

from mega_rig import BOTH_EDGES, MEGA_HZ, STEP_PINS, Mega, run_steps, stepping

PF0, PF3, PB4, PH6, PL0, PE4, PK5, PK6 = 40, 43, 12, 62, 80, 36, 77, 78
# An edge comes after its clock by the way into the interrupt, and by an overflow's or a byte's interrupt before it.
LATENESS = round(40e-6 * MEGA_HZ)


def late(mega: Mega, clock: int, nominal: int) -> int:
    """Cycles by which a board clock is behind a chip clock."""
    return (mega.chip_clock(clock) - nominal + 2**31) % 2**32 - 2**31


# ---------------------------------------------------------------- steps


def test_steps_come_at_their_clocks_and_never_drift() -> None:
    mega = stepping(3)
    begin = run_steps(mega, 3, 3210, 500)
    for before, (step_pin, _) in enumerate(STEP_PINS[:3]):  # at the same clocks: they wait for one another
        edges = [clock for clock, _ in mega.edges(step_pin)][1:]
        assert len(edges) == 500
        delays = [late(mega, clock, begin + 3210 * (i + 1)) for i, clock in enumerate(edges)]
        assert min(delays) >= 0 and max(delays) < LATENESS + before * 200


def test_alarms_before_at_and_after_the_counter_s_wrap_arrive() -> None:
    # compare values all over the counter, then just before the overflow, at it, and a whole round away
    mega = stepping(1)
    clock = (mega.clock_in(0.1) + 0xFFFF & ~0xFFFF & 0xFFFFFFFF) - 40
    mega.send("reset_step_clock", oid=0, clock=clock)
    count = 4 * 65536 // 6007 + 40
    mega.send("queue_step", oid=0, interval=6007, count=count, add=0)
    mega.send(
        "queue_step", oid=0, interval=65536 - 6007 * count % 65536, count=1, add=0
    )  # exactly 40 before a wrap
    for at in (30, 10, 1, 65536, 65536, 65535, 65537):
        mega.send("queue_step", oid=0, interval=at if at > 5000 else 65536 + at, count=1, add=0)
    mega.run(0.1 + (6007 * count + 9 * 65600) / MEGA_HZ)
    nominal = [clock + 6007 * (i + 1) for i in range(count)]
    nominal.append(nominal[-1] + 65536 - 6007 * count % 65536)
    for at in (65566, 65546, 65537, 65536, 65536, 65535, 65537):
        nominal.append(nominal[-1] + at)
    edges = [clock for clock, _ in mega.edges(PF0)][1:]
    delays = [late(mega, clock, due & 0xFFFFFFFF) for clock, due in zip(edges, nominal, strict=True)]
    assert min(delays) >= 0 and max(delays) < LATENESS


def test_clock_is_right_also_in_the_very_cycles_of_an_overflow() -> None:
    mega = Mega()
    start = mega.now
    way = (
        mega.ask("get_clock")["clock"] - mega.chip_clock(start)
    ) & 0xFFFF  # from the first byte to the reading
    for i in range(-60, 60):
        ahead = (-(mega.chip_clock(mega.now) + way) + i) % 65536
        mega.run_to(mega.now + ahead)
        sent = mega.now
        delay = late(mega, sent + way, mega.ask("get_clock")["clock"])
        # an overflow's or the house-keeping timer's interrupt may come before the reading; a mistake would be 65536
        assert abs(delay) < 1000


@pytest.mark.parametrize("phase", range(6))
def test_an_output_may_be_asked_for_at_the_last_moment(phase: int) -> None:
    """Nearer and nearer, until it is in the past: on time, or refused; never a round of the counter late."""
    mega = Mega()
    lamp = {"oid": 0, "pin": PB4, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(1, ("config_digital_out", lamp))
    ahead = 10400 + phase  # the message itself takes some 10300 on the line and in the receiver
    while not mega.shutdown_reason():
        before, clock = len(mega.edges(PB4)), mega.clock_in(ahead / MEGA_HZ)
        mega.send("queue_digital_out", oid=0, clock=clock, on_ticks=before % 2)
        mega.run(0.006 + phase * 1e-6)
        if len(mega.edges(PB4)) > before:
            # the command itself may hold the interrupt up for its own time
            assert 0 <= late(mega, mega.edges(PB4)[-1][0], clock) < LATENESS + 200
        ahead -= 3
    assert mega.shutdown_reason() == "Timer too close" and 10000 < ahead < 10380


def test_pulses_last_as_configured_and_direction_is_set_before() -> None:
    mega = stepping(1, invert_step=0, pulse_ticks=64)
    clock = mega.clock_in(0.1)
    mega.send("reset_step_clock", oid=0, clock=clock)
    mega.send("set_next_step_dir", oid=0, dir=1)
    mega.send("queue_step", oid=0, interval=5000, count=20, add=7)
    mega.run(0.15)
    edges = mega.edges(PF0)[1:]
    rising = [clock for clock, level in edges if level]
    falling = [clock for clock, level in edges if not level]
    assert len(rising) == len(falling) == 20
    # the pulse's end is a timer of its own, 4 us later; what the step itself takes makes it longer
    assert all(64 <= down - up < 64 + 600 for up, down in zip(rising, falling, strict=True))
    assert mega.edges(41)[-1][1] == 1 and mega.edges(41)[-1][0] < rising[0]
    assert mega.ask("stepper_get_position", oid=0)["pos"] == 20


def test_bytes_are_not_lost_while_three_motors_step_as_fast_as_they_can() -> None:
    mega = stepping(3)
    clock = mega.clock_in(0.05)
    interval = 1000  # 48 k steps/s in all
    for oid in range(3):
        mega.send("reset_step_clock", oid=oid, clock=clock)
        mega.send("queue_step", oid=oid, interval=interval, count=3000, add=0)
    mega.run(0.06)
    payloads = [bytes([i] * 40) for i in range(12)]
    pongs = []
    for payload in payloads:
        pongs += [reply["data"] for reply in mega.send("debug_ping", data=payload)]
    mega.run(0.3)
    assert pongs == payloads
    assert mega.chip.counters()["console_overruns"] == 0
    assert [len(mega.edges(pin)) - 1 for pin, _ in STEP_PINS[:3]] == [3000] * 3
    # the deepest there is: a response being encoded, timers on top of it, a byte's interrupt on top of them
    counters = mega.chip.counters()
    space = counters["stack_top"] - counters["stack_limit"]
    assert space / 2 < counters["stack_top"] - counters["stack_low"] < 0.75 * space


def test_a_display_s_bytes_hold_up_no_step() -> None:
    """The longest message of an ST7920 keeps the task busy for 1.4 ms; steps are interrupts."""
    mega = Mega()
    steppers = [
        ("config_stepper", {"oid": oid, "step_pin": step, "dir_pin": direction, "invert_step": BOTH_EDGES,
                            "step_pulse_ticks": 0})
        for oid, (step, direction) in enumerate(STEP_PINS[:2])
    ]  # fmt: skip
    delay = {"sync_delay_ticks": 1152, "cmd_delay_ticks": 1152}
    display = {"oid": 2, "cs_pin": 16, "sclk_pin": 17, "sid_pin": 18, **delay}
    mega.configure(3, *steppers, ("config_st7920", display))
    clock, interval, count = mega.clock_in(0.05), 2000, 2400  # 16 k steps/s in all, for 0.3 s
    for oid in range(2):
        mega.send("reset_step_clock", oid=oid, clock=clock)
        mega.send("queue_step", oid=oid, interval=interval, count=count, add=0)
    mega.run(0.06)
    for value in range(32):  # a quarter of the picture
        mega.send("st7920_send_data", oid=2, data=bytes([value] * 16))
    mega.run(0.3)
    assert len(mega.edges(17)) > 32 * 17 * 16
    for before, (step, _) in enumerate(STEP_PINS[:2]):
        edges = [at for at, _ in mega.edges(step)][1:]
        delays = [late(mega, at, clock + interval * (i + 1) & 0xFFFFFFFF) for i, at in enumerate(edges)]
        assert len(delays) == count and min(delays) >= 0 and max(delays) < LATENESS + before * 200
    assert mega.chip.counters()["console_overruns"] == 0


# ---------------------------------------------------------------- outputs


def test_software_pwm_has_its_on_time_and_period() -> None:
    mega = Mega()
    heater = {"oid": 0, "pin": PB4, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(
        1, ("config_digital_out", heater), ("set_digital_out_pwm_cycle", {"oid": 0, "cycle_ticks": 160000})
    )
    clock = mega.clock_in(0.05)
    mega.send("queue_digital_out", oid=0, clock=clock, on_ticks=40000)
    for i in range(4):  # updates while it toggles, whenever they come: at the very clock of an edge as well
        mega.send("queue_digital_out", oid=0, clock=clock + 1600000 * (i + 1), on_ticks=40000)
        mega.run(0.0437)
    mega.run(0.4)
    edges = mega.edges(PB4)[1:]
    assert len(edges) > 60 and mega.shutdown_reason() is None
    for i, (when, level) in enumerate(edges):
        nominal = clock + i // 2 * 160000 + (0 if level else 40000)
        assert 0 <= late(mega, when, nominal) < LATENESS


def test_an_update_may_come_while_an_edge_is_due() -> None:
    """Regression: on a chip, where time does not stand still, this was "Timer too close"."""
    mega = Mega()
    heater = {"oid": 0, "pin": PB4, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(
        1, ("config_digital_out", heater), ("set_digital_out_pwm_cycle", {"oid": 0, "cycle_ticks": 2000})
    )
    clock = mega.clock_in(0.02)
    mega.send("queue_digital_out", oid=0, clock=clock, on_ticks=1000)
    mega.run(0.03)
    for i in range(60):
        mega.run(0.001 + i * 7e-7)
        mega.send("queue_digital_out", oid=0, clock=mega.clock_in(0.003), on_ticks=1000)
    assert mega.shutdown_reason() is None


def test_silent_host_leaves_no_heater_on() -> None:
    mega = Mega()
    heater = {"oid": 0, "pin": PB4, "value": 0, "default_value": 0, "max_duration": MEGA_HZ // 10}
    mega.configure(1, ("config_digital_out", heater))
    mega.send("queue_digital_out", oid=0, clock=mega.clock_in(0.05), on_ticks=1)
    mega.run(0.3)
    assert mega.shutdown_reason() == "Missed scheduling of next digital out event"
    (_, on), (_, off) = mega.edges(PB4)[-2:]
    assert (on, off) == (1, 0)


@pytest.mark.parametrize(("wanted", "made"), [(1, 510), (2000, 510), (50000, 510 * 64), (10**9, 510 * 1024)])
def test_hardware_pwm_takes_the_nearest_period(wanted: int, made: int) -> None:
    mega = Mega()
    fan = {"oid": 0, "pin": PE4, "cycle_ticks": wanted, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(1, ("config_pwm_out", fan))
    clock = mega.clock_in(0.02)
    mega.send("queue_pwm_out", oid=0, clock=clock, value=99)
    mega.run(0.05)
    when, pin, cycle, value = mega.pwm_writes[-1]
    assert (pin, cycle, value) == (PE4, made, 99) and 0 <= late(mega, when, clock) < LATENESS


def test_channels_of_one_timer_share_their_period_and_other_pins_have_none() -> None:
    def config(oid: int, pin: int, cycle: int) -> tuple[str, dict[str, int]]:
        values = {"pin": pin, "cycle_ticks": cycle, "value": 0, "default_value": 0, "max_duration": 0}
        return "config_pwm_out", {"oid": oid, **values}

    mega = Mega()
    mega.configure(2, config(0, PB4, 4000), config(1, PH6, 4100))  # both on timer 2
    for pins, text in (
        ((PB4, PH6), "PWM already programmed at different speed"),
        ((PB4, PL0), "Not a valid PWM pin"),
    ):
        mega = Mega()
        mega.send("allocate_oids", count=2)
        for oid, (pin, cycle) in enumerate(zip(pins, (4000, 400000), strict=True)):
            name, values = config(oid, pin, cycle)
            mega.send(name, **values)
        mega.run(0.01)
        assert mega.shutdown_reason() == text


# ---------------------------------------------------------------- inputs


def test_two_thermistors_share_the_converter_and_each_gets_its_own_value() -> None:
    mega = Mega()
    mega.adc_code = lambda pin, clock: {PK5: 1000 * 4 + 3, PK6: 77 * 4}[pin]
    inputs = [("config_analog_in", {"oid": oid, "pin": pin}) for oid, pin in enumerate((PK5, PK6))]
    mega.configure(2, *inputs)
    clock = mega.clock_in(0.05)
    for oid in (0, 1):  # at the very same clocks
        mega.send("query_analog_in", oid=oid, clock=clock, sample_ticks=16000, sample_count=8, rest_ticks=1600000,
                  bytes_per_report=2, min_value=0, max_value=0xFFFF, range_check_count=4)  # fmt: skip
    mega.run(1.0)
    for oid, expected in ((0, 8 * 1000), (1, 8 * 77)):
        values = [
            int.from_bytes(r["values"], "little") for r in mega.replies("analog_in_state") if r["oid"] == oid
        ]
        assert len(values) == 10 and set(values) == {expected}


def test_a_broken_thermistor_shuts_down_and_switches_the_heater_off() -> None:
    mega = Mega()
    codes = [2000]
    mega.adc_code = lambda pin, clock: codes[0]
    heater = {"oid": 1, "pin": PB4, "value": 0, "default_value": 0, "max_duration": 0}
    mega.configure(2, ("config_analog_in", {"oid": 0, "pin": PK5}), ("config_digital_out", heater))
    mega.send("query_analog_in", oid=0, clock=mega.clock_in(0.02), sample_ticks=16000, sample_count=4,
              rest_ticks=160000, bytes_per_report=2, min_value=400, max_value=3600, range_check_count=3)  # fmt: skip
    mega.send("queue_digital_out", oid=1, clock=mega.clock_in(0.05), on_ticks=1)
    mega.run(0.2)
    assert mega.shutdown_reason() is None and mega.edges(PB4)[-1][1] == 1
    codes[0] = 4095
    broken = mega.now
    mega.run(0.1)
    assert mega.shutdown_reason() == "ADC out of range"
    when, level = mega.edges(PB4)[-1]
    assert level == 0 and when - broken < 4 * 160000  # three groups in a row, and the one under way


def test_pins_without_a_converter_or_with_a_pull_down_are_refused() -> None:
    for command, text in (
        (("config_analog_in", {"oid": 0, "pin": PB4}), "Not a valid ADC pin"),
        (("config_endstop", {"oid": 0, "pin": PL0, "pull_up": 0xFF}), "Not an input pin"),
        (("config_endstop", {"oid": 0, "pin": 54, "pull_up": 1}), "Not an input pin"),  # PG6: not on this chip
        (("config_digital_out", {"oid": 0, "pin": 32, "value": 0, "default_value": 0, "max_duration": 0}),
         "Not an output pin"),  # PE0 is the console's
    ):  # fmt: skip
        mega = Mega()
        mega.send("allocate_oids", count=1)
        mega.send(command[0], **command[1])
        mega.run(0.01)
        assert mega.shutdown_reason() == text


def test_endstop_stops_the_motor_and_reports_the_touch() -> None:
    mega = Mega()
    touched: list[int] = []

    def level(pin: int, clock: int) -> int:
        return int(bool(touched) and pin == PL0 and clock >= touched[0])

    mega.input_level = level
    step, direction = STEP_PINS[0]
    stepper = {
        "oid": 0,
        "step_pin": step,
        "dir_pin": direction,
        "invert_step": BOTH_EDGES,
        "step_pulse_ticks": 0,
    }
    endstop = {"oid": 1, "pin": PL0, "pull_up": 1}
    mega.configure(3, ("config_stepper", stepper), ("config_endstop", endstop), ("config_trsync", {"oid": 2}))
    clock = mega.clock_in(0.05)
    mega.send("reset_step_clock", oid=0, clock=clock)
    mega.send("trsync_start", oid=2, report_clock=0, report_ticks=0, expire_reason=2)
    mega.send("stepper_stop_on_trigger", oid=0, trsync_oid=2)
    mega.send("endstop_home", oid=1, clock=clock, sample_ticks=240, sample_count=4, rest_ticks=8000, pin_value=1,
              trsync_oid=2, trigger_reason=1)  # fmt: skip
    mega.send("queue_step", oid=0, interval=4000, count=60000, add=0)
    mega.run(0.1)
    touched.append(mega.now)
    mega.run(0.05)
    (state,) = mega.replies("trsync_state")
    assert (state["can_trigger"], state["trigger_reason"]) == (0, 1)
    rest, samples = 8000, 5 * 240
    assert 0 < late(mega, touched[0], state["clock"]) * -1 < rest + samples + LATENESS
    last_step = mega.edges(step)[-1][0]
    assert last_step - touched[0] < rest + samples + 4000
    assert mega.ask("stepper_get_position", oid=0)["pos"] == -(len(mega.edges(step)) - 1)


def test_spi_exchanges_bytes_with_what_is_on_the_bus() -> None:
    mega = Mega()
    mega.spi_reply = lambda bus, sent: bytes(byte ^ 0xFF for byte in sent)
    mega.configure(
        1,
        ("config_spi", {"oid": 0, "pin": PF3, "cs_active_high": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 3, "rate": 1_000_000}),
    )
    reply = mega.ask("spi_transfer", oid=0, data=b"\x12\x34\x56")
    assert reply["response"] == b"\xed\xcb\xa9"
    assert [(mode, sent) for _, _, mode, sent in mega.spi_transfers] == [
        (3, b"\x12"),
        (3, b"\x34"),
        (3, b"\x56"),
    ]
    first, second = (clock for clock, _, _, _ in mega.spi_transfers[:2])
    assert 8 * 16 <= second - first < 8 * 16 + 80  # one byte at 16 MHz / 16, and the loop
    assert [level for _, level in mega.edges(PF3)][-2:] == [0, 1]


# ---------------------------------------------------------------- I2C by hardware


def i2c_device(rate: int = 100_000) -> Mega:
    mega = Mega()
    bus = {"oid": 0, "i2c_bus": 0, "rate": rate, "address": 0x48}
    mega.configure(1, ("config_i2c", {"oid": 0}), ("i2c_set_bus", bus))
    return mega


def i2c_status(mega: Mega, number: int) -> str:
    names = mega.dictionary.plain["enumerations"]["i2c_bus_status"]
    return next(name for name, value in names.items() if value == number)


def test_i2c_writes_and_reads_in_one_transfer() -> None:
    mega = i2c_device()
    mega.i2c_reply = lambda address, wrote, count: (0, bytes(range(7, 7 + count)))
    for reading in (1, 2, 5):
        answer = mega.ask("i2c_transfer", oid=0, write=b"\x12\x34", read_len=reading)
        assert answer["response"] == bytes(range(7, 7 + reading))
        assert i2c_status(mega, answer["i2c_bus_status"]) == "SUCCESS"
        bus, address, written, _ = mega.i2c_transfers[-1]
        assert (bus, address, written) == (0, 0x48, b"\x12\x34")
    mega.ask("i2c_transfer", oid=0, write=b"\x01\x02\x03", read_len=0)
    assert mega.i2c_transfers[-1] == (0, 0x48, b"\x01\x02\x03", 0)


@pytest.mark.parametrize("rate", [12_000, 30_000, 100_000, 250_000, 400_000, 3_400_000])
def test_i2c_is_as_fast_as_asked_for_and_no_faster_than_the_chip(rate: int) -> None:
    mega, length = i2c_device(rate), min(20, rate // 4000)  # the contract gives a transfer 5 ms
    cycles = []  # polled: the processor is busy all the time. A byte costs some 500 cycles beside its nine bits
    for count in (length, 1):
        before, end = mega.busy_cycles(), mega.now + MEGA_HZ // 5
        answer = mega.ask("i2c_transfer", oid=0, write=bytes(count), read_len=0)
        assert i2c_status(mega, answer["i2c_bus_status"]) == "SUCCESS"
        mega.run_to(end)
        cycles.append(mega.busy_cycles() - before)
    fastest = 9 * (length - 1) * MEGA_HZ / min(rate, 400_000)
    assert fastest - 400 <= cycles[0] - cycles[1] < 1.06 * fastest + 600 * length


def test_a_device_that_is_not_there_is_reported_and_the_bus_goes_on() -> None:
    mega = i2c_device()
    mega.i2c_reply = lambda address, wrote, count: (3, bytes(count))
    for wrote, reading, status in ((b"\x01", 1, "START_NACK"), (b"", 3, "START_READ_NACK")):
        answer = mega.ask("i2c_transfer", oid=0, write=wrote, read_len=reading)
        assert (i2c_status(mega, answer["i2c_bus_status"]), answer["response"]) == (status, b"")
    mega.i2c_reply = lambda address, wrote, count: (0, b"\x2a" * count)
    assert mega.ask("i2c_transfer", oid=0, write=b"\x01", read_len=1)["response"] == b"\x2a"


# ---------------------------------------------------------------- LED chains

LED_PIN = 83  # PL3: its port lies above 0x100


def leds(count: int, *others: tuple[str, dict[str, int]], oids: int = 1) -> Mega:
    mega = Mega()
    chain = {"oid": 0, "pin": LED_PIN, "data_size": count, "bit_max_ticks": 64, "reset_min_ticks": 800}
    mega.configure(oids, ("config_neopixel", chain), *others)
    return mega


def test_a_led_chain_gets_its_bits_with_the_length_of_pulse_that_both_kinds_of_led_take() -> None:
    mega, data = leds(30), bytes((37 * i + 11) & 0xFF for i in range(30))
    mega.send("neopixel_update", oid=0, pos=0, data=data)
    begin = len(mega.edges(LED_PIN))
    assert mega.ask("neopixel_send", oid=0)["success"] == 1
    edges = mega.edges(LED_PIN)[begin:]
    rising = [clock for clock, level in edges if level]
    high = [down - up for up, (down, level) in zip(rising, edges[1::2], strict=True) if not level]
    assert len(high) == 8 * len(data) and set(high) == {5, 11}  # 312 ns and 688 ns
    bits = "".join("1" if cycles == 11 else "0" for cycles in high)
    assert int(bits, 2).to_bytes(len(data), "big") == data
    low = [up - down for (down, _), up in zip(edges[1::2], rising[1:], strict=False)]
    assert min(low) > 8 and max(low) < 64  # 450 ns at least, under what the LEDs take for the end


def test_a_led_chain_that_an_interrupt_has_stretched_is_reported_to_be_sent_again() -> None:
    step, direction = STEP_PINS[0]
    motor = {
        "oid": 1,
        "step_pin": step,
        "dir_pin": direction,
        "invert_step": BOTH_EDGES,
        "step_pulse_ticks": 0,
    }
    mega = leds(60, ("config_stepper", motor), oids=2)
    mega.send("neopixel_update", oid=0, pos=0, data=bytes(50))
    answers = []
    for interval in (8000, 400000):
        mega.send("reset_step_clock", oid=1, clock=mega.clock_in(0.01))
        mega.send("queue_step", oid=1, interval=interval, count=20, add=0)
        mega.run(0.011)
        begin = len(mega.edges(LED_PIN))
        answers.append(mega.ask("neopixel_send", oid=0)["success"])
        edges = mega.edges(LED_PIN)[begin:]
        assert {down - up for (up, level), (down, _) in pairwise(edges) if level} == {5}
        assert (len(edges) == 2 * 8 * 60) == bool(answers[-1]) and edges[-1][1] == 0
        mega.run(0.6)
        assert len(mega.edges(step)) - 1 == 20 * len(answers) and mega.shutdown_reason() is None
    assert answers == [0, 1]
