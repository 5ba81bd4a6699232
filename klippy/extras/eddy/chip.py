"""The LDC1612: registers, rate, frequency, and LDC_CALIBRATE_DRIVE_CURRENT (data sheet SNOSCY9)."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .. import bus, manual_probe
from ..accelerometer.messages import STATUS
from ..probing.stream import Sample, SampleStream

ADDRESS = 42
RATE_HZ = 250.0
CODE_BITS = 28
CODE_MAX = (1 << CODE_BITS) - 1
LOOKS_PER_SAMPLE = 4.0
SETTLE_S = 0.005
FIN_DIVIDER_MAX = 15
REFERENCE_RATIO = 4.0  # the reference must be faster than the divided sensor by more than this
CALIBRATE_S = 0.1
DRIVE_DEFAULT = 15
(RCOUNT0, OFFSET0, SETTLECOUNT0, DIVIDERS0, ERROR_CONFIG, CONFIG, MUX_CONFIG, RESET_DEV, DRIVE0) = (
    0x08, 0x0C, 0x10, 0x14, 0x19, 0x1A, 0x1B, 0x1C, 0x1E,
)  # fmt: skip
MAKER, DEVICE = (0x7E, 0x5449), (0x7F, 0x3055)
# CONFIG: reserved bit 0; channel 0; the reference from CLKIN; current override, no automatic amplitude
ALWAYS, NO_INTB, EXTERNAL_CLOCK, NO_AUTO, OVERRIDE, SLEEP = 1, 1 << 7, 1 << 9, 1 << 10, 1 << 12, 1 << 13
READY_TO_INTB = 1  # ERROR_CONFIG: data ready
MUX_DEGLITCH = ((1e6, 1), (3.3e6, 4), (10e6, 5), (33e6, 7))
MUX_ALWAYS = 0x0208


class Ldc1612:
    """The chip of a section; `stream` has frequencies (Hz) with their times."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.section = config.get_name()
        self.name = self.section.split()[-1]
        config.getchoice("sensor_type", ["ldc1612"])
        clock_hz = config.getfloat("frequency", 12e6, minval=2e6, maxval=40e6)
        self.max_hz = config.getfloat("max_sensor_hz", 5e6, above=1e3, maxval=10e6)
        self._drive = config.getint("reg_drive_current", DRIVE_DEFAULT, minval=0, maxval=31)
        self._divider = next(
            n
            for n in (*range(1, FIN_DIVIDER_MAX + 1), 0)
            if n == 0 or clock_hz > REFERENCE_RATIO * self.max_hz / n
        )
        if self._divider == 0:
            raise config.error(
                f"Option 'max_sensor_hz' in section '{self.section}' ({config.where('max_sensor_hz')}): too high for a"
                f" clock of {clock_hz:.0f} Hz (option 'frequency')"
            )
        self._clock_hz = clock_hz
        self.i2c = bus.MCU_I2C_from_config(config, ADDRESS, 400000)
        self.mcu = self.i2c.get_mcu()
        self._intb = self._read_intb(config)
        self.oid = self.mcu.create_oid()
        self._query: Any = None
        self.stream = SampleStream(self.mcu, self.oid, self.unpack, self._start, self._stop, self.section)
        self.mcu.register_config_callback(self._build_config)

    def _read_intb(self, config: ConfigWrapper) -> str | None:
        text = config.get("intb_pin", None)
        if text is None:
            return None
        params = self.printer.lookup_object("pins").lookup_pin(text)
        if params["chip"] is not self.mcu:
            raise config.error(
                f"Option 'intb_pin' in section '{self.section}' ({config.where('intb_pin')}): it must be on the board"
                " of the I2C bus."
            )
        return str(params["pin"])

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_mux_command(
            "LDC_CALIBRATE_DRIVE_CURRENT",
            "CHIP",
            self.name,
            self.cmd_LDC_CALIBRATE_DRIVE_CURRENT,
            desc="Calibrate LDC1612 DRIVE_CURRENT register",
        )

    def _build_config(self) -> None:
        mcu, oid, i2c_oid = self.mcu, self.oid, self.i2c.get_oid()
        if self._intb is None:
            mcu.add_config_cmd(f"config_ldc1612 oid={oid} i2c_oid={i2c_oid}")
        else:
            mcu.add_config_cmd(f"config_ldc1612_with_intb oid={oid} i2c_oid={i2c_oid} intb_pin={self._intb}")
        mcu.add_config_cmd(f"query_ldc1612 oid={oid} rest_ticks=0", on_restart=True)
        queue = self.i2c.get_command_queue()
        self._query = mcu.lookup_command("query_ldc1612 oid=%c rest_ticks=%u", cq=queue)
        self.stream.build(mcu.lookup_query_command("query_status_ldc1612 oid=%c", STATUS, oid=oid, cq=queue))

    def attach_trigger(self, trigger_oid: int) -> None:
        """Called when both objects are on the board."""
        self.mcu.add_config_cmd(
            f"ldc1612_attach_trigger_analog oid={self.oid} trigger_analog_oid={trigger_oid}"
        )

    # -- frequency --

    def hz_of(self, code: float) -> float:
        return code * self._clock_hz * self._divider / (1 << CODE_BITS)

    def code_of(self, hz: float) -> int:
        return round(hz * (1 << CODE_BITS) / (self._clock_hz * self._divider))

    def unpack(self, raw: bytes) -> float | None:
        """None for a conversion that has failed; the amplitude alone does not spoil it."""
        if raw[0] & 0xE0:
            return None
        return self.hz_of(int.from_bytes(raw, "big") & CODE_MAX)

    # -- registers --

    def _read(self, register: int) -> int:
        return int.from_bytes(self.i2c.i2c_read([register], 2)["response"], "big")

    def _write(self, register: int, value: int) -> None:
        self.i2c.i2c_write([register, value >> 8, value & 0xFF])

    def _identify(self) -> None:
        for register, expected in (MAKER, DEVICE):
            found = self._read(register)
            if found != expected:
                raise self.printer.command_error(
                    f"[{self.section}]: register 0x{register:02x} is 0x{found:04x} instead of 0x{expected:04x}: no"
                    " LDC1612 answers. Check its wires and i2c_address."
                )

    def _prepare(self, config: int) -> None:
        """Asleep while it is set, awake with the last write."""
        settings = ALWAYS | EXTERNAL_CLOCK | config
        deglitch = next((bits for hz, bits in MUX_DEGLITCH if hz >= self.max_hz), MUX_DEGLITCH[-1][1])
        for register, value in (
            (CONFIG, settings | SLEEP),
            (RCOUNT0, round((self._clock_hz / RATE_HZ - 4.0) / 16.0)),
            (OFFSET0, 0),
            (SETTLECOUNT0, round(SETTLE_S * self._clock_hz / 16.0) & 0xFFFF),
            (DIVIDERS0, self._divider << 12 | 1),
            (ERROR_CONFIG, READY_TO_INTB if self._intb else 0),
            (MUX_CONFIG, MUX_ALWAYS | deglitch),
            (DRIVE0, self._drive << 11),
            (CONFIG, settings),
        ):
            self._write(register, value)

    def _start(self) -> float:
        self._identify()
        rest_s = 1.0 / (LOOKS_PER_SAMPLE * RATE_HZ)
        self._prepare(OVERRIDE | NO_AUTO | (0 if self._intb else NO_INTB))
        self._query.send([self.oid, self.mcu.seconds_to_clock(rest_s)])
        return RATE_HZ

    def _stop(self) -> None:
        self._query.send([self.oid, 0])
        self._write(CONFIG, ALWAYS | EXTERNAL_CLOCK | SLEEP)

    def row(self, sample: Sample) -> tuple[float, float]:
        return round(sample[0], 6), round(sample[1], 3)

    def cmd_LDC_CALIBRATE_DRIVE_CURRENT(self, gcmd: GCodeCommand) -> None:
        """The chip finds the current of the right amplitude by itself; 20 mm above the bed."""
        if self.stream.is_running:
            raise gcmd.error(f"[{self.section}] is measuring: wait until it has ended")
        self._identify()
        self._prepare(0)
        reactor = self.printer.get_reactor()
        reactor.pause(reactor.monotonic() + CALIBRATE_S)
        found = self._read(DRIVE0) >> 6 & 0x1F
        self._write(CONFIG, ALWAYS | EXTERNAL_CLOCK | SLEEP)
        self._drive = found
        self.printer.lookup_object("configfile").set(self.section, "reg_drive_current", str(found))
        manual_probe.report_save_config(gcmd, f"{self.section}: reg_drive_current: {found}")
