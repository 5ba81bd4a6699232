"""Light stand-ins for the printer around heaters: enough to run their commands and callbacks by hand."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from configtext import ConfigData, ConfigParser


class CommandError(Exception):
    pass


class FakePin:
    """adc, pwm or a looked-up pin; remembers what was asked of it."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.mcu = mcu
        self.sent: list[tuple[float, float]] = []
        self.sample: dict[str, Any] = {}
        self.callback: Callable[[float, float], None] | None = None
        self.max_duration = self.cycle_time = 0.0

    def get_mcu(self) -> FakeMcu:
        return self.mcu

    def setup_adc_callback(self, report_time: float, callback: Callable[[float, float], None]) -> None:
        self.callback = callback

    def setup_adc_sample(self, sample_time: float, sample_count: int, **limits: Any) -> None:
        self.sample = limits

    def setup_cycle_time(self, cycle_time: float) -> None:
        self.cycle_time = cycle_time

    def setup_max_duration(self, max_duration: float) -> None:
        self.max_duration = max_duration

    def set_pwm(self, print_time: float, value: float) -> None:
        self.sent.append((print_time, value))


class FakeMcu:
    """Time is what the test says; print time equals it."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.config: list[str] = []
        self.others: dict[str, FakeMcu] = {}
        self.init: list[str] = []
        self.sent: list[list[int]] = []
        self.response: Callable[[dict[str, Any]], None] | None = None
        self.on_batch: Callable[[Any, int], None] = lambda messages, count: None
        self.batch_max = 0
        self._callbacks: list[Callable[[], None]] = []

    def estimated_print_time(self, eventtime: float) -> float:
        return eventtime

    def create_oid(self) -> int:
        return 3

    def register_config_callback(self, callback: Callable[[], None]) -> None:
        self._callbacks.append(callback)

    def configure(self) -> None:
        for callback in self._callbacks:
            callback()

    def register_response(self, callback: Callable[[dict[str, Any]], None], name: str, oid: int) -> None:
        self.response = callback

    def register_batch(
        self, callback: Callable[[Any, int], None], msgformat: str, seconds: float = 0.0, batch_max: int = 0
    ) -> None:
        self.on_batch, self.batch_max = callback, batch_max

    def add_config_cmd(self, cmd: str, is_init: bool = False) -> None:
        (self.init if is_init else self.config).append(cmd)

    def request_move_queue_slot(self) -> None:
        pass

    def get_constant_float(self, name: str) -> float:
        return {"CLOCK_FREQ": 72e6}[name]

    def get_constants(self) -> dict[str, int]:
        return {"BRIDGE_PHASE_MAX": 45000, "INDUCTION_MOVE_TICKS": 7}

    def seconds_to_clock(self, seconds: float) -> int:
        return int(seconds * 72e6)

    def print_time_to_clock(self, print_time: float) -> int:
        return int(print_time * 72e6)

    def clock_to_print_time(self, clock: int) -> float:
        return clock / 72e6

    def dated(self, eventtime: float) -> tuple[int, float, float]:
        return int(eventtime * 72e6), eventtime, 1.0 / 72e6

    def clock32_to_clock64(self, clock: int) -> int:
        return clock

    def alloc_command_queue(self) -> None:
        return None

    def lookup_command(self, msgformat: str, cq: Any = None) -> FakeMcu:
        return self

    def try_lookup_command(self, msgformat: str) -> FakeMcu:
        """What its messages are is in `sent` of the one returned."""
        return self.others.setdefault(msgformat.split(maxsplit=1)[0], FakeMcu())

    def send(self, data: list[int], minclock: int = 0, reqclock: int = 0) -> None:
        self.sent.append(data)

    def get_name(self) -> str:
        return "mcu"


class FakeWaits:
    """Nobody ends a wait."""

    def __init__(self, reactor: FakeReactor) -> None:
        self.reactor = reactor

    def sleep(self, waketime: float, what: str) -> bool:
        self.reactor.pause(waketime)
        return False


class FakeGcode:
    def __init__(self, reactor: FakeReactor) -> None:
        self.waits = FakeWaits(reactor)
        self.commands: dict[str, Callable[[Any], None]] = {}
        self.mux: dict[tuple[str, str | None], Callable[[Any], None]] = {}
        self.lines: list[str] = []

    def register_command(self, cmd: str, func: Any, when_not_ready: bool = False, desc: str = "") -> None:
        self.commands[cmd] = func

    def register_mux_command(self, cmd: str, key: str, value: str | None, func: Any, desc: str = "") -> None:
        assert (cmd, value) not in self.mux
        self.mux[cmd, value] = func

    def respond_raw(self, line: str) -> None:
        self.lines.append(line)

    def respond_info(self, text: str, log: bool = True) -> None:
        self.lines.append(f"// {text}")


class FakeCommand:
    error = CommandError

    def __init__(self, gcode: FakeGcode, **params: str) -> None:
        self.gcode = gcode
        self.params = params

    def get(self, name: str, *default: Any) -> Any:
        return self.params.get(name, *default) if default else self.params[name]

    def get_commandline(self) -> str:
        return " ".join(f"{name}={value}" for name, value in self.params.items())

    def get_float(
        self, name: str, default: float, above: float | None = None, maxval: float | None = None
    ) -> float:
        return float(self.params.get(name, default))

    def get_int(self, name: str, default: int) -> int:
        return int(self.params.get(name, default))

    def respond_info(self, text: str) -> None:
        self.gcode.respond_info(text)

    def ack(self, line: str) -> bool:
        self.gcode.lines.append(f"ok {line}")
        return True

    def respond_raw(self, line: str) -> None:
        self.gcode.lines.append(line)


class FakeReactor:
    NOW, NEVER = 0.0, 9e99

    def __init__(self) -> None:
        self.now_s = 100.0
        self.on_pause: Callable[[float], None] = lambda now_s: None
        self.timers: list[Any] = []

    def monotonic(self) -> float:
        return self.now_s

    def pause(self, until: float) -> float:
        self.now_s = until
        self.on_pause(until)
        return until

    def register_timer(self, callback: Any, when: float) -> Any:
        self.timers.append(callback)
        return callback

    def unregister_timer(self, timer: Any) -> None:
        self.timers.remove(timer)

    def update_timer(self, timer: Any, when: float) -> None:
        pass


class FakeToolhead:
    def get_last_move_time(self) -> float:
        return 0.0

    def register_lookahead_callback(self, callback: Callable[[float], None]) -> None:
        callback(0.0)


class FakePrinter:
    """Objects by name; `config(text)` gives sections of a printer.cfg."""

    command_error = CommandError
    config_error = CommandError

    def __init__(self, text: str, loaders: dict[str, Callable[[Any], Any]], **start_args: Any) -> None:
        self.mcu = FakeMcu()
        self.reactor = FakeReactor()
        self.gcode = FakeGcode(self.reactor)
        self.pins: dict[str, FakePin] = {}
        self.events: dict[str, list[Callable[..., Any]]] = {}
        self.start_args = start_args
        self.shutdown_text = ""
        self.objects: dict[str, Any] = {"gcode": self.gcode, "pins": self, "toolhead": FakeToolhead()}
        self._loaders = loaders
        self._data = ConfigData()
        self._access: dict[tuple[str, str], Any] = {}
        ConfigParser(self._data).parse_text(text, "printer.cfg")

    def config(self, section: str) -> ConfigWrapper:
        return ConfigWrapper(self, self._data, self._access, section)

    def settings(self, section: str) -> dict[str, Any]:
        """What was read, with defaults: configfile.settings."""
        return {option: value for (name, option), value in self._access.items() if name == section}

    def load(self, section: str) -> Any:
        return self.load_object(self.config(section), section)

    def load_object(self, config: Any, section: str) -> Any:
        if section not in self.objects:
            name = section.split(maxsplit=1)[0]
            loader = self._loaders.get(name)
            if loader is None:
                loader = importlib.import_module(f"extras.{name}").load_config
            self.objects[section] = loader(config.getsection(section))
        return self.objects[section]

    def lookup_object(self, name: str, *default: Any) -> Any:
        return self.objects.get(name, default[0]) if default else self.objects[name]

    def lookup_objects(self, module: str) -> list[tuple[str, Any]]:
        return [(n, obj) for n, obj in self.objects.items() if n == module or n.startswith(f"{module} ")]

    def register_event_handler(self, event: str, handler: Callable[..., Any]) -> None:
        self.events.setdefault(event, []).append(handler)

    def send(self, event: str) -> None:
        for handler in self.events.get(event, []):
            handler()

    def get_reactor(self) -> FakeReactor:
        return self.reactor

    def get_start_args(self) -> dict[str, Any]:
        return self.start_args

    def is_shutdown(self) -> bool:
        return bool(self.shutdown_text)

    def invoke_shutdown(self, text: str) -> None:
        self.shutdown_text = text
        self.send("klippy:shutdown")

    # object "pins"

    def setup_pin(self, pin_type: str, pin: str) -> FakePin:
        self.pins[pin] = FakePin(self.mcu)
        return self.pins[pin]

    def lookup_pin(self, pin: str) -> dict[str, Any]:
        return {"chip": self.mcu, "pin": pin}
