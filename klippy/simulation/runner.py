"""One simulated print: the host's Printer and the world in one process, a file, an outcome.

    RunOptions ─► Simulation ─► Printer(Reactor(SimTime(World)), start_args) ─► Outcome

The printer is started as klippy.py starts it, with two things handed in: its time and its ports. The machine
is built when the host opens its first port, from the printer's own simulator sections. From then on the
runner is the user: it waits until the printer is ready, starts the file, and watches.
"""

from __future__ import annotations

import gc
import math
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import reactor as reactor_module
from link.serialport import PortError
from printer import Printer

from . import preview, restarted
from . import world as world_module
from .builds import OUT
from .faults import KILLED_S, FaultError, Injector, Target, all_orders
from .machine import Machine, assemble
from .simport import SimPort
from .simtime import SimTime
from .summary import RunFacts, summary
from .world import World, WorldError

PRINTED, BAD_INPUT, SHUT_DOWN = 0, 2, 3

POLL_S = 0.25  # how often the user looks at the printer
OUTPUT_FOLDER = OUT / "simulation"  # of a run without a log: files of INDUCTION_DUMP, traces of calibrations
AFTERMATH_S = 2.0  # watched on after a shutdown, to see that the heat goes off
PROGRESS_WALL_S = 0.1
UNKNOWN_COMMAND = '// Unknown command:"'  # how the console says it; the print goes on
WARNINGS = ("// Induction heater '", "// Nozzle monitor:", "!! Warning: ")
GC_ALLOCATIONS = 100_000  # between looks for cycles: blocks and moves come by the thousand and make none


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a print is."""

    fraction: float  # of the file's bytes
    simulated_s: float
    wall_s: float


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What to print on what.

    `overrides`: (section, option, value) over the config file; `builds`: MCU → the build it runs; `log`: where the
    caller lets logging write, for what the host puts beside it; `api`: where the host serves its API.
    """

    config: Path
    gcode: Path
    seed: int = 1
    overrides: tuple[tuple[str, str, str], ...] = ()
    trace: Path | None = None
    until_s: float | None = None
    on_progress: Callable[[Progress], None] | None = None
    builds: Mapping[str, str] = field(default_factory=dict)
    log: Path | None = None
    faults: tuple[str, ...] = ()  # see faults.py
    api: Path | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """`status`: exit status of simulate.py; `reason`: for people; `summary`: for the summary file."""

    status: int
    reason: str
    summary: dict[str, Any]


@dataclass(slots=True)
class _Ending:
    status: int | None = None
    reason: str = ""


@contextmanager
def _rare_collections() -> Iterator[None]:
    """For a print: what a start makes stays, and is not looked through again and again."""
    before = gc.get_threshold()
    gc.set_threshold(GC_ALLOCATIONS)
    try:
        yield
    finally:
        gc.unfreeze()
        gc.set_threshold(*before)


class Simulation:
    """Runs once."""

    def __init__(self, options: RunOptions) -> None:
        self.options = options
        self.facts = RunFacts(str(options.config), str(options.gcode), options.seed)
        self.ending = _Ending()
        self.machine: Machine | None = None
        self._wall_start = time.monotonic()
        self._next_sample = 0.0
        self._next_progress = 0.0
        self._heater: Any = None
        self._bed: Any = None
        self._plan: Any = None
        self._nozzles: list[Any] = []
        self._sample_s = 0.0
        self.injector: Injector | None = None

    # --- start ---
    def run(self) -> Outcome:
        """Print; returns whatever the end was. Raises WorldError if the simulator cannot be built."""
        world_module.build()
        self.world = World(self.options.seed)
        self.time = SimTime(self.world)
        self.time.before_advance = self._before_advance
        self._new_reactor()
        self.printer = self._new_printer()
        self.printer.register_event_handler("klippy:shutdown", self._on_shutdown)
        started = time.monotonic()
        self.reactor.register_callback(self._drive)
        with _rare_collections():
            result = self.printer.run()
        if result == "error_exit":
            self._end(SHUT_DOWN, "internal error of the host; --log FILE gives the details")
        elif "restart" in result and self.printer.get_state_message()[1] == "ready":
            self._end(
                PRINTED, "ended by the file's own RESTART or SAVE_CONFIG: a simulated print is one session"
            )
        if self.ending.status == SHUT_DOWN and self.machine and self.machine.recording.starts_again:
            self._start_again(self.machine)
        self.facts.stages_s["start"] = started - self._wall_start
        self.facts.stages_s["world"] = self.time.world_wall_s
        self.facts.stages_s["host"] = time.monotonic() - started - self.time.world_wall_s
        return self._finish()

    def _start_again(self, machine: Machine) -> None:
        """The host, on the machine as it is after the stop; what it offers of the print is the result of the run."""
        written = self.printer.lookup_object("print_recovery").get_status(0.0)["bytes_per_minute"]
        place_mm = {name: self.world.axis(index)["position_mm"] for name, index in machine.axes.items()}
        self.world.lib.world_stall_host(self.world.pointer, self.world.now)
        self._heater = self._bed = self._plan = None
        self._nozzles = []
        self.printer = restarted.start_again(self._new_printer, self._new_reactor)
        self.facts.recovery = {**restarted.judge(self.printer, place_mm), "bytes_per_minute": round(written)}
        stop = self.ending.reason
        self.ending.status = PRINTED
        found = ": ".join(filter(None, (self.facts.recovery["state"], self.facts.recovery["reason"])))
        self.ending.reason = f"{stop}; started again: the print is {found}"

    def _new_reactor(self) -> reactor_module.Reactor:
        self.reactor = reactor_module.Reactor(self.time)
        return self.reactor

    def _new_printer(self) -> Any:
        options = self.options
        folder = str(options.gcode.resolve().parent)
        start_args = {
            "config_file": str(options.config),
            "config_overrides": [("virtual_sdcard", "path", folder), *options.overrides],
            "open_port": self._open_port,
            "simulator_parameters": world_module.parameter_tables(),
            "apiserver": str(options.api) if options.api else None,
            "gcode_fd": None,
            "start_reason": "startup",
            "log_file": str(options.log.resolve()) if options.log else None,
            "output_folder": str(OUTPUT_FOLDER),  # without a log
            "software_version": "simulation",
            "is_simulated": True,
            "panels": lambda: self.machine.panels if self.machine else {},
            "inject_fault": lambda text: self.injector.now(text) if self.injector else "no machine yet",
            "cpu_info": "simulated time",
        }
        return Printer(self.reactor, start_args)

    def _open_port(self, reactor: reactor_module.Reactor, path: str, baud: int) -> SimPort:
        """The OpenPort of this run: no device, but the MCU whose section names this path."""
        if self.machine is None:
            self.machine = self._build_machine()
            if self.machine.recording.starts_again:
                self.facts.recovery = dict(restarted.NEVER)
        if path not in self.machine.serials:
            raise PortError(f"No simulated MCU has the serial port {path}.")
        return SimPort(self.world, self.time, self.machine.mcus[self.machine.serials[path]])

    def _build_machine(self) -> Machine:
        sections = [section for _, section in self.printer.lookup_objects("simulator")]
        config = self.printer.lookup_object("configfile").get_status(0.0)["config"]
        try:
            settings = [section.settings for section in sections]
            machine = assemble(self.world, settings, config, self.options.builds)
            self.world.open_trace(self.options.trace, machine.recording.trace_rate_hz)
            self._sample_s = 1.0 / machine.recording.trace_rate_hz
            self.time.make_late(machine.recording.host_late_s, self.options.seed)
            self.injector = Injector(Target(machine, self.time, self.printer, self._kill_host))
            self.injector.order(all_orders(machine, self.options.faults))
        except (FaultError, WorldError) as e:
            raise self.printer.config_error(str(e)) from None
        return machine

    # --- while time passes ---
    def _before_advance(self, now: float) -> None:
        if now >= self._next_sample:
            self._next_sample = now + self._sample_s
            self._sample(now)
            wall = time.monotonic()
            if self.options.on_progress is not None and wall >= self._next_progress:
                self._next_progress = wall + PROGRESS_WALL_S
                self.options.on_progress(
                    Progress(self.facts.file_progress, now - self.world.start_s, wall - self._wall_start)
                )

    def _sample(self, now: float) -> None:
        """The host's estimate and target go into the trace."""
        set_channel, pointer, lib = self.world.lib.world_set_channel, self.world.pointer, self.world.lib
        if self._heater is not None:
            estimate_c, target_c = self._heater.get_temp(now)
            set_channel(pointer, lib.WORLD_ESTIMATE_C, estimate_c)
            set_channel(pointer, lib.WORLD_TARGET_C, target_c)
        if self._plan is not None:
            set_channel(pointer, lib.WORLD_MELT_TARGET_C, self._plan.melt_target_c())

    def _sample_checks(self, now: float) -> None:
        """What an induction heater thinks of its own estimate goes into the trace, too; it changes slowly."""
        if not hasattr(self._heater, "get_detail"):
            return  # an ordinary heater
        detail, lib = self._heater.get_detail(now), self.world.lib
        for channel, key in (
            (lib.WORLD_SIGMA_C, "sigma"),
            (lib.WORLD_DRIFT_C, "drift"),
            (lib.WORLD_SUPPLY, "supply"),
        ):
            value = math.nan if detail[key] is None else detail[key]
            lib.world_set_channel(self.world.pointer, channel, value)

    def _find_heaters(self) -> None:
        heaters = self.printer.lookup_object("heaters", None)
        if heaters is None:
            return
        known = heaters.get_all_heaters()
        self._heater = heaters.lookup_heater("extruder") if "extruder" in known else None
        self._bed = heaters.lookup_heater("heater_bed") if "heater_bed" in known else None
        self._plan = self.printer.lookup_object("temperature_plan", None)
        self._nozzles = [section.heater for _, section in self.printer.lookup_objects("induction_heater")]

    def _kill_host(self) -> None:
        """From now on the host does nothing; the machine is watched on."""
        now = self.time.monotonic()
        self._end(SHUT_DOWN, f"the host was killed after {now - self.world.start_s:g} s, as asked by --fault")
        self.time.stall(now + KILLED_S, resumes=False)
        if self.injector is not None and (watch := self.injector.injected[-1].watch) is not None:
            off_s = self.world.watched(watch)["off_s"]
            if off_s >= 0.0:
                self.injector.detected("the MCU, without a host", now + off_s)
        self.printer.request_exit("exit")

    def _on_shutdown(self) -> None:
        if self.injector is not None:
            message = self.printer.get_state_message()[0]
            self.injector.detected(message.strip().partition("\n")[0], self.reactor.monotonic())

    def _count_moves(self, row: Any, count: int, print_time: float) -> None:
        self.facts.moves += count

    # --- the user ---
    def _drive(self, eventtime: float) -> None:
        """Runs in a greenlet of the reactor: wait until ready, print, wait for the end."""
        try:
            if self._wait_ready():
                self._print()
        finally:
            self.printer.request_exit("exit")

    def _pause(self) -> bool:
        """Look again in a while; False when it is time to stop."""
        now = self.reactor.pause(self.reactor.monotonic() + POLL_S)
        set_channel, pointer, lib = self.world.lib.world_set_channel, self.world.pointer, self.world.lib
        if self._bed is not None:
            set_channel(pointer, lib.WORLD_BED_TARGET_C, self._bed.get_temp(now)[1])
        set_channel(pointer, lib.WORLD_WARNING, max((_weight(n.warning()) for n in self._nozzles), default=0))
        self._sample_checks(now)
        until_s = self.options.until_s
        if until_s is not None and now - self.world.start_s >= until_s:
            self._end(PRINTED, f"stopped after {until_s:g} simulated seconds, as asked")
            return False
        return not (self._chip_failed() or self._printer_failed())

    def _chip_failed(self) -> bool:
        """The model of an emulated chip objects to its firmware: nothing after that means anything."""
        try:
            self.world.check()
        except WorldError as e:
            self._end(SHUT_DOWN, f"the emulated chip objects: {e}")
            return True
        return False

    def _printer_failed(self) -> bool:
        message, state = self.printer.get_state_message()
        if state == "shutdown":
            self._end(SHUT_DOWN, _first_paragraph(message))
            self.reactor.pause(self.reactor.monotonic() + AFTERMATH_S)
        elif state == "error":
            self._end(
                SHUT_DOWN if message.startswith("Internal error") else BAD_INPUT, _first_paragraph(message)
            )
        return state in ("shutdown", "error")

    def _end(self, status: int, reason: str) -> None:
        if self.ending.status is None:
            self.ending.status, self.ending.reason = status, reason

    def _wait_ready(self) -> bool:
        while self.printer.get_state_message()[1] != "ready":
            if not self._pause():
                return False
        self._find_heaters()
        # What is there now stays to the end of the process: not looking through it again saves a tenth of the run.
        gc.freeze()
        self.printer.lookup_object("toolhead").register_move_listener(self._count_moves, as_records=True)
        self.printer.lookup_object("gcode").register_output_handler(self._on_output)
        return True

    def _on_output(self, text: str) -> None:
        now = self.reactor.monotonic()
        at = f"{now - self.world.start_s:.1f} s: "
        if text.startswith(WARNINGS):
            words = text[3:].removeprefix("Warning: ")
            self.facts.messages.append(at + words)
            if self.injector is not None:
                self.injector.warned(words, now)
        elif text.startswith("!!"):
            self.facts.faults.append(at + text[2:].strip())
        elif text.startswith(UNKNOWN_COMMAND):
            name = text[len(UNKNOWN_COMMAND) :].strip('"')
            self.facts.unknown_commands[name] = self.facts.unknown_commands.get(name, 0) + 1

    def _print(self) -> None:
        sdcard = self.printer.lookup_object("virtual_sdcard")
        gcode = self.printer.lookup_object("gcode")
        try:
            wrong = preview.objection(self.options.gcode, preview.describe(self.printer))
        except OSError as e:
            wrong = f"Unable to read {self.options.gcode}: {e.strerror}"
        if wrong:
            self.facts.faults.append(wrong)
            self._end(BAD_INPUT, wrong)
            return
        try:
            gcode.run_script(f"SDCARD_PRINT_FILE FILENAME={shlex.quote(self.options.gcode.name)}")
        except self.printer.command_error as e:
            self._end(BAD_INPUT, str(e))
            return
        while self._pause():
            status = sdcard.get_status(self.reactor.monotonic())
            self.facts.file_progress = status["progress"]
            if not status["is_active"] and not self._may_resume():
                break
        else:
            return
        self._finish_print(status)

    def _may_resume(self) -> bool:
        """A paused print, in a run with an end time until which a delayed_gcode or the API may resume it."""
        pause_resume = self.printer.lookup_object("pause_resume", None)
        return self.options.until_s is not None and pause_resume is not None and pause_resume.is_paused

    def _finish_print(self, status: dict[str, Any]) -> None:
        """The file is no longer read: it is at its end, or a command in it failed."""
        if self.facts.faults:
            self._end(BAD_INPUT, self.facts.faults[-1])
            return
        self.printer.lookup_object("toolhead").wait_moves()
        if self._pause():
            self._end(PRINTED, "printed to its end")

    # --- end ---
    def _finish(self) -> Outcome:
        facts, ending = self.facts, self.ending
        message = self.printer.get_state_message()[0]
        if ending.status is None:
            self._end(BAD_INPUT, _first_paragraph(message))
        try:
            if self.machine is not None:
                self.world.close_trace()
        except WorldError as e:
            facts.faults.append(str(e))
        facts.exit_status, facts.reason = ending.status or 0, ending.reason
        facts.simulated_s = self.world.now - self.world.start_s
        facts.wall_s = time.monotonic() - self._wall_start
        if self.machine is not None:
            self._note_machine(self.machine)
        if facts.exit_status == SHUT_DOWN:
            facts.faults.insert(0, facts.reason)
        monitor = self.printer.lookup_object("nozzle_monitor", None)
        if monitor is not None:
            facts.nozzle_monitor = [
                {**row, "t_s": round(row["t_s"] - self.world.start_s, 1)} for row in monitor.history
            ]
        if self.injector is not None and self.injector.injected:
            facts.injected = self.injector.results()
        return Outcome(facts.exit_status, facts.reason, summary(facts, self.machine))

    def _note_machine(self, machine: Machine) -> None:
        for name, index in machine.axes.items():
            lost = machine.world.axis(index)["steps_lost"]
            if lost:
                self.facts.faults.append(f"axis {name} ran against its end: {lost} steps lost")


def _weight(warning: str) -> int:
    """Of a warning in the trace: 2 if it names a thermometer that reads wrong."""
    return 2 if "drift" in warning or "wrong nozzle" in warning else int(bool(warning))


def _first_paragraph(text: str) -> str:
    """The state message without the advice that follows it, on one line."""
    return " ".join(text.partition("\nOnce the underlying issue")[0].split())
