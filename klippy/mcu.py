"""`[mcu]` and `[mcu NAME]`: one micro-controller with its link, clock, configuration and shutdown.

    klippy:mcu_identify   open the port, read the dictionary, synchronise clocks
    klippy:connect        compare and send the configuration (mcu_session.ConfigScript)
    klippy:shutdown       emergency_stop
    klippy:firmware_restart, klippy:disconnect

Plugins find here the conversions between print time and clock, oids, config commands and message look-up.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, NoReturn

import msgproto
import pins
import serialhdl
from clocksync import ClockSync, SecondarySync
from link import mcu_options, usb_power
from link.mcu_homing import MULTI_TIMEOUT_S
from link.mcu_io import MCU_adc, MCU_digital_out, MCU_endstop, MCU_pwm, MCU_trsync, TriggerDispatch
from link.mcu_session import ConfigScript, TaskLoad, missing_command, read_dictionary, shutdown_help
from link.optional_board import CONNECT_S, OptionalBoard
from link.step_writer import StepWriter
from serialhdl import CommandQueryWrapper, CommandWrapper

__all__ = [
    "MCU",
    "MCU_adc",
    "MCU_digital_out",
    "MCU_endstop",
    "MCU_pwm",
    "MCU_trsync",
    "TriggerDispatch",
    "add_printer_objects",
    "get_printer_mcu",
]

BATCH_MOVE_COUNT = 500  # places in the move queue assumed when no MCU is there to ask
MIN_SCHEDULE_TIME_S = 0.100  # commands are sent at least this long before they are due
MAX_NOMINAL_DURATION_S = 3.0  # the longest time ahead anything is scheduled
TRSYNC_TIMEOUT = MULTI_TIMEOUT_S  # the name plugins know
RESET_SETTLE_S = 0.050  # for the reset command to leave the host before the port is closed
RESTART_WAIT_S = 2.0
WATCH_PERIOD_S = 1.0
PIN_TYPES: dict[str, Callable[..., Any]] = {
    "endstop": MCU_endstop,
    "digital_out": MCU_digital_out,
    "pwm": MCU_pwm,
    "adc": MCU_adc,
}


class MCU:
    """One micro-controller."""

    error = serialhdl.error

    def __init__(self, config: Any, clocksync: ClockSync) -> None:
        self._printer = printer = config.get_printer()
        self._reactor = printer.get_reactor()
        self._clocksync = clocksync
        section = config.get_name()
        self._name = "mcu" if section == "mcu" else section.removeprefix("mcu ").strip()
        self._options = mcu_options.read_options(config)
        self._start_args = start_args = printer.get_start_args()
        self._is_fileoutput = start_args.get("debugoutput") is not None
        self._serial = serialhdl.SerialReader(
            self._reactor,
            f"mcu '{self._name}': ",
            mcu_options.port_opener(self._options, start_args.get("open_port")),
            mcu_options.advice(self._options),
        )
        self._script = ConfigScript()
        self._load = TaskLoad()
        self._mcu_freq = 0.0
        self._move_count = 0
        self._kept_configuration = False
        self._is_shutdown = self._is_timeout = False
        self._shutdown_clock = 0
        self._shutdown_msg = ""
        self._emergency_stop: CommandWrapper | None = None
        self._step_writer: StepWriter | None = None
        self._watch_timer = self._reactor.register_timer(self._watch_link)
        self._dictionary = b""
        self._optional: OptionalBoard | None = None
        if self._options.reconnect_s is not None:
            self._optional = OptionalBoard(
                printer, self._name, self._options.reconnect_s, self._serial, self._come_back
            )
        self._register(printer)
        if self._options.can is not None:
            printer.load_object(config, f"canbus_stats {self._name}")

    def _register(self, printer: Any) -> None:
        printer.lookup_object("pins").register_chip(self._name, self)
        for event, handler in (
            ("klippy:mcu_identify", self._identify),
            ("klippy:connect", self._connect),
            ("klippy:firmware_restart", self._firmware_restart),
            ("klippy:shutdown", self._on_printer_shutdown),
            ("klippy:disconnect", self._disconnect),
        ):
            printer.register_event_handler(event, handler)

    def _fail(self, text: str) -> NoReturn:
        raise self._printer.config_error(text)

    # --- start: identify ---

    def _identify(self) -> None:
        if self._is_fileoutput:
            self._connect_file()
        else:
            wait_s = serialhdl.CONNECT_TIMEOUT_S if self._optional is None else CONNECT_S
            try:
                self._serial.connect(self._options.serial, self._options.baud, wait_s)
            except serialhdl.error:
                if self._optional is None:
                    raise
                self._optional.lose("it does not answer")
                return
            self._clocksync.connect(self._serial)
        self._note_firmware()

    def _note_firmware(self) -> None:
        self._dictionary = self._serial.get_msgparser().raw_identify_data
        self._check_firmware()
        self._reserve_pins()
        for name, handler in (
            ("shutdown", self._on_mcu_shutdown),
            ("is_shutdown", self._on_mcu_shutdown),
            ("starting", self._on_mcu_starting),
            ("stats", self._load.update),
        ):
            self._serial.register_response(handler, name)
        logging.info("%s", self._describe())
        self._printer.set_rollover_info(self._name, self._describe(), log=False)

    def _connect_file(self) -> None:
        try:
            self._serial.connect_file(*read_dictionary(self._start_args, self._name))
            self._clocksync.connect_file(self._serial)
        except (serialhdl.error, ValueError) as e:
            self._fail(f"mcu '{self._name}': {e}")

    def _check_firmware(self) -> None:
        parser = self._serial.get_msgparser()
        try:
            self._mcu_freq = parser.get_constant_float("CLOCK_FREQ")
        except msgproto.error as e:
            self._fail(f"{e}; this is no firmware this host can use.")
        if MAX_NOMINAL_DURATION_S * self._mcu_freq >= 2**31:
            self._fail(
                f"mcu '{self._name}' runs its clock at {self._mcu_freq:.0f} Hz, too fast to schedule"
                f" {MAX_NOMINAL_DURATION_S} s ahead with 32 bits."
            )
        self._load = TaskLoad(self._mcu_freq, parser.get_constant_float("STATS_SUMSQ_BASE", 256.0))
        self._emergency_stop = self.lookup_command("emergency_stop")

    def _reserve_pins(self) -> None:
        """Pins the firmware itself needs (serial, USB, crystal) must not be configured."""
        resolver = self._printer.lookup_object("pins").get_pin_resolver(self._name)
        for constant, value in self.get_constants().items():
            if constant.startswith("RESERVE_PINS_"):
                for pin in str(value).split(","):
                    resolver.reserve_pin(pin.strip(), constant.removeprefix("RESERVE_PINS_"))

    def _describe(self) -> str:
        parser = self._serial.get_msgparser()
        version, build = parser.get_version_info()
        constants = " ".join(f"{k}={v}" for k, v in self.get_constants().items())
        count = len(parser.get_messages())
        head = f"Loaded MCU '{self._name}' {count} messages ({version} / {build})"
        return f"{head}\nMCU '{self._name}' config: {constants}"

    # --- start: configuration ---

    def _connect(self) -> None:
        if self._optional is not None and self._optional.is_absent:
            self._optional.look()
            return
        self._configure()
        if not self._is_fileoutput:
            self._reactor.update_timer(self._watch_timer, self._reactor.monotonic() + WATCH_PERIOD_S)

    def _come_back(self) -> None:
        """An optional board that was absent is there; raises an error of the link, or of its configuration, if not."""
        serial = self._serial
        serial.connect(self._options.serial, self._options.baud, CONNECT_S)
        if self._dictionary not in (b"", serial.get_msgparser().raw_identify_data):
            raise serialhdl.error("its firmware is another than before: RESTART the host")
        self._clocksync.connect(serial)
        if not self._dictionary:
            self._note_firmware()
        init, restart, commands = self._build_script()
        state = serial.send_with_response("get_config", "config")
        if state["is_shutdown"] or (state["is_config"] and state["crc"] != self._script.crc):
            serial.send("reset")
            raise serialhdl.error("it has another configuration and is reset")
        self._kept_configuration = bool(state["is_config"])
        self._send_all([*(restart if state["is_config"] else commands), *init])
        state = serial.send_with_response("get_config", "config")
        if not state["is_config"] or state["is_shutdown"]:
            raise serialhdl.error("it did not accept its configuration")
        self._is_timeout = False
        self._reactor.update_timer(self._watch_timer, self._reactor.monotonic() + WATCH_PERIOD_S)

    def _lose(self, reason: str) -> bool:
        """Is the board one that may vanish? Then it is gone from now on, and looked for."""
        if self._optional is None or self._printer.is_shutdown():
            return False
        if not self._serial.is_absent:
            self._optional.lose(reason)
            self._disconnect()
            self._optional.look()
        return True

    def _build_script(self) -> tuple[list[bytes], ...]:
        """Commands at each start, for a board that kept its configuration, and for one that was reset."""
        self._script.build(self._printer.lookup_object("pins").get_pin_resolver(self._name).update_command)
        lists = (self._script.init_cmds, self._script.restart_cmds, self._script.config_cmds)
        return tuple([self._encode_config(cmd) for cmd in cmds] for cmds in lists)

    def _configure(self) -> None:
        script = self._script
        init, restart, commands = self._build_script()
        state = self._query_config(first=True)
        if not state["is_config"]:
            logging.info("Sending MCU '%s' printer configuration...", self._name)
            self._send_all(commands)
        else:
            self._check_unchanged(state["crc"])
            self._kept_configuration = True
            self._send_all(restart)
        self._send_all(init)
        if not self._is_fileoutput:
            state = self._query_config()
            if not state["is_config"] or state["is_shutdown"]:
                self._fail(f"MCU '{self._name}' did not accept its configuration. {shutdown_help('')}")
            self._check_unchanged(state["crc"])
        self._move_count = state["move_count"] or BATCH_MOVE_COUNT
        logging.info("Configured MCU '%s' (%d moves)", self._name, self._move_count)
        if self._move_count <= script.reserved_move_slots:
            self._fail(
                f"MCU '{self._name}' has room for {self._move_count} queued moves only; its outputs alone need"
                f" {script.reserved_move_slots}."
            )

    def _encode_config(self, cmd: str) -> bytes:
        try:
            return self._serial.get_msgparser().create_command(cmd)
        except msgproto.enumeration_error as e:
            if e.param == "pin" or e.param.endswith("_pin"):
                self._fail(f"Pin '{e.text}' is not a valid pin name on mcu '{self._name}'.")
            self._fail(f"'{e.text}' is not a valid {e.param} on mcu '{self._name}'.")
        except msgproto.error as e:
            self._fail(self._missing_command_text(cmd, e))

    def _send_all(self, commands: list[bytes]) -> None:
        queue = self._serial.get_default_command_queue()
        for command in commands:
            self._serial.raw_send(command, 0, 0, queue)

    def _query_config(self, first: bool = False) -> dict[str, Any]:
        query = self.lookup_query_command(
            "get_config", "config is_config=%c crc=%u is_shutdown=%c move_count=%hu"
        )
        state = query.send()
        if first and self._start_args.get("start_reason") == "startup":
            # what a host that crashed has left: its moves and outputs may still run
            if state["is_config"] and state["crc"] == self._script.crc:
                self._printer.send_event("mcu:left_over", self)
            if state["is_shutdown"]:
                self._restart_for("it was shut down before this host started")
            if state["is_config"]:
                self._restart_for("it was configured by another run of the host")
        if self._is_shutdown:
            reason = self._shutdown_msg
            self._fail(f"MCU '{self._name}' error during config: {reason}. {shutdown_help(reason)}")
        if state["is_shutdown"]:
            self._fail(f"Can not update MCU '{self._name}' config as it is shutdown. {shutdown_help('')}")
        return state

    def _check_unchanged(self, crc: int) -> None:
        """The MCU keeps the configuration it got after its last reset; another one needs a reset."""
        if crc != self._script.crc:
            self._restart_for("its configuration has changed")

    def _restart_for(self, reason: str) -> NoReturn:
        if self._start_args.get("start_reason") == "firmware_restart":
            self._fail(
                f"MCU '{self._name}' could not be reset, although {reason}. Switch it off and on again."
            )
        logging.info("Attempting automated MCU '%s' restart: %s", self._name, reason)
        self._printer.request_exit("firmware_restart")
        self._reactor.pause(self._reactor.monotonic() + RESTART_WAIT_S)
        self._fail(f"MCU '{self._name}' must be reset ({reason}), and the attempt to do so failed.")

    # --- shutdown and restart ---

    def _on_mcu_shutdown(self, params: dict[str, Any]) -> None:
        if self._is_shutdown:
            return
        self._is_shutdown = True
        clock = params.get("clock")
        if clock is not None:
            self._shutdown_clock = self.clock32_to_clock64(clock)
        self._shutdown_msg = reason = str(params["static_string_id"])
        previous = "Previous " if params["#name"] == "is_shutdown" else ""
        self._stop_printer(f"{previous}MCU '{self._name}' shutdown: {reason}", reason)

    def _on_mcu_starting(self, params: dict[str, Any]) -> None:
        if not self._is_shutdown and not self._lose("it started again"):
            self._is_shutdown = True
            self._shutdown_msg = "spontaneous restart"
            self._stop_printer(f"MCU '{self._name}' spontaneous restart", self._shutdown_msg)

    def _stop_printer(self, what: str, reason: str) -> None:
        logging.error("%s\n%s\n%s", what, self._clocksync.dump_debug(), self._serial.stats(0.0))
        facts = filter(None, self._printer.send_event("mcu:explain_shutdown", self, reason))
        text = "\n".join([what, *facts, shutdown_help(reason)])
        # handlers of the shutdown may want to sleep: not from inside a message handler
        self._reactor.register_callback(lambda eventtime: self._printer.invoke_shutdown(text))

    def _on_printer_shutdown(self) -> None:
        if self._emergency_stop is not None and not self._is_shutdown:
            self._is_shutdown = True
            self._shutdown_msg = "Command request"
            self._emergency_stop.send()

    def _watch_link(self, eventtime: float) -> float:
        if self._clocksync.is_active() or self._is_timeout:
            return eventtime + WATCH_PERIOD_S
        self._is_timeout = True
        if self._lose("it does not answer"):
            return self._reactor.NEVER
        logging.error("Timeout with MCU '%s' (eventtime=%f)", self._name, eventtime)
        self._stop_printer(f"Lost communication with MCU '{self._name}'", "")
        return self._reactor.NEVER

    def _firmware_restart(self) -> None:
        """Reset the MCU; the next start of the host finds it unconfigured."""
        if self._options.restart_method == "rpi_usb" and not self._is_fileoutput:
            logging.info("Attempting MCU '%s' reset by USB power", self._name)
            self._disconnect()
            usb_power.cycle()
            return
        if self._is_fileoutput or self._serial.port is None:
            return
        self._is_shutdown = True  # the greeting of the MCU that starts again is no surprise
        reset, config_reset = self.try_lookup_command("reset"), self.try_lookup_command("config_reset")
        if self._options.restart_method in ("arduino", "cheetah") or (reset is None and config_reset is None):
            logging.info("Attempting MCU '%s' reset by its port", self._name)
            self._serial.port.reset()
        elif reset is not None:
            logging.info("Attempting MCU '%s' reset command", self._name)
            reset.send()
        elif config_reset is not None and self._emergency_stop is not None:
            logging.info("Attempting MCU '%s' config_reset command", self._name)
            self._emergency_stop.send()  # config_reset works in shutdown only
            self._reactor.pause(self._reactor.monotonic() + RESET_SETTLE_S)
            config_reset.send()
        self._reactor.pause(self._reactor.monotonic() + RESET_SETTLE_S)
        self._disconnect()

    def _disconnect(self) -> None:
        if self._optional is not None:
            self._optional.stop()
        self._reactor.update_timer(self._watch_timer, self._reactor.NEVER)
        self._clocksync.disconnect()
        self._serial.disconnect()

    # --- configuration, for modules ---

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Make the object for a pin: endstop, digital_out, pwm or adc. Called by pins.PrinterPins."""
        if pin_type not in PIN_TYPES:
            raise pins.error(f"pin type {pin_type} not supported on mcu '{self._name}'")
        return PIN_TYPES[pin_type](self, pin_params)

    def create_oid(self) -> int:
        """A number for a new object on the MCU."""
        self._script.oid_count += 1
        return self._script.oid_count - 1

    def register_config_callback(self, cb: Callable[[], None]) -> None:
        """`cb()` is called when the dictionary is known: the time to look up and add commands."""
        self._script.callbacks.append(cb)

    def add_config_cmd(self, cmd: str, is_init: bool = False, on_restart: bool = False) -> None:
        """A command sent once after a reset; is_init: at each start; on_restart: only if already configured."""
        self._script.add(cmd, is_init, on_restart)

    def request_move_queue_slot(self) -> None:
        """A place in the MCU's move queue that steps must leave free."""
        self._script.reserved_move_slots += 1

    def get_query_slot(self, oid: int) -> int:
        """A clock for the start of periodic work of an object, different for each so that they do not coincide."""
        print_time = self.estimated_print_time(self._reactor.monotonic()) + 1.5 + oid * 0.01
        return self.print_time_to_clock(print_time)

    def kept_configuration(self) -> bool:
        """The MCU was configured already when this host started: it got the on_restart commands."""
        return self._kept_configuration

    def get_step_writer(self) -> StepWriter:
        """The way of finished step commands into the link."""
        if self._step_writer is None:
            self._step_writer = StepWriter(
                self._serial, lambda: self._move_count - self._script.reserved_move_slots
            )
        return self._step_writer

    # --- messages, for modules ---

    def _missing_command_text(self, msgformat: str, e: msgproto.error) -> str:
        if self._serial.is_absent:
            return (
                f"MCU '{self._name}' is not connected, and the config has sections that need it at the start."
            )
        version = self._serial.get_msgparser().get_version_info()[0] or "unknown"
        return missing_command(self._name, version, msgformat, e)

    def lookup_command(self, msgformat: str, cq: Any = None) -> CommandWrapper:
        """A command by its exact format; a config error if the firmware has none."""
        try:
            return CommandWrapper(self._serial, msgformat, cq)
        except msgproto.error as e:
            self._fail(self._missing_command_text(msgformat, e))

    def try_lookup_command(self, msgformat: str) -> CommandWrapper | None:
        """A command, or None if the firmware has none of this format."""
        try:
            return CommandWrapper(self._serial, msgformat)
        except msgproto.error:
            return None

    def lookup_query_command(
        self, msgformat: str, respformat: str, oid: int | None = None, cq: Any = None, is_async: bool = False
    ) -> CommandQueryWrapper:
        """A command with an answer; its send() returns the answer's parameters."""
        try:
            error_class = self._printer.command_error
            return CommandQueryWrapper(self._serial, msgformat, respformat, oid, cq, error_class)
        except msgproto.error as e:
            self._fail(self._missing_command_text(msgformat, e))

    def register_response(
        self, cb: Callable[[dict[str, Any]], None] | None, name: str, oid: int | None = None
    ) -> None:
        """Call `cb(params)` for each such message of the MCU (params has #receive_time, #sent_time)."""
        self._serial.register_response(cb, name, oid)

    register_serial_response = register_response

    def register_batch(
        self, cb: Callable[[Any, int], None], msgformat: str, seconds: float = 0.0, batch_max: int = 0
    ) -> None:
        """Call `cb(messages, count)` with undecoded messages, when there are `batch_max` or one is `seconds` old."""
        try:
            self._serial.register_batch(cb, msgformat, seconds, batch_max)
        except msgproto.error as e:
            self._fail(self._missing_command_text(msgformat, e))

    def let_wait(self, msgformat: str, oid: int, cb: Callable[[bytes], None]) -> None:
        """Messages of this format wake nobody: they come with the next of another, undecoded from after the oid."""
        try:
            self._serial.let_wait(msgformat, oid, cb)
        except msgproto.error as e:
            self._fail(self._missing_command_text(msgformat, e))

    def alloc_command_queue(self) -> Any:
        """Commands keep their order within a queue only."""
        return self._serial.alloc_command_queue()

    def get_enumerations(self) -> dict[str, dict[str, int]]:
        return self._serial.get_msgparser().get_enumerations()

    def get_constants(self) -> dict[str, Any]:
        return self._serial.get_msgparser().get_constants()

    def get_constant(self, name: str, default: Any = ...) -> Any:
        """A constant of the firmware as text; a config error if it has none and no default is given."""
        try:
            return self._serial.get_msgparser().get_constant(name, default)
        except msgproto.error as e:
            self._fail(str(e))

    def get_constant_float(self, name: str) -> float:
        try:
            return self._serial.get_msgparser().get_constant_float(name)
        except msgproto.error as e:
            self._fail(str(e))

    # --- time ---

    def print_time_to_clock(self, print_time: float) -> int:
        return self._clocksync.print_time_to_clock(print_time)

    def clock_to_print_time(self, clock: float) -> float:
        return self._clocksync.clock_to_print_time(clock)

    def estimated_print_time(self, eventtime: float) -> float:
        """Print time at a system time (s)."""
        return self._clocksync.estimated_print_time(eventtime)

    def reported_print_time(self) -> float:
        """Print time of the MCU's last answer to a question for its clock."""
        return self._clocksync.reported_print_time()

    def dated(self, eventtime: float) -> tuple[int, float, float]:
        """Clock at a system time, its print time, and the seconds of a tick there."""
        return self._clocksync.dated(eventtime)

    def clock32_to_clock64(self, clock32: int) -> int:
        return self._clocksync.clock32_to_clock64(clock32)

    def seconds_to_clock(self, time: float) -> int:
        return int(time * self._mcu_freq)

    def min_schedule_time(self) -> float:
        return MIN_SCHEDULE_TIME_S

    def max_nominal_duration(self) -> float:
        return MAX_NOMINAL_DURATION_S

    def get_max_stepper_error(self) -> float:
        return self._options.max_stepper_error_s

    def check_active(self, print_time: float, eventtime: float) -> None:
        """Bend this MCU's clock relation towards the true one from `print_time` on (all before is on its way)."""
        self._clocksync.calibrate_clock(print_time, eventtime)

    # --- facts ---

    def get_printer(self) -> Any:
        return self._printer

    def get_name(self) -> str:
        return self._name

    def is_fileoutput(self) -> bool:
        return self._is_fileoutput

    def is_shutdown(self) -> bool:
        return self._is_shutdown

    def require_connected(self) -> None:
        """Raise command_error if this board may vanish, and did."""
        if self._optional is not None:
            self._optional.require()

    def get_shutdown_clock(self) -> int:
        return self._shutdown_clock

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """(something noteworthy, line for the log)."""
        load = " ".join(f"{k}={v}" for k, v in self._load.as_stats().items())
        text = f"{self._name}: {load} {self._serial.stats(eventtime)} {self._clocksync.stats(eventtime)}"
        return False, text

    def get_status(self, eventtime: float = 0.0) -> dict[str, Any]:
        parser = self._serial.get_msgparser()
        version, build_versions = parser.get_version_info()
        clock = {"freq": round(self._clocksync.line.freq)}
        return {
            "app": parser.app,
            "mcu_version": version,
            "mcu_build_versions": build_versions,
            "mcu_constants": self.get_constants(),
            "non_critical_disconnected": self._optional is not None and self._optional.is_absent,
            "last_stats": {**self._load.as_stats(), **self._serial.get_stats(), **clock},
        }


def add_printer_objects(config: Any) -> None:
    """Make the objects 'mcu' and 'mcu NAME' of all sections."""
    printer = config.get_printer()
    reactor = printer.get_reactor()
    main_sync = ClockSync(reactor)
    printer.add_object("mcu", MCU(config.getsection("mcu"), main_sync))
    for section in config.get_prefix_sections("mcu "):
        printer.add_object(section.get_name(), MCU(section, SecondarySync(reactor, main_sync)))


def get_printer_mcu(printer: Any, name: str) -> MCU:
    """The MCU object of a chip name."""
    mcu: MCU = printer.lookup_object(name if name == "mcu" else f"mcu {name}")
    return mcu
