"""[angle NAME]: a magnetic sensor at a motor's shaft, for the API. ANGLE_CALIBRATE and the chips' registers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import bus, manual_probe
from .accelerometer.bulk import Batches, Subscribers
from .angles.chips import FRAME_SYNC, KINDS, tle5012b_celsius
from .angles.table import POINTS, TURN, corrected, make_table, nearest

SAMPLES_PER_MESSAGE, SAMPLE_BYTES, FAILURE = 17, 3, 0xFF
START_S = 0.2  # from the command to the first sample
SPEED_MM_S, ACCEL_MM_S2 = 50.0, 1000.0
REST_S, REST_SAMPLES_S = 0.06, 0.03  # at each full step of a calibration
MIN_STEPS = 8
Batch = dict[str, Any]


class Angle:
    """Printer object 'angle NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.section, self.name = config.get_name(), config.get_name().split()[-1]
        self.kind_name = config.getchoice("sensor_type", list(KINDS))
        self.kind = KINDS[self.kind_name]
        self._period_s = config.getfloat("sample_period", 0.0004, above=0.0, maxval=1.0)
        self._stepper_name = config.get("stepper", None)
        self._table = config.getfloatlist("calibrate", None, count=POINTS)
        self.spi = bus.MCU_SPI_from_config(config, self.kind.mode, default_speed=1000000)
        self.mcu = self.spi.get_mcu()
        self.oid = self.mcu.create_oid()
        self._messages: list[Batch] = []
        self._transfer: Any = None
        self._query: Any = None
        self._first_clock = self._rest_ticks = self._shift = self._sequence = 0
        self._turns: float | None = None  # the last angle, over many turns
        self._temperature: float | None = None
        self._batches = Batches(self.printer, self._collect, self._start, self._stop, self._report)
        self._subscribers = Subscribers(self._batches.add_client, lambda: self._batches.is_running)
        self.mcu.register_config_callback(self._build_config)

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for command, text in (
            ("ANGLE_CALIBRATE", "Calibrate angle sensor to stepper motor"),
            ("ANGLE_CHIP_CALIBRATE", "Perform internal sensor calibration, if implemented"),
            ("ANGLE_DEBUG_READ", "Query register of the angle sensor"),
            ("ANGLE_DEBUG_WRITE", "Set register of the angle sensor"),
        ):
            gcode.register_mux_command(command, "CHIP", self.name, getattr(self, f"cmd_{command}"), desc=text)
        hooks = self.printer.lookup_object("webhooks", None)
        if hooks is not None:
            hooks.register_mux_endpoint("angle/dump_angle", "sensor", self.name, self._on_request)

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self.oid
        known = mcu.get_enumerations().get("spi_angle_type", {})
        kind = next((name for name in known if name == self.kind_name), self.kind_name)
        mcu.add_config_cmd(f"config_spi_angle oid={oid} spi_oid={self.spi.get_oid()} spi_angle_type={kind}")
        mcu.add_config_cmd(f"query_spi_angle oid={oid} clock=0 rest_ticks=0 time_shift=0", on_restart=True)
        queue = self.spi.get_command_queue()
        self._query = mcu.lookup_command(
            "query_spi_angle oid=%c clock=%u rest_ticks=%u time_shift=%c", cq=queue
        )
        self._transfer = mcu.lookup_query_command(
            "spi_angle_transfer oid=%c data=%*s",
            "spi_angle_transfer_response oid=%c clock=%u response=%*s",
            oid=oid,
            cq=queue,
        )
        mcu.register_response(self._messages.append, "sensor_bulk_data", oid)

    def transfer(self, data: list[int]) -> bytes:
        """One frame to the chip, and its answer."""
        return bytes(self._transfer.send([self.oid, bytes(data)])["response"])

    # -- stream --

    def _start(self) -> None:
        mcu = self.mcu
        self._rest_ticks = mcu.seconds_to_clock(self._period_s)
        # 254 units are four periods: a reading later than that is none
        self._shift = max(0, math.ceil(math.log2(max(1.0, 4.0 * self._rest_ticks / 254.0))))
        now = mcu.estimated_print_time(self.reactor.monotonic())
        self._first_clock = mcu.print_time_to_clock(now + START_S)
        self._messages.clear()
        self._sequence, self._turns = 0, None
        data = [self.oid, self._first_clock, self._rest_ticks, self._shift]
        self._query.send(data, reqclock=self._first_clock)

    def _stop(self) -> None:
        self._query.send([self.oid, 0, 0, 0])
        self._temperature = None

    def _collect(self) -> Batch:
        messages, self._messages[:] = list(self._messages), []
        rows: list[tuple[float, float]] = []
        errors = 0
        for params in messages:
            self._sequence += (params["sequence"] - self._sequence) & 0xFFFF
            data = params["data"]
            for place in range(len(data) // SAMPLE_BYTES):
                number = self._sequence * SAMPLES_PER_MESSAGE + place
                late, low, high = data[SAMPLE_BYTES * place : SAMPLE_BYTES * place + SAMPLE_BYTES]
                if late == FAILURE:
                    errors += 1
                    continue
                clock = self._first_clock + number * self._rest_ticks + (late << self._shift)
                rows.append((round(self.mcu.clock_to_print_time(clock), 6), self._unwrapped(low | high << 8)))
            self._sequence += 1
        if self.kind_name == "tle5012b" and self.kind.read is not None and messages:
            self._temperature = round(tle5012b_celsius(self.kind.read(self.transfer, FRAME_SYNC)), 1)
        return {"data": rows, "errors": errors, "position_offset": None}

    def _unwrapped(self, angle: int) -> float:
        """Over many turns, the sensor's error taken out."""
        value = corrected(angle, self._table) if self._table else float(angle)
        self._turns = value if self._turns is None else self._turns + nearest(value - self._turns)
        return round(self._turns, 1)

    def _report(self, problem: Exception) -> None:
        self.printer.lookup_object("gcode").respond_raw(
            f"!! [{self.section}]: the reading has ended: {problem}"
        )

    def _on_request(self, request: Any) -> None:
        self._subscribers.serve(request, ("time", "angle"))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"temperature": self._temperature}

    # -- commands --

    def cmd_ANGLE_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """A turn of the motor, full step by full step; beyond the limits of the axis."""
        if self._stepper_name is None:
            raise gcmd.error(f"ANGLE_CALIBRATE needs option 'stepper' in section [{self.section}]")
        force_move = self.printer.lookup_object("force_move")
        stepper = force_move.lookup_stepper(self._stepper_name)
        distance, steps = stepper.get_rotation_distance()
        full_steps = max(MIN_STEPS, round(steps / self._microsteps(gcmd)))
        table, self._table = self._table, None
        rows: list[tuple[float, float]] = []
        ending = [False]

        def take(batch: Batch) -> bool:
            rows.extend(batch["data"])
            return not ending[0]

        self._batches.add_client(take)
        try:
            seen = self._turn(stepper, distance / full_steps, full_steps, rows, force_move)
        finally:
            ending[0] = True
            self._table = table
        if self.mcu.is_fileoutput():
            return
        sign = 1.0 if seen[-1] > seen[0] else -1.0
        true = [sign * TURN * number / full_steps for number in range(full_steps)]
        self._table = make_table(true, seen)
        largest = max(map(abs, self._table)) * 360.0 / TURN
        text = ", ".join(f"{value:.1f}" for value in self._table)
        self.printer.lookup_object("configfile").set(self.section, "calibrate", text)
        manual_probe.report_save_config(
            gcmd, f"{self.section}: calibrate, the sensor was off by up to {largest:.2f} degrees"
        )

    def _microsteps(self, gcmd: GCodeCommand) -> int:
        settings = self.printer.lookup_object("configfile").get_status(0.0)["settings"]
        return int(settings.get(self._stepper_name, {}).get("microsteps", 1))

    def _turn(
        self, stepper: Any, step_mm: float, count: int, rows: list[tuple[float, float]], force_move: Any
    ) -> list[float]:
        """Mean angle at rest of each full step of a turn."""
        toolhead = self.printer.lookup_object("toolhead")
        seen = []
        for _ in range(count):
            toolhead.dwell(REST_S)
            end = toolhead.get_last_move_time()
            toolhead.wait_moves()
            while not self.mcu.is_fileoutput() and (not rows or rows[-1][0] < end):
                if not self._batches.is_running:
                    raise self.printer.command_error(f"[{self.section}] sends no samples: check its wiring")
                self.reactor.pause(self.reactor.monotonic() + 0.02)
            found = [angle for time, angle in rows if end - REST_SAMPLES_S <= time <= end]
            if not found and not self.mcu.is_fileoutput():
                raise self.printer.command_error(
                    f"[{self.section}] has sent no good sample: check wiring and magnet"
                )
            seen.append(statistics.fmean(found) if found else 0.0)
            force_move.manual_move(stepper, step_mm, SPEED_MM_S, ACCEL_MM_S2)
        return seen

    def cmd_ANGLE_CHIP_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """Of the chips that are known none needs it: a TLE5012B adjusts itself in the factory's mode."""
        gcmd.respond_info(f"The {self.kind_name} has no calibration of its own to run: use ANGLE_CALIBRATE")

    def cmd_ANGLE_DEBUG_READ(self, gcmd: GCodeCommand) -> None:
        """ANGLE_DEBUG_READ CHIP=name REG=number"""
        register = gcmd.get("REG", parser=lambda text: int(text, 0), minval=0, maxval=self.kind.max_register)
        if self.kind.read is None:
            raise gcmd.error(f"Registers of a {self.kind_name} cannot be read one by one")
        gcmd.respond_info(f"ANGLE REG[0x{register:02x}] = 0x{self.kind.read(self.transfer, register):04x}")

    def cmd_ANGLE_DEBUG_WRITE(self, gcmd: GCodeCommand) -> None:
        """ANGLE_DEBUG_WRITE CHIP=name REG=number VAL=number"""
        register = gcmd.get("REG", parser=lambda text: int(text, 0), minval=0, maxval=self.kind.max_register)
        value = gcmd.get("VAL", parser=lambda text: int(text, 0), minval=0, maxval=0xFFFF)
        write: Callable[..., None] | None = self.kind.write
        if write is None:
            raise gcmd.error(f"Registers of a {self.kind_name} cannot be written")
        write(self.transfer, register, value)


def load_config_prefix(config: ConfigWrapper) -> Angle:
    config.get_printer().load_object(config, "force_move")
    angle = Angle(config)
    angle.register()
    return angle
