"""Faults of the simulated machine at a given time: simulate.py --fault NAME[:ARG]@T and SIMULATOR_FAULT.

    text ─► parse() ─► Order ─► Injector.check (does it apply here?) ─► at T: FAULTS[name].apply ─► summary "injected"

FAULTS is the one table: a new fault is one line of it. Errors are `FaultError`s for people.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from .machine import Machine
from .simtime import SimTime
from .world import WorldError, parameter_tables

WATCHES_MAX = 32  # as WORLD_WATCHES
FULL_TICKS = 45000
DRIVE_FORCE_N = 60.0  # a geared drive on PLA slips [assumed]
KILLED_S = 2.0  # so long a machine whose host was killed is looked at
BLOB_W_K, CONTACT_W_K = 0.05, 1.0  # plastic around the nozzle; nozzle against a clip [assumed]
SET = {"leg_dead": 6, "supply_short": 7, "sense_short": 8, "held": 9}
SET |= {"nozzle_missing": 1, "coil_open": 2, "stuck_on": 3, "frozen": 4, "lost": 5}  # enum plant_fault


class FaultError(Exception):
    """A fault that does not exist, or does not apply to this machine."""


@dataclass(frozen=True, slots=True)
class Argument:
    """One number: name with its unit, limits, default (None: it must be given)."""

    name: str
    low: float
    high: float
    default: float | None = None


@dataclass(slots=True)
class Target:
    """What faults act on: the first nozzle of the machine, its MCU, and the host, which is in this process."""

    machine: Machine
    time: SimTime
    printer: Any
    kill: Callable[[], None] | None = None

    @property
    def mcu(self) -> int:
        return self.machine.nozzle_mcus[0] if self.machine.nozzle_mcus else 0

    def set(self, name: str, value: float) -> None:
        self.machine.world.set_parameter("nozzle", 0, name, value)

    def change(self, name: str, share: float = 1.0, plus: float = 0.0) -> None:
        self.set(name, self.machine.world.parameter(0, name) * share + plus)

    def ramp(self, name: str, per_s: float) -> None:
        """A straight line from now on, to the end of the parameter's range."""
        row, world = parameter_tables()["nozzle"][name], self.machine.world
        begin, start_s = world.parameter(0, name), world.now - world.start_s
        end = row.max if per_s > 0.0 else row.min
        world.add_profile(0, name, ((start_s, begin), (start_s + (end - begin) / per_s, end)))

    def add(self, fault: str) -> None:
        bits = int(self.machine.world.parameter(0, "fault_set"))
        self.set("fault_set", bits | 1 << SET[fault])

    def cut(self, down: int, up: int, seconds: float) -> None:
        world = self.machine.world
        until_s = world.now + (seconds or math.inf)
        world.lib.world_cut_link(world.pointer, self.mcu, down, up, until_s)

    def world(self, verb: str, *values: float) -> None:
        world = self.machine.world
        getattr(world.lib, f"world_{verb}")(world.pointer, *values)


def _stuck(ticks: float, t: Target) -> None:
    t.set("fault_phase_ticks", ticks)
    t.add("stuck_on")


def _held(lsb: float, t: Target) -> None:
    t.set("fault_noise_lsb", lsb)
    t.add("held")


def _bit(bit: float, level: float, t: Target) -> None:
    name = "adc_set_bits" if level else "adc_clear_bits"
    t.set(name, int(t.machine.world.parameter(0, name)) | 1 << int(bit))


def _clog(hole_mm: float, seconds: float, t: Target) -> None:
    """The hole narrows, and the drive slips where it can push no harder."""
    if not t.machine.world.parameter(0, "drive_force_n"):
        t.set("drive_force_n", DRIVE_FORCE_N)
    if not seconds:
        t.set("hole_mm", hole_mm)
        return
    world = t.machine.world
    start_s, begin_mm = world.now - world.start_s, world.parameter(0, "hole_mm")
    world.add_profile(0, "hole_mm", ((start_s, begin_mm), (start_s + seconds, hole_mm)))


def _command_stuck(ticks: float, t: Target) -> None:
    """The host's commands all ask for one phase."""
    for _, section in t.printer.lookup_objects("induction_heater"):
        unit = section.heater.unit
        queue = unit.queue_plan
        unit.queue_plan = lambda plan, queue=queue: queue(
            [type(command)(command.time_s, int(ticks), command.power_w) for command in plan]
        )


def _sine(size: str, hz: str, value: float, frequency: float, t: Target) -> None:
    t.set(size, value)
    t.set(hz, frequency)


def _kill(t: Target) -> None:
    assert t.kill is not None
    t.kill()


@dataclass(frozen=True, slots=True)
class Fault:
    """`apply(*numbers, target)`; `needs`: nozzle, fan, bed, host or library, see Injector.check."""

    apply: Callable[..., None]
    arguments: tuple[Argument, ...] = ()
    needs: str = "nozzle"


def _add(fault: str) -> Callable[[Target], None]:
    return lambda t: t.add(fault)


def _set(name: str) -> Callable[[float, Target], None]:
    return lambda value, t: t.set(name, value)


def _scale(name: str) -> Callable[[float, Target], None]:
    return lambda factor, t: t.change(name, factor)


_TICKS = Argument("ticks", 0, FULL_TICKS)
_FACTOR = Argument("factor", 0.1, 10.0)
_SECONDS = Argument("s", 0.0, 1e6, 0.0)  # 0: for good, or at once

FAULTS: dict[str, Fault] = {
    "bridge_stuck_on": Fault(_stuck, (Argument("ticks", 1, FULL_TICKS, FULL_TICKS),)),
    "bridge_stuck_off": Fault(partial(_stuck, 0.0)),
    "bridge_leg_dead": Fault(_add("leg_dead")),
    "bridge_short": Fault(_add("supply_short")),
    "command_stuck": Fault(_command_stuck, (_TICKS,)),
    "coil_open": Fault(_add("coil_open")),
    "coil_short": Fault(
        lambda percent, t: t.set("coil_short", percent / 100.0), (Argument("percent", 0.1, 90),)
    ),
    "sense_open": Fault(_add("lost")),
    "sense_short": Fault(_add("sense_short")),
    "sense_frozen": Fault(_add("frozen")),
    "sense_frozen_noise": Fault(_held, (Argument("lsb", 0.0, 1000.0, 1.0),)),
    "sense_gain": Fault(_set("sense_gain"), (Argument("factor", 0.0, 10.0),)),
    "gain_ramp": Fault(lambda x, t: t.ramp("sense_gain", x / 100.0), (Argument("percent_per_s", -1e4, 1e4),)),
    "sense_offset": Fault(_set("sense_offset_lsb"), (Argument("lsb", -4095, 4095),)),
    "sense_skew": Fault(lambda ns, t: t.change("skew_ns", plus=ns), (Argument("ns", -500, 500),)),
    "adc_bit": Fault(_bit, (Argument("bit", 0, 11), Argument("level", 0, 1))),
    "adc_stop": Fault(lambda t: t.machine.world.stop_adc(t.mcu), needs="library"),
    "c1_step": Fault(lambda x, t: t.change("c1_factor", 1.0 + x / 100.0), (Argument("percent", -50, 50),)),
    "c1_ramp": Fault(lambda x, t: t.ramp("c1_factor", x * 1e-6), (Argument("ppm_per_s", -1e6, 1e6),)),
    "supply_step": Fault(lambda x, t: t.change("supply_v", plus=x), (Argument("volt", -100, 76),)),
    "supply_sag": Fault(lambda x, t: t.change("supply_ohm", plus=x), (Argument("ohm", 0, 1),)),
    "supply_ripple": Fault(_set("ripple_v"), (Argument("volt", 0, 20),)),
    "emi": Fault(
        partial(_sine, "emi_lsb", "emi_hz"), (Argument("lsb", 0, 1000), Argument("hz", 0.001, 3000))
    ),
    "vibration": Fault(
        partial(_sine, "move_um", "move_hz"), (Argument("um", 0, 1000), Argument("hz", 0.01, 5000))
    ),
    "nozzle_missing": Fault(_add("nozzle_missing")),
    "nozzle_mass": Fault(_scale("mass_factor"), (Argument("factor", 0.2, 5.0),)),
    "blob": Fault(lambda t: t.change("loss_w_k", plus=BLOB_W_K)),
    "thermal_short": Fault(lambda t: t.change("link_w_k", plus=CONTACT_W_K)),
    "clog": Fault(_clog, (Argument("mm", 0.0, 2.0), _SECONDS)),
    "runout": Fault(lambda t: t.set("flow_share", 0.0)),
    "grind": Fault(lambda lost, t: t.set("flow_share", 1.0 - lost), (Argument("share", 0.0, 1.0),)),
    "cold_plug": Fault(lambda t: t.set("hole_mm", 0.0)),
    "fan_stuck": Fault(lambda on, t: t.world("stick_fan", 0, on), (Argument("0|1", 0, 1),), "fan"),
    "clock_step": Fault(lambda ppm, t: t.world("step_clock", t.mcu, ppm), (Argument("ppm", -1e5, 1e5),)),
    "link_cut": Fault(lambda s, t: t.cut(1, 1, s), (_SECONDS,), "mcu"),
    "uplink_cut": Fault(lambda s, t: t.cut(0, 1, s), (_SECONDS,), "mcu"),
    "link_damage": Fault(lambda x, t: t.world("damage_link", t.mcu, x), (Argument("fraction", 0, 1),), "mcu"),
    "host_stall": Fault(
        lambda s, t: t.time.stall(t.time.monotonic() + s), (Argument("s", 0.0, 100.0),), "mcu"
    ),
    "host_kill": Fault(_kill, needs="host"),
    "mcu_reset": Fault(lambda t: t.world("reset_mcu", t.mcu), needs="mcu"),
    "wrong_calibration": Fault(_set("reading_factor"), (_FACTOR,)),
    "wrong_power_law": Fault(_scale("efficiency_factor"), (Argument("factor", 0.0, 5.0),)),
    "bed_stuck_on": Fault(
        lambda t: t.machine.world.set_parameter("load", t.machine.beds[0], "fault", 4.0), needs="bed"
    ),
}


@dataclass(frozen=True, slots=True)
class Order:
    """One fault to inject; `at_s` after the start."""

    text: str
    name: str
    numbers: tuple[float, ...]
    at_s: float


def parse(text: str, at_s: float | None = None) -> Order:
    """'NAME[:ARG]@T', or without '@T' for a given time. Raises FaultError."""
    what, at, when = text.rpartition("@") if at_s is None else (text, "@", str(at_s))
    try:
        time_s = float(when)
    except ValueError:
        time_s = math.nan
    if not at or not 0.0 <= time_s < math.inf:
        raise FaultError(
            f"{text}: this needs the form NAME[:ARG]@T with T in simulated seconds, such as coil_open@20."
        )
    name, _, given = what.partition(":")
    if name not in FAULTS:
        raise FaultError(f"{text}: there is no fault '{name}'. There are: {', '.join(FAULTS)}.")
    return Order(what, name, _numbers(text, name, given), time_s)


def _numbers(text: str, name: str, given: str) -> tuple[float, ...]:
    arguments = FAULTS[name].arguments
    words = re.split("[,=]", given) if given else []
    form = name + (":" if arguments else "") + ",".join(a.name for a in arguments)
    if len(words) > len(arguments):
        raise FaultError(f"{text}: {name} takes {len(arguments) or 'no'} numbers, as in {form}@20.")
    found = []
    for number, argument in enumerate(arguments):
        if number >= len(words) and argument.default is None:
            raise FaultError(f"{text}: {name} needs its argument, as in {form}@20.")
        try:
            value = float(words[number]) if number < len(words) else float(argument.default or 0.0)
        except ValueError:
            raise FaultError(f"{text}: '{words[number]}' is not a number, as in {form}@20.") from None
        if not argument.low <= value <= argument.high:
            limits = f"from {argument.low:g} to {argument.high:g}"
            raise FaultError(f"{text}: {argument.name} must be {limits}, not {value:g}.")
        found.append(value)
    return tuple(found)


@dataclass(slots=True)
class Injected:
    """A fault that was injected, and what came of it; times are world times."""

    order: Order
    at_s: float | None = None
    watch: int | None = None
    detected_by: str | None = None
    detected_s: float | None = None
    warning: str | None = None
    warned_s: float | None = None


@dataclass(slots=True)
class Injector:
    """Injects orders at their times and notes what the printer says of it."""

    target: Target
    injected: list[Injected] = field(default_factory=list)

    def order(self, orders: Sequence[Order]) -> None:
        """To be injected at their times. Raises FaultError for what does not apply."""
        if len(orders) + len(self.injected) > WATCHES_MAX:
            raise FaultError(f"more than {WATCHES_MAX} faults in one run.")
        for order in orders:
            self.check(order)
        self.injected += [Injected(order) for order in sorted(orders, key=lambda order: order.at_s)]
        self.target.time.on_alarm = self._on_alarm
        self._set_alarm()

    def check(self, order: Order) -> None:
        """Does the machine have what breaks?"""
        machine, fault, name = self.target.machine, FAULTS[order.name], order.name
        needs = fault.needs
        if needs in ("nozzle", "library") and not machine.nozzle_mcus:
            raise FaultError(
                f"{order.text}: the machine has no induction-heated nozzle ([simulator nozzle NAME])."
            )
        if needs == "fan" and not machine.fans:
            raise FaultError(f"{order.text}: the machine has no fan ([simulator fan NAME]).")
        if needs == "bed" and not machine.beds:
            raise FaultError(f"{order.text}: the machine has no bed ([simulator load bed]).")
        if needs == "host" and self.target.kill is None:
            raise FaultError(
                f"{order.text}: host and machine are one process here; end the host itself instead."
            )
        if needs == "library" and next(iter(machine.builds.values())).emulated:
            raise FaultError(f"{order.text}: the ADC of an emulated chip cannot be stopped from outside.")
        if name in ("fan_stuck", "adc_bit") and any(number % 1 for number in order.numbers):
            raise FaultError(f"{order.text}: whole numbers are needed.")

    def now(self, text: str) -> str:
        """Inject at once; returns what is wrong with it, "" if nothing."""
        world = self.target.machine.world
        try:
            self.order([parse(text, world.now - world.start_s)])
        except FaultError as e:
            return str(e)
        return ""

    def _set_alarm(self) -> None:
        start_s = self.target.machine.world.start_s
        waiting = [fault.order.at_s + start_s for fault in self.injected if fault.at_s is None]
        self.target.time.alarm_s = min(waiting, default=math.inf)

    def _on_alarm(self) -> None:
        world = self.target.machine.world
        due = [f for f in self.injected if f.at_s is None and f.order.at_s + world.start_s <= world.now]
        for fault in due:
            fault.at_s = world.now
        self._set_alarm()
        for fault in due:
            if self.target.machine.nozzle_mcus:
                fault.watch = world.watch(0)
            FAULTS[fault.order.name].apply(*fault.order.numbers, self.target)

    def detected(self, by: str, now: float) -> None:
        """The printer objects."""
        for fault in self.injected:
            if fault.at_s is not None and fault.detected_by is None:
                fault.detected_by, fault.detected_s = by, now

    def warned(self, text: str, now: float) -> None:
        """The printer says something and goes on."""
        for fault in self.injected:
            if fault.at_s is not None and fault.warning is None and fault.detected_by is None:
                fault.warning, fault.warned_s = text, now

    def results(self) -> list[dict[str, Any]]:
        """For the summary."""
        return [self._result(fault) for fault in self.injected]

    def _result(self, fault: Injected) -> dict[str, Any]:
        found: dict[str, Any] = {"fault": fault.order.text, "at_s": fault.order.at_s}
        if fault.at_s is None:
            return {**found, "detected_by": None, "note": "the run ended before"}
        seen = self.target.machine.world.watched(fault.watch) if fault.watch is not None else None
        after_s = None if fault.detected_s is None else fault.detected_s - fault.at_s
        found |= {"detected_by": fault.detected_by, "after_ms": _milli(after_s)}
        if fault.warning is not None and fault.warned_s is not None:
            found |= {"warning": fault.warning, "warned_after_ms": _milli(fault.warned_s - fault.at_s)}
        if seen is None:
            return found
        nozzle = self.target.machine.world.nozzle(0)
        off_s, commanded_s = (seen[name] if seen[name] >= 0.0 else None for name in ("off_s", "commanded_s"))
        if after_s is not None and commanded_s is not None and seen["target_c"] > 0.0:
            found["after_ms"] = _milli(min(after_s, commanded_s))  # the MCU acts before the host knows
        return found | {
            "start_c": round(seen["start_c"], 3),
            "bridge_off_after_ms": _milli(off_s),
            "peak_above_target_c": round(seen["peak_above_c"], 3),
            "peak_c": round(seen["peak_c"], 3),
            "power_at_end_w": round(nozzle["power_w"], 3),
            "energy_after_detection_j": round(seen["after_j"], 3),
            "supply_closed_at_end": bool(nozzle["supply_closed"]),
        }


def _milli(seconds: float | None) -> float | None:
    return None if seconds is None else round(1000.0 * seconds, 3)


def all_orders(machine: Machine, given: Sequence[str]) -> list[Order]:
    """Of the config and of the command line. Raises WorldError."""
    try:
        return [parse(text) for text in (*machine.recording.faults, *given)]
    except FaultError as e:
        raise WorldError(str(e)) from None
