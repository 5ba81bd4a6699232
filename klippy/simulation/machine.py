"""From the config file's simulator sections to a machine in the world.

    [simulator axis x]  ──┐ what is left out there
    [stepper_x]         ──┴─ is taken from here ──► AxisPlan ──► world.add_axis

`config` is the file as text: section → option → value (the shape of status "configfile.config").
Errors are `WorldError`s for people.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from extras.accelerometer.axes import mounted_as, parse_axes_map
from extras.accelerometer.chips import CHIPS
from extras.probing.surface_fit import fit_plane
from extras.simulator import (
    AccelerometerSettings,
    AxisSettings,
    FanSettings,
    FeedSettings,
    FrameSettings,
    GaugeSettings,
    LoadSettings,
    McuSettings,
    MountSettings,
    NozzleSettings,
    PanelSettings,
    ProbeSettings,
    ReferenceSettings,
    SimulatorSettings,
)

from .builds import Build, make_build
from .gauges import add_gauge, measuring_section
from .panel.simulated import SimulatedPanel, add_panel
from .world import Pin, World, WorldError, parameter_values

Config = Mapping[str, Mapping[str, str]]
Settings = (
    SimulatorSettings
    | McuSettings
    | NozzleSettings
    | LoadSettings
    | AxisSettings
    | FanSettings
    | ReferenceSettings
    | ProbeSettings
    | GaugeSettings
    | FrameSettings
    | MountSettings
    | AccelerometerSettings
    | PanelSettings
)
_T = TypeVar("_T")

_PIN = re.compile(r"^(?P<marks>[!^~ ]*)(?:(?P<mcu>[^:]+):)? *(?P<name>\w+)$")
_ROLES = {"x": "X", "y": "Y", "z": "Z", "extruder": "E"}
_SLACK_MM = 2.0  # how far the frame lets an axis go beyond what the host thinks possible
_TOWER_MM = 600.0  # way of a delta's carriage below its switch
# Frames in which a carriage goes by a mix of two motors' ways: kinematics → axis → (partner, own share, its share)
_FRAMES: dict[str, dict[str, tuple[str, float, float]]] = {
    "corexy": {"x": ("y", 0.5, 0.5), "y": ("x", -0.5, 0.5)},
    "corexz": {"x": ("z", 0.5, 0.5), "z": ("x", -0.5, 0.5)},
    "hybrid_corexy": {"x": ("y", 1.0, 1.0)},
    "hybrid_corexz": {"x": ("z", 1.0, 1.0)},
}
_TOWERS = ("a", "b", "c")  # each with a switch at its top


@dataclass(slots=True)
class Machine:
    """Where things are in the world: indices by name."""

    world: World
    mcus: dict[str, int] = field(default_factory=dict)
    builds: dict[str, Build] = field(default_factory=dict)  # what each MCU runs
    serials: dict[str, str] = field(default_factory=dict)  # serial path → name of the MCU
    axes: dict[str, int] = field(default_factory=dict)
    fans: dict[str, int] = field(default_factory=dict)
    nozzles: dict[str, int] = field(default_factory=dict)
    loads: dict[str, int] = field(default_factory=dict)
    beds: list[int] = field(default_factory=list)  # those of them that are beds
    probes: dict[str, int] = field(default_factory=dict)
    gauges: dict[str, int] = field(default_factory=dict)  # by the host's section
    recording: SimulatorSettings = field(default_factory=SimulatorSettings)
    nozzle_mcus: list[int] = field(default_factory=list)  # of each nozzle
    accelerometers: dict[str, int] = field(default_factory=dict)
    panels: dict[str, SimulatedPanel] = field(default_factory=dict)  # by the host's section


def assemble(
    world: World, settings: Iterable[Settings], config: Config, builds: Mapping[str, str] | None = None
) -> Machine:
    """Build everything the config describes; `builds`: MCU → build in place of the config's. Raises WorldError."""
    things = list(settings)
    if not things:
        raise WorldError(
            "The config has no [simulator ...] section: it describes a real printer, and a simulated one needs to "
            "know its machine (docs/reference/Simulation.md; config/sim-induction.cfg is an example)."
        )
    machine = Machine(world)
    for recording in _of(things, SimulatorSettings):
        machine.recording = recording
    _add_mcus(machine, {mcu.name: mcu for mcu in _of(things, McuSettings)}, config, builds or {})
    for axis in _of(things, AxisSettings):
        machine.axes[axis.name] = _add_axis(machine, axis, config)
    _couple_axes(machine, config)
    for frame in _of(things, FrameSettings):
        world.add_frame(frame.frequency_hz, frame.damping_ratio, frame.motor_hz)
    for accelerometer in _of(things, AccelerometerSettings):
        machine.accelerometers[accelerometer.name] = _add_accelerometer(machine, accelerometer, config)
    panels = _of(things, PanelSettings)
    machine.panels.update({panel.name: _add_panel(machine, panel, config) for panel in panels})
    for probe in _of(things, ProbeSettings):
        machine.probes[probe.name] = _add_probe(machine, probe, config)
    gauges = _of(things, GaugeSettings)
    machine.gauges.update({gauge.name: _add_gauge(machine, gauge, config) for gauge in gauges})
    for fan in _of(things, FanSettings):
        pin = _pin(machine, fan.pin, config, fan.section, "pin", f"simulator fan {fan.name}")
        machine.fans[fan.name] = world.add_fan(pin, fan.spin_up_s)
    for nozzle in _of(things, NozzleSettings):
        machine.nozzles[nozzle.name] = _add_nozzle(machine, nozzle, config)
    for mount in _of(things, MountSettings):
        nozzle_number = _index(machine.nozzles, mount.nozzle, "nozzle", f"simulator mount {mount.nozzle}")
        world.add_mount(nozzle_number, mount.axis, mount.values)
    for reference in _of(things, ReferenceSettings):
        _add_reference(machine, reference, config)
    for load in _of(things, LoadSettings):
        machine.loads[load.name] = _add_load(machine, load, config)
        if load.kind == "bed":
            machine.beds.append(machine.loads[load.name])
    return machine


def _of(things: list[Settings], kind: type[_T]) -> list[_T]:
    return [thing for thing in things if isinstance(thing, kind)]


# --- MCUs and pins ---


def _add_mcus(
    machine: Machine, known: dict[str, McuSettings], config: Config, builds: Mapping[str, str]
) -> None:
    for section, options in config.items():
        words = section.split(None, 1)
        if words[:1] != ["mcu"]:
            continue
        name = words[1] if len(words) > 1 else "mcu"
        mcu = known.pop(name, None) or McuSettings(name)
        build = make_build(builds.get(name, mcu.build))
        machine.builds[name] = build
        machine.mcus[name] = machine.world.add_mcu(
            mcu.clock_ppm,
            mcu.baud,
            mcu.latency_s,
            mcu.jitter_s,
            mcu.corrupt,
            mcu.drop,
            mcu.duplicate,
            build=build,
        )
        machine.world.set_chip_temperature(machine.mcus[name], mcu.chip_temp_c)
        if "serial" in options:
            machine.serials[options["serial"]] = name
    if known:
        missing = next(iter(known))
        raise WorldError(
            f"Section 'simulator mcu {missing}' has no section 'mcu {missing}' that it belongs to."
        )


def parse_pin(text: str, machine: Machine, where: str) -> Pin:
    """'!mcu:PA3' → Pin. Pull-ups play no part: a simulated switch drives its line both ways."""
    match = _PIN.match(text.strip())
    name = (match["mcu"] or "mcu").strip() if match else "mcu"
    if name not in machine.mcus:
        raise WorldError(f"{where}: pin '{text}' names the MCU '{name}', which is not in the config.")
    build = machine.builds[name]
    number = build.pin(match["name"]) if match else None
    if match is None or number is None:
        raise WorldError(f"{where}: '{text}' is not a pin of the MCU '{name}' (build {build.name}).")
    return Pin(machine.mcus[name], number, "!" in match["marks"])


def _pin(machine: Machine, given: str | None, config: Config, section: str, option: str, where: str) -> Pin:
    text = given if given is not None else config.get(section, {}).get(option)
    if text is None:
        raise WorldError(
            f"Section '{where}' needs option '{option}', as section '{section}' does not give it."
        )
    return parse_pin(text, machine, f"Section '{where}', {option}")


# --- axes ---


def _add_axis(machine: Machine, axis: AxisSettings, config: Config) -> int:
    where = f"simulator axis {axis.name}"
    assumed = config.get(axis.section, {})
    if re.fullmatch(r"[xyz]\d+", axis.name):  # one more motor of the axis
        assumed = {**config.get(f"stepper_{axis.name[0]}", {}), "endstop_pin": "", **assumed}
    role = _ROLES.get(axis.name, "OTHER")
    step = _pin(machine, axis.step_pin, config, axis.section, "step_pin", where)
    dir_pin = _pin(machine, axis.dir_pin, config, axis.section, "dir_pin", where)
    if step.mcu != dir_pin.mcu:
        raise WorldError(f"Section '{where}': step pin and dir pin must be on one MCU.")
    mm_per_step = axis.mm_per_step or _mm_per_step(assumed, where)
    if role == "E":
        return machine.world.add_axis(role, step, dir_pin, mm_per_step, both_edges=axis.both_edges)
    if _kinematics(config) == "delta" and axis.name in _TOWERS:
        assumed = _tower_assumption(assumed, config, where)
    low = _first(axis.position_min_mm, _number(assumed, "position_min", 0.0, where) - _SLACK_MM)
    high = _first(axis.position_max_mm, _number(assumed, "position_max", 200.0, where) + _SLACK_MM)
    if not low < high:
        raise WorldError(f"Section '{where}': position_min must be below position_max.")
    endstop_mm = _first(axis.endstop_mm, _number(assumed, "position_endstop", low + _SLACK_MM, where))
    endstop_text = axis.endstop_pin or assumed.get("endstop_pin")
    if endstop_text and endstop_text.endswith(
        "virtual_endstop"
    ):  # something else's pin: of a probe or a driver
        endstop_text = None
    endstop = parse_pin(endstop_text, machine, f"Section '{where}', endstop_pin") if endstop_text else None
    start_mm = _first(axis.start_mm, low + 0.4 * (high - low))
    return machine.world.add_axis(
        role,
        step,
        dir_pin,
        mm_per_step,
        start_mm=min(max(start_mm, low), high),
        limits_mm=(low, high),
        endstop=endstop,
        endstop_mm=endstop_mm,
        endstop_at_max=endstop_mm > 0.5 * (low + high),
        both_edges=axis.both_edges,
    )


# --- accelerometers ---


def _add_accelerometer(machine: Machine, settings: AccelerometerSettings, config: Config) -> int:
    where = f"simulator accelerometer {settings.name}"
    host = config.get(settings.name)
    kind = settings.name.split(maxsplit=1)[0]
    if host is None or kind not in CHIPS:
        raise WorldError(f"Section '{where}' needs a section '{settings.name}' that it belongs to.")
    software = [option for option in host if "software" in option]
    if software:
        raise WorldError(f"Section '{where}': {software[0]}: a simulated chip needs a bus of the hardware.")
    select, i2c = None, (-1, 0)
    if "cs_pin" in host:
        select = _pin(machine, host["cs_pin"], config, settings.name, "cs_pin", where)
    else:
        mcu = _index(machine.mcus, host.get("i2c_mcu", "mcu"), "mcu", where)
        i2c = mcu, int(_number(host, "i2c_address", CHIPS[kind].address, where))
    return machine.world.add_accelerometer(
        kind,
        settings.orientation or mounted_as(parse_axes_map(host.get("axes_map", "x, y, z"))),
        select,
        i2c,
        -1.0 if settings.noise_ug is None else settings.noise_ug,
        settings.rate_error,
        settings.fault,
    )


# --- displays ---


def _add_panel(machine: Machine, settings: PanelSettings, config: Config) -> SimulatedPanel:
    where = f"simulator panel {settings.name}"
    host = config.get(settings.name)
    if host is None:
        raise WorldError(f"Section '{where}' needs a section '{settings.name}' that it belongs to.")
    i2c_mcu = _index(machine.mcus, host.get("i2c_mcu", "mcu"), "mcu", where)
    return add_panel(
        machine.world,
        settings.name,
        host,
        lambda text: parse_pin(text, machine, f"Section '{where}'"),
        i2c_mcu,
    )


# --- bed and probe ---


def _add_gauge(machine: Machine, settings: GaugeSettings, config: Config) -> int:
    where = f"simulator gauge {settings.name}"
    probe = _index(machine.probes, "", "probe", where)

    def pin(text: str) -> Pin:
        return parse_pin(text, machine, f"Section '{where}'")

    return add_gauge(machine.world, settings, config, probe, pin, machine.mcus)


def _add_probe(machine: Machine, probe: ProbeSettings, config: Config) -> int:
    where = f"simulator probe {probe.name}".rstrip()
    measuring = measuring_section(config)
    assumed = config.get("bltouch") or config.get("smart_effector") or config.get(measuring or "probe", {})
    if measuring is None or probe.pin:
        section = "smart_effector" if "smart_effector" in config else "probe"
        pin = _pin(machine, probe.pin or assumed.get("sensor_pin"), config, section, "pin", where)
    else:
        pin = Pin()  # a gauge measures
    control_text = probe.control_pin or assumed.get("control_pin")
    control = parse_pin(control_text, machine, f"Section '{where}', control_pin") if control_text else None
    x, y, z = (
        _first(value, _number(assumed, option, 0.0, where))
        for value, option in zip(probe.offset_mm, ("x_offset", "y_offset", "z_offset"), strict=True)
    )
    axes = _index(machine.axes, "x", "axis", where), _index(machine.axes, "y", "axis", where)
    motors = _z_motors(machine, probe, config, where)
    return machine.world.add_probe(
        pin, axes, motors, (x, y, z), probe.bed, probe.noise_mm, control, probe.stuck
    )


def _z_motors(
    machine: Machine, probe: ProbeSettings, config: Config, where: str
) -> list[tuple[int, tuple[float, float, float]]]:
    """Each Z motor with its share in the height at x, y: the plane through (or nearest to) them all."""
    names = sorted(name for name in machine.axes if re.fullmatch(r"z\d*", name))
    if len(names) < 2:
        return [(_index(machine.axes, "z", "axis", where), (1.0, 0.0, 0.0))]
    places = probe.z_positions or _z_positions(config)
    if len(places) != len(names):
        raise WorldError(
            f"Section '{where}': z_positions has {len(places)} places for {len(names)} Z axes ({', '.join(names)})."
        )
    motors = []
    for number, name in enumerate(names):
        share = fit_plane(places, [float(other == number) for other in range(len(names))])
        motors.append((machine.axes[name], (share.height, share.slope_x, share.slope_y)))
    return motors


def _z_positions(config: Config) -> list[tuple[float, float]]:
    """Where the Z motors hold the bed, as the host's levelling assumes."""

    def pairs(section: str, option: str) -> list[tuple[float, float]]:
        lines = config.get(section, {}).get(option, "").splitlines()
        return [(float(x), float(y)) for x, y in (line.split(",") for line in lines if line.strip())]

    corners = pairs("quad_gantry_level", "gantry_corners")
    if len(corners) == 2:
        (x0, y0), (x1, y1) = corners
        return [(x0, y0), (x0, y1), (x1, y1), (x1, y0)]
    return pairs("z_tilt", "z_positions")


def _kinematics(config: Config) -> str:
    return config.get("printer", {}).get("kinematics", "")


def _couple_axes(machine: Machine, config: Config) -> None:
    """Belts that join two motors, as the kinematics says."""
    for name, (partner, own_share, partner_share) in _FRAMES.get(_kinematics(config), {}).items():
        if name in machine.axes and partner in machine.axes:
            machine.world.couple_axes(machine.axes[name], machine.axes[partner], own_share, partner_share)


def _tower_assumption(assumed: Mapping[str, str], config: Config, where: str) -> Mapping[str, str]:
    """A delta's carriage, its place counted so that it meets its switch at the tower's position_endstop."""
    first = config.get("stepper_a", {})
    top_mm = _number({**first, **assumed}, "position_endstop", 200.0, where)
    way = {"position_endstop": top_mm, "position_min": top_mm - _TOWER_MM, "position_max": top_mm}
    return {**first, **assumed, **{option: str(value) for option, value in way.items()}}


def _first(value: float | None, default: float) -> float:
    return default if value is None else value


def _number(options: Mapping[str, str], option: str, default: float, where: str) -> float:
    try:
        return float(options.get(option, default))
    except ValueError:
        raise WorldError(f"Section '{where}': option '{option}' of the stepper is not a number.") from None


def _mm_per_step(stepper: Mapping[str, str], where: str) -> float:
    """What the host's own section says one step moves, mm."""
    distance = _number(stepper, "rotation_distance", 0.0, where)
    microsteps = _number(stepper, "microsteps", 0.0, where)
    if distance <= 0.0 or microsteps <= 0.0:
        raise WorldError(
            f"Section '{where}' needs option 'mm_per_step': there is no stepper section with "
            "rotation_distance and microsteps."
        )
    return distance / (
        _number(stepper, "full_steps_per_rotation", 200.0, where) * microsteps * _gearing(stepper)
    )


def _gearing(stepper: Mapping[str, str]) -> float:
    """Motor turns per output turn, from 'gear_ratio: 50:10, 3:1'."""
    ratio = 1.0
    for pair in stepper.get("gear_ratio", "").split(","):
        if ":" in pair:
            motor, output = pair.split(":")
            ratio *= float(motor) / float(output)
    return ratio


# --- heaters ---


def _feed(machine: Machine, feed: FeedSettings, where: str) -> tuple[int, float]:
    area_mm2 = math.pi / 4.0 * feed.filament_diameter_mm**2
    if feed.axis is None:
        return -1, area_mm2
    return _index(machine.axes, feed.axis, "axis", where), area_mm2


def _index(table: Mapping[str, int], name: str | None, kind: str, where: str) -> int:
    if name is None:
        return -1
    if name not in table:
        raise WorldError(
            f"Section '{where}' names the {kind} '{name}', and there is no section 'simulator {kind} {name}'."
        )
    return table[name]


def _add_nozzle(machine: Machine, nozzle: NozzleSettings, config: Config) -> int:
    where = f"simulator nozzle {nozzle.name}"
    if nozzle.mcu not in machine.mcus:
        raise WorldError(f"Section '{where}' names the MCU '{nozzle.mcu}', which is not in the config.")
    axis, area_mm2 = _feed(machine, nozzle.feed, where)
    fan = _index(machine.fans, nozzle.fan, "fan", where)
    values = parameter_values("nozzle", nozzle.preset, dict(nozzle.parameters))
    index = machine.world.add_nozzle(machine.mcus[nozzle.mcu], values, axis, area_mm2, fan)
    machine.nozzle_mcus.append(machine.mcus[nozzle.mcu])
    for name, points in nozzle.profiles.items():
        machine.world.add_profile(index, name, points)
    heater = config.get(f"induction_heater {nozzle.name}", {})
    if pin := nozzle.vdc_pin or heater.get("vdc_pin"):
        full_scale_v = nozzle.vdc_scale_v or _number(heater, "vdc_scale", 0.0, where)
        if full_scale_v <= 0.0:
            raise WorldError(f"Section '{where}' needs option 'vdc_scale' with its 'vdc_pin'.")
        machine.world.add_supply_sensor(
            index, parse_pin(pin, machine, f"Section '{where}', vdc_pin"), full_scale_v
        )
    _add_supply_switch(machine, nozzle, index, heater.get("enable_pin"))
    return index


def _add_supply_switch(machine: Machine, nozzle: NozzleSettings, index: int, assumed: str | None) -> None:
    if pin := nozzle.enable_pin or assumed:
        enable = parse_pin(pin, machine, f"Section 'simulator nozzle {nozzle.name}', enable_pin")
        machine.world.add_supply_switch(index, enable, nozzle.supply_delay_s, nozzle.supply_watchdog_s)


def _add_reference(machine: Machine, reference: ReferenceSettings, config: Config) -> int:
    where = f"simulator reference {reference.name}"
    pin = _pin(machine, reference.sensor_pin, config, reference.section, "sensor_pin", where)
    nozzle = _index(machine.nozzles, reference.nozzle, "nozzle", where)
    return machine.world.add_reference(
        nozzle, pin, reference.gain, reference.tau_s, reference.volt_per_k, reference.adc_volt
    )


def _add_load(machine: Machine, load: LoadSettings, config: Config) -> int:
    where = f"simulator load {load.name}"
    heater = _pin(machine, load.heater_pin, config, load.section, "heater_pin", where)
    sensor = _pin(machine, load.sensor_pin, config, load.section, "sensor_pin", where)
    axis, area_mm2 = _feed(machine, load.feed, where)
    fan = _index(machine.fans, load.fan, "fan", where)
    values = parameter_values("load", load.kind, dict(load.parameters))
    return machine.world.add_load(values, load.kind == "bed", heater, sensor, axis, area_mm2, fan)
