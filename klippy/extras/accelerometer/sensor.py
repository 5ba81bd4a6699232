"""An accelerometer: printer object of [adxl345], [lis2dw NAME] and so on, and the dump endpoint of its kind."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

from .. import bus
from . import commands, messages
from .axes import AxesMap, read_axes_map
from .bulk import Batches, BulkReader, Params, RawHandler
from .chips import CHIPS, Chip, Write, Writes
from .recording import Recording

BATCH_HEADER = ("time", "x_acceleration", "y_acceleration", "z_acceleration")
FIFO_READS = 0.25  # of the smallest FIFO's time (32 samples), between two readings
IDENTIFY_TRIES = 3
LINE_SHARE = 0.7  # of a serial line that samples may take: acknowledgements and other messages need the rest
NOZZLE_BYTES_S = 8000.0  # of an induction heater's blocks and answers (measured: 7917)
BLOCK_BYTES = 12  # of a message around its data
BITS_PER_BYTE = 10
FROZEN_SAMPLES = 200  # alike in all bits: noise of any chip moves some bit sooner
Row = tuple[float, float, float, float]  # print time, mm/s^2 along the printer's axes


class Registers:
    """The chip's registers over its bus. Raises the printer's command_error if it does not answer."""

    def __init__(self, chip: Chip, device: Any, on_spi: bool) -> None:
        self._chip, self._device, self._on_spi = chip, device, on_spi

    def read(self, register: int) -> int:
        if self._on_spi:
            answer = self._device.spi_transfer([register | 0x80, 0x00])["response"][1:]
        else:
            answer = self._device.i2c_read([register], 1)["response"]
        return int(answer[0]) if answer else 0  # in batch mode there is none

    def write(self, register: int, value: int) -> None:
        if self._on_spi:
            self._device.spi_transfer([register, value])
        else:
            self._device.i2c_write([register, value])

    def write_all(self, writes: Writes) -> None:
        for write in writes:
            self._write_one(write)

    def _write_one(self, write: Write) -> None:
        if len(write) == 3:
            self.write(0x7F, write[0] << 4)  # the bank
        self.write(*write[-2:])
        if len(write) == 3 and write[0]:
            self.write(0x7F, 0x00)


class Accelerometer:
    """A chip and its stream of samples."""

    def __init__(
        self,
        printer: Printer,
        section: str,
        chip: Chip,
        device: Any,
        on_spi: bool,
        rate: int,
        axes_map: AxesMap,
    ) -> None:
        self.printer = printer
        self.section = section
        self.chip = chip
        self.rate = rate
        self.name = section.rsplit(maxsplit=1)[-1]
        self.registers = Registers(chip, device, on_spi)
        self._axes = axes_map
        self._device = device
        self._mcu = device.get_mcu()
        self._oid = self._mcu.create_oid()
        self._query: Any = None
        self._bulk = BulkReader(self._mcu, self._oid, chip.samples_per_message, chip.sample_bytes)
        self._batches = Batches(printer, self._collect, self._start, self._stop, self._report_error)
        self._raw_handlers: list[RawHandler] = []
        self._row_clients = 0
        self._rows: list[Row] = []
        self._errors = 0
        self._same = 0
        self._last_raw = b""
        self._is_clipped = False
        self._bus_name = "spi" if on_spi else "i2c"
        self._mcu.register_config_callback(self._build_config)

    def register(self) -> None:
        commands.register(self.printer, self)
        hooks = self.printer.lookup_object("webhooks", None)
        if hooks is not None:
            kind = self.section.split(maxsplit=1)[0]
            hooks.register_mux_endpoint(f"{kind}/dump_{kind}", "sensor", self.name, self._on_request)
        self.printer.register_event_handler("klippy:ready", self._check_line)

    # --- set-up ---

    def _build_config(self) -> None:
        mcu, chip = self._mcu, self.chip
        bus_oid = self._device.get_oid()
        kind = self._of_enumeration("lis_chip_type", chip.message_values.get("lis_chip_type"))
        bus_type = self._of_enumeration("bus_oid_type", self._bus_name)
        messages.configure(mcu, chip.command, self._oid, bus_oid, bus_type, kind)
        queue = self._device.get_command_queue()
        self._query = messages.query(mcu, chip.command, queue)
        self._bulk.build(messages.status(mcu, chip.command, self._oid, queue))

    def _of_enumeration(self, name: str, value: Any) -> Any:
        """The firmware's spelling of a choice."""
        known = self._mcu.get_enumerations().get(name, {})
        return next((text for text in known if text.lower() == str(value).lower()), value)

    def _line_rate(self) -> float:
        """Samples a second that the board's serial line carries beside its other messages; no limit on USB."""
        baud = self._mcu.get_constants().get("SERIAL_BAUD")
        if baud is None or self._mcu.is_fileoutput():
            return math.inf
        free = LINE_SHARE * float(baud) / BITS_PER_BYTE - (NOZZLE_BYTES_S if self._has_nozzle() else 0.0)
        block = self.chip.samples_per_message * self.chip.sample_bytes + BLOCK_BYTES
        return max(0.0, free / block * self.chip.samples_per_message)

    def _has_nozzle(self) -> bool:
        """Is the board also that of an induction heater?"""
        heaters = self.printer.lookup_objects("induction_heater")
        return any(section.heater.unit.mcu is self._mcu for _, section in heaters)

    def _check_line(self) -> None:
        """Say so where the serial line cannot carry the rate."""
        if self.rate > self._line_rate():
            self.printer.lookup_object("gcode").respond_info(self._describe_line())

    def _describe_line(self) -> str:
        fits = self._line_rate()
        slower = [rate for rate in self.chip.rates if rate <= fits]
        advice = f"Set rate: {max(slower)}, or connect it" if slower else "Connect it"
        return (
            f"[{self.section}] takes {self.rate} samples a second; the serial line of mcu '{self._mcu.get_name()}' has"
            f" room for {fits:.0f} beside its other messages. {advice} to a board with USB."
        )

    # --- stream ---

    def add_client(self, client: Callable[[Params], bool]) -> None:
        """Each batch goes to `client` until it returns False. Raises command_error if the chip does not answer."""
        self._row_clients += 1

        def counted(batch: Params) -> bool:
            wants_more = client(batch)
            self._row_clients -= not wants_more
            return wants_more

        try:
            self._batches.add_client(counted)
        except self.printer.command_error:
            self._row_clients -= 1
            raise

    def add_raw_client(self, handler: RawHandler, client: Callable[[Params], bool], period_s: float) -> None:
        """Each message goes to `handler`; then `client` gets the batch, its rows only if others want them."""
        self._batches.add_client(client, period_s)
        self._raw_handlers.append(handler)

    @property
    def is_running(self) -> bool:
        return self._batches.is_running

    def rate_hz(self) -> float:
        """Of the chip's own clock, while it runs."""
        return self._bulk.rate_hz()

    def time_of(self, number: float) -> float:
        """Print time of a sample, while it runs."""
        return self._bulk.time_of(number)

    @property
    def axes(self) -> AxesMap:
        return self._axes

    def start_internal_client(self) -> Recording:
        """Measure from now on, until finish_measurements() of what is returned."""
        recording = Recording(self.printer, self.section)
        self.add_client(recording.take)
        return recording

    def identify(self) -> None:
        """Raises command_error if it is not the chip that the section names."""
        chip, found = self.chip, 0
        for _ in range(IDENTIFY_TRIES):
            if chip.spi_wakes_by_reading and self._bus_name == "spi":
                self.registers.read(0x7F)
            self.registers.write_all(chip.wake)
            found = self.registers.read(chip.identity_register)
            if found in chip.identities:
                return
        if found in (0x00, 0xFF):
            hint = "Nothing answers: check its power, its wires, cs_pin and the bus."
        else:
            names = [c.name for c in CHIPS.values() if found in c.identities]
            hint = (
                f"That is a {names[0]}."
                if names
                else "Check the wires, and that the section names the right chip."
            )
        raise self.printer.command_error(
            f"[{self.section}]: invalid {chip.name} id: 0x{found:02x}, expected 0x{chip.identities[0]:02x}. {hint}"
        )

    def _start(self) -> None:
        if self.rate > self._line_rate() and self._has_nozzle():
            # The nozzle's thermometer would lose its blocks, and the heater would shut down.
            raise self.printer.command_error(self._describe_line())
        self.identify()
        self.registers.write_all(self.chip.prepare(self.rate))
        rest_s = FIFO_READS * 32.0 / self.rate
        self._query.send([self._oid, self._mcu.seconds_to_clock(rest_s)])
        self.registers.write_all(self.chip.run)
        self._bulk.start(self.rate)
        self._errors = self._same = 0
        self._last_raw, self._is_clipped = b"", False

    def _stop(self) -> None:
        self._raw_handlers = []
        self._row_clients = 0
        self._query.send([self._oid, 0])
        self.registers.write_all(self.chip.stop)

    def _collect(self) -> Params:
        before = self._bulk.overflows + self._bulk.lost_messages
        self._bulk.update()
        self._rows = []
        errors = self._errors
        self._bulk.take(self._take_sample if self._row_clients else None, self._raw_handlers)
        new = self._bulk.overflows + self._bulk.lost_messages - before
        return {
            "data": self._rows,
            "errors": self._errors - errors,
            "overflows": new,
            "fault": self.find_fault(),
        }

    def _take_sample(self, raw: bytes, print_time: float) -> None:
        counts = self._unpack(raw)
        if counts is None:
            self._errors += 1
            return
        self._same = self._same + 1 if raw == self._last_raw else 0
        self._last_raw = raw
        scale = self.chip.mm_s2_per_count
        limit = 0.995 * self.chip.range_g * 9806.65 / scale
        self._is_clipped = self._is_clipped or max(abs(c) for c in counts) >= limit
        x, y, z = ((1 if a > 0 else -1) * counts[abs(a) - 1] * scale for a in self._axes)
        self._rows.append((round(print_time, 6), round(x, 6), round(y, 6), round(z, 6)))

    def _unpack(self, raw: bytes) -> tuple[int, int, int] | None:
        """Counts along the sensor's axes; None where the firmware says that it is no sample."""
        if self.chip.sample_bytes == 5:
            if raw[4] & 0x80:
                return None
            x = raw[0] | (raw[3] & 0x1F) << 8
            y = raw[1] | (raw[4] & 0x1F) << 8
            z = raw[2] | (raw[3] & 0xE0) << 3 | (raw[4] & 0x60) << 6
            return (x ^ 0x1000) - 0x1000, (y ^ 0x1000) - 0x1000, (z ^ 0x1000) - 0x1000
        order: Any = self.chip.byte_order
        x, y, z = (int.from_bytes(raw[at : at + 2], order, signed=True) for at in (0, 2, 4))
        return x, y, z

    def find_fault(self) -> str | None:
        """What is wrong with the samples so far: "unplugged", "frozen", "saturated" or nothing."""
        if self._errors:
            return "unplugged"
        if self._is_clipped:
            return "saturated"
        return "frozen" if self._same >= FROZEN_SAMPLES else None

    def _report_error(self, problem: Exception) -> None:
        logging.warning("%s: %s", self.section, problem)
        self.printer.lookup_object("gcode").respond_raw(
            f"!! [{self.section}]: the measurement has ended: {problem}"
        )

    # --- API ---

    def _on_request(self, request: Any) -> None:
        template = request.get_dict("response_template", {})
        connection = request.get_client_connection()

        def send(batch: Params) -> bool:
            if connection.is_closed():
                return False
            params = {key: value for key, value in batch.items() if key != "fault"}
            connection.send({**template, "params": params})
            return True

        self.add_client(send)
        request.send({"header": BATCH_HEADER})


def load(config: ConfigWrapper) -> Accelerometer:
    """The accelerometer of a section, whose first word is the chip's name."""
    section = config.get_name()
    chip = CHIPS[section.split(maxsplit=1)[0]]
    rate = config.getchoice("rate", {rate: rate for rate in chip.rates}, chip.default_rate)
    axes_map = read_axes_map(config)
    on_spi = chip.buses[0] == "spi" and (len(chip.buses) == 1 or config.get("cs_pin", None) is not None)
    device: Any
    if on_spi:
        mode = 0 if chip.name == "bmi160" else 3
        device = bus.MCU_SPI_from_config(config, mode, default_speed=5000000)
    else:
        device = bus.MCU_I2C_from_config(config, chip.address, 400000)
    sensor = Accelerometer(config.get_printer(), section, chip, device, on_spi, rate, axes_map)
    sensor.register()
    return sensor
