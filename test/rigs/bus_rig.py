"""A printer with one board, for tests of bus and pin modules: the board answers as the test says.

Every command the host sends is encoded with the dictionary of the built firmware, so a text or a value that the
firmware would not take fails here.
"""

from __future__ import annotations

import fcntl
import json
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgproto
from base_rig import BarePrinter, Session
from check_formats import COMMANDS_ELSEWHERE, RESPONSES_ELSEWHERE

ROOT = Path(__file__).resolve().parents[2]
DICTIONARY = ROOT / "out" / "simulator" / "ferrite.dict"
FREQ = 72_000_000

Answer = Callable[[list[Any]], Mapping[str, Any]]


def build_dictionary() -> bytes:
    """The dictionary of the firmware as it is in src/."""
    (ROOT / "out").mkdir(exist_ok=True)
    with open(ROOT / "out" / ".simulation-lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        subprocess.run(["make", "-s", "-f", "src/build.mk", "firmware-sim"], cwd=ROOT, check=True)
    return DICTIONARY.read_bytes()


def all_boards_dictionary() -> bytes:
    """The dictionary of the firmware, with what only Klipper's firmware for other boards knows."""
    content = json.loads(build_dictionary())
    number = max(*content["commands"].values(), *content["responses"].values())
    for kind, texts in (("commands", COMMANDS_ELSEWHERE), ("responses", RESPONSES_ELSEWHERE)):
        for text in texts:
            number += 1
            content[kind][text] = number
    content["enumerations"]["spi_bus"]["spidev1.1"] = 11
    content["config"]["PCA9685_MAX"] = 4096
    content["enumerations"]["bus"] = {"sercom0": [0, 8]}
    content["enumerations"]["sercom_pin_type"] = {"tx": 0, "rx": 1, "clk": 2}
    return json.dumps(content).encode()


class RigPin:
    """A digital_out, pwm or adc pin; `log` is what it was set to, (print time, value)."""

    def __init__(self, chip: Any, kind: str, invert: int) -> None:
        self.chip, self.kind, self.invert = chip, kind, invert
        self.log: list[tuple[float, float]] = []
        self.setup: dict[str, Any] = {}
        self.callback: Callable[[float, float], None] = lambda read_time, value: None
        self.last = (0.0, 0.0)

    def get_mcu(self) -> Any:
        return self.chip

    def setup_max_duration(self, duration_s: float) -> None:
        self.setup["max_duration"] = duration_s

    def setup_start_value(self, start: float, shutdown: float) -> None:
        self.setup["start"], self.setup["shutdown"] = start, shutdown

    def setup_cycle_time(self, cycle_time_s: float, hardware_pwm: bool = False) -> None:
        self.setup["cycle_time"], self.setup["hardware"] = cycle_time_s, hardware_pwm

    def setup_waiting(self, count: int) -> None:
        self.setup["waiting"] = count

    def setup_adc_sample(self, sample_time: float, sample_count: int, **limits: Any) -> None:
        self.setup["sample"] = limits

    def setup_adc_callback(self, report_time: float, callback: Callable[[float, float], None]) -> None:
        self.callback = callback

    def get_last_value(self) -> tuple[float, float]:
        return self.last

    def set_pwm(self, print_time: float, value: float) -> None:
        assert not self.log or print_time >= self.log[-1][0], "times must not go back"
        self.log.append((round(print_time, 6), value))

    set_digital = set_pwm


class Sender:
    """A command, with or without an answer."""

    def __init__(self, chip: Chip, msgformat: str) -> None:
        self.chip = chip
        self.message = chip.parser.lookup_command(msgformat)

    def send(self, data: Any = (), minclock: int = 0, reqclock: int = 0, retry: bool = True) -> Any:
        values = list(data)
        self.message.encode(values)
        self.chip.sent.append((self.message.name, values, minclock, reqclock))
        return self.chip.answers.get(self.message.name, lambda values: {})(values)

    def send_with_preface(self, preface: Sender, first: Any, data: Any, **clocks: int) -> Any:
        preface.send(first)
        return self.send(data, **clocks)


class Chip:
    """The MCU object. Print time is the reactor's time."""

    def __init__(self, printer: Any, parser: msgproto.MessageParser) -> None:
        self.printer, self.parser = printer, parser
        self.config: list[str] = []
        self.init: list[str] = []
        self.sent: list[tuple[str, list[Any], int, int]] = []
        self.answers: dict[str, Answer] = {}
        self.handlers: dict[tuple[str, int | None], Callable[[dict[str, Any]], None]] = {}
        self.pins: dict[str, RigPin] = {}
        self.constants: dict[str, Any] = dict(parser.get_constants())
        self.callbacks: list[Callable[[], None]] = []
        self.oids = 0
        self.batch = printer.get_start_args().get("debugoutput") is not None
        printer.register_event_handler("klippy:connect", self.configure)

    def configure(self) -> None:
        """As mcu.py: callbacks may add commands; then pin aliases are put in and all are encoded."""
        for callback in self.callbacks:
            callback()
        resolver = self.printer.lookup_object("pins").get_pin_resolver("mcu")
        for commands in (self.config, self.init):
            commands[:] = [resolver.update_command(command) for command in commands]
            for command in commands:
                self.parser.create_command(command)

    def report(self, name: str, oid: int, **params: Any) -> None:
        """A message of the board."""
        self.handlers[name, oid]({"#receive_time": self.printer.get_reactor().monotonic(), **params})

    def messages(self, name: str) -> list[list[Any]]:
        """Values of all commands of a name sent so far."""
        return [values for sent, values, _, _ in self.sent if sent == name]

    # the MCU's interface

    def get_printer(self) -> Any:
        return self.printer

    def get_name(self) -> str:
        return "mcu"

    def is_fileoutput(self) -> bool:
        return self.batch

    def create_oid(self) -> int:
        self.oids += 1
        return self.oids - 1

    def add_config_cmd(self, cmd: str, is_init: bool = False, on_restart: bool = False) -> None:
        (self.init if is_init else self.config).append(cmd)

    def register_config_callback(self, callback: Callable[[], None]) -> None:
        self.callbacks.append(callback)

    def register_response(self, callback: Any, name: str, oid: int | None = None) -> None:
        assert self.parser.lookup_response(name) is not None
        self.handlers[name, oid] = callback

    def let_wait(self, msgformat: str, oid: int, callback: Callable[[bytes], None]) -> None:
        """`report()` hands these on as their bytes from after the oid."""
        response = self.parser.lookup_command(msgformat)
        start = len(response.id_bytes) + len(msgproto.encode_vlq(oid))

        def hand_on(params: dict[str, Any]) -> None:
            known = {"oid": oid, **params}
            callback(response.encode([known[name] for name in response.names])[start:])

        self.handlers[response.name, oid] = hand_on

    def require_connected(self) -> None:
        pass

    def request_move_queue_slot(self) -> None:
        pass

    def alloc_command_queue(self) -> None:
        return None

    def lookup_command(self, msgformat: str, cq: Any = None) -> Sender:
        return Sender(self, msgformat)

    def lookup_query_command(
        self, msgformat: str, respformat: str, oid: int | None = None, cq: Any = None
    ) -> Sender:
        assert self.parser.lookup_response(respformat.split(maxsplit=1)[0]) is not None
        return Sender(self, msgformat)

    def get_enumerations(self) -> dict[str, dict[str, int]]:
        return self.parser.get_enumerations()

    def get_constant_float(self, name: str) -> float:
        return float(self.constants[name])

    def get_constants(self) -> dict[str, Any]:
        return self.constants

    def seconds_to_clock(self, seconds: float) -> int:
        return int(seconds * FREQ)

    def print_time_to_clock(self, print_time: float) -> int:
        return int(print_time * FREQ)

    def clock_to_print_time(self, clock: int) -> float:
        return clock / FREQ

    def clock32_to_clock64(self, clock: int) -> int:
        return clock

    def estimated_print_time(self, eventtime: float) -> float:
        return eventtime

    def get_query_slot(self, oid: int) -> int:
        return 1000 + oid

    def setup_pin(self, kind: str, params: dict[str, Any]) -> RigPin:
        pin = self.pins[params["pin"]] = RigPin(self, kind, params["invert"])
        return pin


class RigToolhead:
    """Look-ahead whose next move begins at `print_time`."""

    def __init__(self) -> None:
        self.print_time = 200.0
        self.moving = False
        self.extruder: Any = None
        self.dwells: list[float] = []
        self.limits = (300.0, 3000.0)

    def register_lookahead_callback(self, callback: Callable[[float], None]) -> None:
        callback(self.print_time)

    def get_last_move_time(self) -> float:
        return self.print_time

    def dwell(self, delay_s: float) -> None:
        self.dwells.append(delay_s)
        self.print_time += max(0.0, delay_s)

    def get_kinematics(self) -> Any:
        return self

    def get_steppers(self) -> list[Any]:
        return []

    def get_extruder(self) -> Any:
        return self.extruder

    def get_position(self) -> list[float]:
        return [0.0, 0.0, 0.0, self.extruder.find_past_position(self.extruder.now())]

    def get_max_velocity(self) -> tuple[float, float]:
        return self.limits

    def set_max_velocities(self, velocity: Any, accel: Any, corner: Any, ratio: Any) -> None:
        self.limits = (velocity or self.limits[0], accel or self.limits[1])

    def get_status(self, eventtime: float) -> dict[str, float]:
        ahead_s = 1.0 if self.moving else 0.0
        return {"print_time": eventtime + ahead_s, "estimated_print_time": eventtime}


class RigExtruder:
    """Filament that goes 2 mm a second from `start_s` on."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.start_s = float("inf")
        self.now = now

    def find_past_position(self, print_time: float) -> float:
        return max(0.0, print_time - self.start_s) * 2.0


class _RigPrinter(BarePrinter):
    CORE_FIRST = ("pins", "bus_rig")


def add_printer_objects(config: Any) -> None:
    """The board and the toolhead of a printer."""
    printer = config.get_printer()
    parser = msgproto.MessageParser()
    parser.process_identify(all_boards_dictionary(), decompress=False)
    chip = Chip(printer, parser)
    printer.lookup_object("pins").register_chip("mcu", chip)
    printer.add_object("mcu", chip)
    toolhead = RigToolhead()
    toolhead.extruder = RigExtruder(printer.get_reactor().monotonic)
    printer.add_object("toolhead", toolhead)
    printer.add_object("extruder", toolhead.extruder)


class BusSession(Session):
    """A session whose printer has the board; `chip` and `toolhead` once the printer has started."""

    def __init__(self, tmp_path: Path, config: str, **start_args: Any) -> None:
        super().__init__(tmp_path, config, **start_args)
        self.reactor.finalize()
        from base_rig import VirtualTime
        from reactor import Reactor

        self.reactor = Reactor(VirtualTime())
        self.printer = _RigPrinter(self.reactor, {"config_file": str(self.config_path), **start_args})
        self.gcode = self.printer.lookup_object("gcode")
        self.gcode.register_output_handler(self.lines.append)

    @property
    def chip(self) -> Chip:
        chip: Chip = self.printer.lookup_object("mcu")
        return chip

    @property
    def toolhead(self) -> RigToolhead:
        toolhead: RigToolhead = self.printer.lookup_object("toolhead")
        return toolhead


def run(tmp_path: Path, config: str, body: Callable[[BusSession], None], **start_args: Any) -> BusSession:
    """Start a printer with this config, run `body` in its reactor, end."""
    session = BusSession(tmp_path, config, **start_args)

    def ready(_: Session) -> None:
        assert session.state[1] == "ready", session.state[0]
        body(session)

    session.run(ready)
    return session


def start_error(tmp_path: Path, config: str) -> str:
    """The reason why a printer with this config does not start."""
    session = BusSession(tmp_path, config)
    reasons: list[str] = []
    session.run(lambda s: reasons.append(s.state[0]) if s.state[1] == "error" else None)
    assert reasons, "the config was accepted"
    return reasons[0]
