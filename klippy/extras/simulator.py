"""The simulated printer's sections of printer.cfg: read and checked here, acted upon only by a simulation.

    [simulator]                 how the run is recorded
    [simulator mcu NAME]        the line to one MCU and the error of its clock
    [simulator nozzle NAME]     an induction-heated nozzle on an MCU's bridge: preset and plant parameters,
                                each a number or TIME:VALUE, TIME:VALUE, ...
    [simulator load NAME]       a bed or a conventional hotend: heater pin, sensor pin, parameters
    [simulator reference NAME]  a thermocouple on a nozzle, to calibrate against: gain, tau (Table 6), amplifier
    [simulator axis NAME]       what a stepper moves, and the switch at its end
    [simulator fan NAME]        a fan
    [simulator probe]           the bed's surface, and the probe that looks for it
    [simulator frame]           ringing of the axes X and Y
    [simulator panel SECTION]   the display of section [SECTION] ("display", "display second")
    [simulator gauge SECTION]   the force or the coil that [load_cell_probe], [probe_eddy_current NAME] measure
    [simulator accelerometer NAME]   the accelerometer of section [NAME] ("adxl345", "lis2dw bed"), on that frame

These describe the machine as it *is*; the other sections say what the host assumes. Whatever is left out
here is taken from the host's section of the same thing (stepper_NAME, NAME, heater_bed, ...). So assumption
and machine agree unless a test sets them apart. A host without a simulation reads and checks these sections
too and does nothing with them, so the same file serves both.

The plant's parameters have one home, the C tables plant_params and thermal_load_params. A simulation hands
them in as start_args["simulator_parameters"]; without them names and ranges of parameters are not checked.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from configfile import ConfigWrapper

from .accelerometer.axes import read_axes_map

TRACE_RATE_HZ = 100.0
LINE_BAUD = 250000.0
LINE_LATENCY_S = 0.0005  # a USB serial adapter's turn-round, both directions alike
FAN_SPIN_UP_S = 0.2
PANEL_READ_S = 5.0
CHIP_TEMP_C = 40.0  # a room of 25 C and what the chip's own losses add on a small board
FILAMENT_DIAMETER_MM = 1.75
SUPPLY_DELAY_S = 0.001  # a solid-state switch; a relay takes 15 ms
NOZZLE_PRESETS = ("reference", "strong", "light", "real")
MCU_BUILDS = ("simulator", "stm32f334", "atmega2560")


class ParameterRow(Protocol):
    """One plant parameter, as the C table has it."""

    name: str
    unit: str
    min: float
    max: float


_LETTER_AXIS = re.compile(r"[a-z]|[xyz][0-9]+")  # x and z1 belong to stepper_x and stepper_z1

Profile = tuple[tuple[float, float], ...]  # (s since the start, value), times rising

ParameterTables = Mapping[str, Mapping[str, ParameterRow]]  # "nozzle" and "load" → name → row


@dataclass(frozen=True, slots=True)
class SimulatorSettings:
    """[simulator]: trace rows a simulated second; for how long the host does nothing, at random; faults as simulate.py
    --fault takes them; whether the host is started again after a stop.
    """

    trace_rate_hz: float = TRACE_RATE_HZ
    host_late_s: float = 0.0
    faults: tuple[str, ...] = ()
    starts_again: bool = False


@dataclass(frozen=True, slots=True)
class McuSettings:
    """[simulator mcu NAME]. Probabilities are per byte and direction; with baud 0 bytes take no time.

    `build`: which build of the firmware it runs; a chip's image runs on an emulator, whose line has the chip's baud.
    """

    name: str
    clock_ppm: float = 0.0
    baud: float = LINE_BAUD
    latency_s: float = LINE_LATENCY_S
    jitter_s: float = 0.0
    corrupt: float = 0.0
    drop: float = 0.0
    duplicate: float = 0.0
    build: str = "simulator"
    chip_temp_c: float = CHIP_TEMP_C


@dataclass(frozen=True, slots=True)
class FeedSettings:
    """Which axis pushes filament through; None: none."""

    axis: str | None
    filament_diameter_mm: float = FILAMENT_DIAMETER_MM


@dataclass(frozen=True, slots=True)
class NozzleSettings:
    """[simulator nozzle NAME]"""

    name: str
    mcu: str
    preset: str  # reference, strong, light or real
    feed: FeedSettings
    fan: str | None
    parameters: Mapping[str, float]
    profiles: Mapping[str, Profile]
    vdc_pin: str | None  # None: as in [induction_heater NAME]
    vdc_scale_v: float | None
    enable_pin: str | None  # likewise: closes the switch in the bridge's supply
    supply_delay_s: float
    supply_watchdog_s: float  # 0: the pin's level counts


@dataclass(frozen=True, slots=True)
class LoadSettings:
    """[simulator load NAME]; pins None: as in the heater's own section."""

    name: str
    kind: str  # bed or hotend
    section: str
    heater_pin: str | None
    sensor_pin: str | None
    feed: FeedSettings
    fan: str | None
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class ReferenceSettings:
    """[simulator reference NAME]; pin None: as in [temperature_sensor NAME]."""

    name: str
    section: str
    sensor_pin: str | None
    nozzle: str
    gain: float  # about 25 degC; Oskolkov 2021, Table 6: 1.0 at half height
    tau_s: float
    volt_per_k: float
    adc_volt: float


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """[simulator axis NAME]; None: as in the stepper's own section."""

    name: str
    section: str
    step_pin: str | None
    dir_pin: str | None
    endstop_pin: str | None
    mm_per_step: float | None
    position_min_mm: float | None
    position_max_mm: float | None
    endstop_mm: float | None
    start_mm: float | None
    both_edges: bool


@dataclass(frozen=True, slots=True)
class FanSettings:
    """[simulator fan NAME]; pin None: as in the fan's own section."""

    name: str
    section: str
    pin: str | None
    spin_up_s: float


# Fields of the world's struct world_bed: options in mm, tilts in mm a mm
BED_OPTIONS = {
    "bed_height": "height_mm",
    "tilt_x": "tilt_x",
    "tilt_y": "tilt_y",
    "bump_height": "bump_mm",
    "bump_x": "bump_x_mm",
    "bump_y": "bump_y_mm",
    "bump_radius": "bump_radius_mm",
}


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """[simulator probe NAME]; None: as in [probe] or [bltouch]; z_positions as in [z_tilt] or [quad_gantry_level]."""

    name: str
    pin: str | None
    control_pin: str | None
    offset_mm: tuple[float | None, float | None, float | None]
    noise_mm: float
    stuck: bool
    z_positions: tuple[tuple[float, float], ...] | None
    bed: Mapping[str, float]


# Option of a gauge: field of struct world_gauge_options, default
GAUGE_OPTIONS = {
    "rate_error": ("rate_error", 0.005), "noise": ("noise", 0.5), "counts_per_gram": ("counts_per_g", 500.0),
    "stiffness": ("stiffness_g_mm", 1000.0), "tare": ("tare_g", 120.0), "drift": ("drift_g_s", 0.0),
    "free_frequency": ("free_hz", 3.0e6), "coupling": ("coupling", 0.2), "decay": ("decay_mm", 2.5),
    "coil_height": ("coil_mm", 2.0), "coil_temp": ("coil_c", 25.0), "coil_ramp": ("coil_c_per_s", 0.0),
    "coil_end_temp": ("coil_end_c", 25.0), "drift_per_k": ("drift_per_k", -4e-5),
    "drift_per_k2": ("drift_per_k2", 8e-8), "drift_per_k3": ("drift_per_k3", 2e-10),
    "drift_near_per_k": ("drift_near_per_k", 3e-5),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class GaugeSettings:
    """[simulator gauge SECTION]: what the load cell or the coil of that section feels."""

    name: str
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """[simulator frame]: natural frequency and damping ratio of X and Y, natural frequency of the motors' rotors."""

    frequency_hz: tuple[float, float]
    damping_ratio: tuple[float, float]
    motor_hz: float


@dataclass(frozen=True, slots=True)
class PanelSettings:
    """[simulator panel SECTION]"""

    name: str


@dataclass(frozen=True, slots=True)
class MountSettings:
    """[simulator mount NOZZLE]: the vibration that its melt drives; `values`: fields of struct world_mount."""

    nozzle: str
    axis: int
    values: Mapping[str, float]


ACCELEROMETER_FAULTS = ("none", "unplugged", "frozen", "saturated")


@dataclass(frozen=True, slots=True)
class AccelerometerSettings:
    """[simulator accelerometer SECTION]; orientation None: as the host's axes_map assumes; noise None: typical."""

    name: str
    orientation: tuple[int, int, int] | None
    noise_ug: float | None
    rate_error: float
    fault: str


def _read_frame(config: ConfigWrapper, name: str) -> FrameSettings:
    def of_axes(option: str, default: float, high: float) -> tuple[float, float]:
        x, y = (config.getfloat(f"{option}_{a}", default, minval=0.0, maxval=high) for a in "xy")
        return x, y

    return FrameSettings(
        frequency_hz=of_axes("frequency", 50.0, 200.0),
        damping_ratio=of_axes("damping", 0.05, 0.9),
        motor_hz=config.getfloat("motor_frequency", 300.0, minval=50.0, maxval=2000.0),
    )


def _read_mount(config: ConfigWrapper, name: str) -> MountSettings:
    def number(option: str, default: float, low: float, high: float) -> float:
        return config.getfloat(option, default, minval=low, maxval=high)

    return MountSettings(
        nozzle=name,
        axis="xyz".index(config.getchoice("axis", {axis: axis for axis in "xyz"}, "z")),
        values={
            "frequency_hz": number("frequency", 200.0, 1.0, 1000.0),
            "quality": number("quality", 20.0, 1.0, 200.0),
            "amplitude_m_s2": number("amplitude", 0.6, 0.0, 100.0),
            "exponent": number("exponent", 3.86, 0.5, 10.0),
            "flow_exponent": number("flow_exponent", 1.0, 0.1, 3.0),
            "motion_share": number("motion_share", 0.03, 0.0, 1.0),
        },
    )


def _read_accelerometer(config: ConfigWrapper, name: str) -> AccelerometerSettings:
    turned = config.get("orientation", None)
    return AccelerometerSettings(
        name=name,
        orientation=None if turned is None else read_axes_map(config, "orientation"),
        noise_ug=config.getfloat("noise", None, minval=0.0, maxval=1e5),
        rate_error=config.getfloat("rate_error", 0.01, minval=-0.2, maxval=0.2),
        fault=config.getchoice("fault", {name: name for name in ACCELEROMETER_FAULTS}, "none"),
    )


def _read_probe(config: ConfigWrapper, name: str) -> ProbeSettings:
    offsets = [config.getfloat(option, None) for option in ("x_offset", "y_offset", "trigger_height")]
    positions = config.getlists("z_positions", None, seps=(",", "\n"), parser=float, count=2)
    return ProbeSettings(
        name=name,
        pin=config.get("pin", None),
        control_pin=config.get("control_pin", None),
        offset_mm=(offsets[0], offsets[1], offsets[2]),
        noise_mm=config.getfloat("noise", 0.0, minval=0.0, maxval=1.0),
        stuck=config.getboolean("stuck", False),
        z_positions=positions,
        bed={field: config.getfloat(option, 0.0) for option, field in BED_OPTIONS.items()},
    )


def _read_mcu(config: ConfigWrapper, name: str) -> McuSettings:
    def chance(option: str) -> float:
        return float(config.getfloat(option, 0.0, minval=0.0, maxval=0.5))

    return McuSettings(
        name=name or "mcu",
        clock_ppm=config.getfloat("clock_ppm", 0.0, minval=-5000.0, maxval=5000.0),
        baud=config.getfloat("baud", LINE_BAUD, minval=0.0),
        latency_s=config.getfloat("latency", LINE_LATENCY_S, minval=0.0, maxval=0.1),
        jitter_s=config.getfloat("jitter", 0.0, minval=0.0, maxval=0.1),
        corrupt=chance("corrupt"),
        drop=chance("drop"),
        duplicate=chance("duplicate"),
        build=config.getchoice("build", {name: name for name in MCU_BUILDS}, "simulator"),
        chip_temp_c=config.getfloat("chip_temperature", CHIP_TEMP_C, minval=-40.0, maxval=150.0),
    )


def _read_feed(config: ConfigWrapper, default_axis: str | None) -> FeedSettings:
    return FeedSettings(
        axis=config.get("filament_axis", default_axis) or None,
        filament_diameter_mm=config.getfloat("filament_diameter", FILAMENT_DIAMETER_MM, above=0.0),
    )


def _read_profile(config: ConfigWrapper, name: str, low: float, high: float) -> Profile:
    """A parameter as 'TIME:VALUE, TIME:VALUE, ...'; a plain number is the value from 0 on."""
    text = str(config.get(name))
    if ":" not in text:
        return ((0.0, float(config.getfloat(name, minval=low, maxval=high))),)
    where = f"Option '{name}' in section '{config.get_name()}' ({config.where(name)})"
    try:
        points = [tuple(float(number) for number in pair.split(":")) for pair in text.split(",")]
        profile = tuple((time_s, value) for time_s, value in points)
    except ValueError:
        raise config.error(
            f"{where}: '{text}' is no profile; it has the form TIME:VALUE, TIME:VALUE, such as 0:1.0, 600:1.02."
        ) from None
    times = [time_s for time_s, _ in profile]
    if times[0] < 0.0 or any(after <= before for before, after in itertools.pairwise(times)):
        raise config.error(f"{where}: the times of '{text}' must rise from 0 or later.")
    for _, value in profile:
        if not low <= value <= high:
            raise config.error(f"{where}: {value:g} must be from {low:g} to {high:g}.")
    return profile


def _read_parameters(config: ConfigWrapper, table_name: str, own: set[str]) -> dict[str, Profile]:
    """Every option that is not one of `own` is a plant parameter."""
    tables: ParameterTables | None = config.get_printer().get_start_args().get("simulator_parameters")
    names = [name for name in config.get_prefix_options("") if name not in own]
    if tables is None:
        return {name: _read_profile(config, name, -math.inf, math.inf) for name in names}
    table = tables[table_name]
    values = {}
    for name in names:
        row = table.get(name)
        if row is None:
            near = difflib.get_close_matches(name, [*table, *own], n=3)
            hint = f" Did you mean {' or '.join(near)}?" if near else ""
            raise config.error(
                f"Option '{name}' in section '{config.get_name()}' is not a parameter of the simulated "
                f"{table_name} ({config.where(name)}).{hint}"
            )
        values[name] = _read_profile(config, name, row.min, row.max)
    return values


def _read_nozzle(config: ConfigWrapper, name: str) -> NozzleSettings:
    own = {"mcu", "preset", "filament_axis", "filament_diameter", "fan", "vdc_pin", "vdc_scale"}
    own |= {"enable_pin", "supply_delay", "supply_watchdog"}
    parameters = _read_parameters(config, "nozzle", own)
    return NozzleSettings(
        name=name,
        mcu=config.get("mcu", "mcu"),
        preset=config.getchoice("preset", {name: name for name in NOZZLE_PRESETS}, "reference"),
        feed=_read_feed(config, "extruder"),
        fan=config.get("fan", None),
        parameters={option: profile[0][1] for option, profile in parameters.items()},
        profiles={option: profile for option, profile in parameters.items() if len(profile) > 1},
        vdc_pin=config.get("vdc_pin", None),
        vdc_scale_v=config.getfloat("vdc_scale", None, above=0.0),
        enable_pin=config.get("enable_pin", None),
        supply_delay_s=config.getfloat("supply_delay", SUPPLY_DELAY_S, minval=0.0, maxval=1.0),
        supply_watchdog_s=config.getfloat("supply_watchdog", 0.0, minval=0.0, maxval=1.0),
    )


def _read_load(config: ConfigWrapper, name: str) -> LoadSettings:
    own = {"kind", "section", "heater_pin", "sensor_pin", "filament_axis", "filament_diameter", "fan"}
    is_bed = name in ("bed", "heater_bed")
    parameters = _read_parameters(config, "load", own)
    if moving := next((option for option, profile in parameters.items() if len(profile) > 1), None):
        raise config.error(
            f"Option '{moving}' in section '{config.get_name()}' ({config.where(moving)}): only parameters of a "
            "nozzle may be profiles."
        )
    kind = config.getchoice("kind", {"bed": "bed", "hotend": "hotend"}, "bed" if is_bed else "hotend")
    return LoadSettings(
        name=name,
        kind=kind,
        section=config.get("section", "heater_bed" if is_bed else name),
        heater_pin=config.get("heater_pin", None),
        sensor_pin=config.get("sensor_pin", None),
        feed=_read_feed(config, None if kind == "bed" else "extruder"),
        fan=config.get("fan", None),
        parameters={option: profile[0][1] for option, profile in parameters.items()},
    )


def _read_reference(config: ConfigWrapper, name: str) -> ReferenceSettings:
    return ReferenceSettings(
        name=name,
        section=config.get("section", f"temperature_sensor {name}"),
        sensor_pin=config.get("sensor_pin", None),
        nozzle=config.get("nozzle"),
        gain=config.getfloat("gain", 1.0, minval=0.5, maxval=1.5),
        tau_s=config.getfloat("tau", 0.6, minval=0.001, maxval=60.0),
        volt_per_k=config.getfloat("volt_per_k", 0.005, above=0.0),
        adc_volt=config.getfloat("adc_voltage", 5.0, above=0.0),
    )


def _read_axis(config: ConfigWrapper, name: str) -> AxisSettings:
    def number(option: str) -> float | None:
        value = config.getfloat(option, None)
        return None if value is None else float(value)

    edges = config.getchoice("step_edges", {"one": "one", "both": "both"}, "one")
    return AxisSettings(
        name=name,
        section=config.get("section", f"stepper_{name}" if _LETTER_AXIS.fullmatch(name) else name),
        step_pin=config.get("step_pin", None),
        dir_pin=config.get("dir_pin", None),
        endstop_pin=config.get("endstop_pin", None),
        mm_per_step=config.getfloat("mm_per_step", None, above=0.0),
        position_min_mm=number("position_min"),
        position_max_mm=number("position_max"),
        endstop_mm=number("endstop_position"),
        start_mm=number("start_position"),
        both_edges=edges == "both",
    )


def _read_fan(config: ConfigWrapper, name: str) -> FanSettings:
    return FanSettings(
        name=name,
        section=config.get("section", name),
        pin=config.get("pin", None),
        spin_up_s=config.getfloat("spin_up_time", FAN_SPIN_UP_S, minval=0.0),
    )


_READERS: dict[str, Callable[[Any, str], Any]] = {
    "mcu": _read_mcu,
    "nozzle": _read_nozzle,
    "load": _read_load,
    "reference": _read_reference,
    "axis": _read_axis,
    "fan": _read_fan,
    "probe": _read_probe,
    "gauge": lambda config, name: GaugeSettings(
        name, {field: config.getfloat(option, default) for option, (field, default) in GAUGE_OPTIONS.items()}
    ),
    "frame": _read_frame,
    "mount": _read_mount,
    "accelerometer": _read_accelerometer,
    "panel": lambda config, name: PanelSettings(name),
}


class SimulatorSection:
    """The printer object of one such section: holds the options read, for a simulation."""

    def __init__(self, settings: Any) -> None:
        self.settings = settings


class LiveFaults:
    """SIMULATOR_FAULT FAULT=NAME [ARG=...], where machine and host are one process."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "SIMULATOR_FAULT", self.cmd_SIMULATOR_FAULT, desc="A fault of the simulated machine"
        )

    def cmd_SIMULATOR_FAULT(self, gcmd: Any) -> None:
        inject = self.printer.get_start_args().get("inject_fault")
        if inject is None:
            raise gcmd.error(
                "SIMULATOR_FAULT: the machine is not in this process; start both with scripts/run_printer.py without"
                " --separate."
            )
        name, argument = gcmd.get("FAULT"), gcmd.get("ARG", "")
        problem = inject(f"{name}:{argument}" if argument else name)
        if problem:
            raise gcmd.error(f"SIMULATOR_FAULT: {problem}")
        gcmd.respond_info(f"Fault injected: {name} {argument}".rstrip())


class LivePanel:
    """SIMULATOR_PANEL [PANEL=SECTION] [TURN=n] [PRESS=key] [PICTURE=file], where machine and host are one process."""

    def __init__(self, printer: Any, name: str) -> None:
        self.printer, self.name = printer, name
        self._panels = printer.get_start_args().get("panels")
        if self._panels is not None:
            self._reactor = printer.get_reactor()
            self._reactor.register_timer(self._read, self._reactor.NOW)

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for value in (self.name, None) if self.name == "display" else (self.name,):
            gcode.register_mux_command(
                "SIMULATOR_PANEL",
                "PANEL",
                value,
                self.cmd_SIMULATOR_PANEL,
                desc="Knob, buttons and picture of a simulated display",
            )

    def _read(self, eventtime: float) -> float:
        """What the display is sent is kept for some seconds only."""
        if self.name in (panels := self._panels()):
            panels[self.name].read()
        return eventtime + PANEL_READ_S

    def cmd_SIMULATOR_PANEL(self, gcmd: Any) -> None:
        if self._panels is None:
            raise gcmd.error(
                "SIMULATOR_PANEL: the machine is not in this process; start both with scripts/run_printer.py without"
                " --separate."
            )
        panel = self._panels()[self.name]
        detents, key, path = gcmd.get_int("TURN", 0), gcmd.get("PRESS", None), gcmd.get("PICTURE", None)
        try:
            for wait_s in itertools.chain(
                panel.turn(detents) if detents else (), panel.press(key) if key else ()
            ):
                self._reactor.pause(self._reactor.monotonic() + wait_s)
            if path is not None:
                panel.save_picture(path)
                gcmd.respond_info(f"Picture of '{self.name}': {path}")
        except (ValueError, OSError) as e:
            raise gcmd.error(f"SIMULATOR_PANEL: {e}") from None


def read_settings(config: ConfigWrapper) -> SimulatorSettings:
    """Options of [simulator]."""
    return SimulatorSettings(
        config.getfloat("trace_rate", TRACE_RATE_HZ, above=0.0, maxval=1000.0),
        config.getfloat("host_late", 0.0, minval=0.0, maxval=10.0),
        tuple(config.get("fault", "").split()),
        config.getboolean("start_again", False),
    )


def load_config(config: ConfigWrapper) -> SimulatorSection:
    """[simulator]"""
    LiveFaults(config.get_printer()).register()
    return SimulatorSection(read_settings(config))


def load_config_prefix(config: ConfigWrapper) -> SimulatorSection:
    """[simulator KIND NAME]"""
    kind, _, name = config.get_name().partition(" ")[2].partition(" ")
    reader = _READERS.get(kind)
    if reader is None:
        raise config.error(
            f"Section '{config.get_name()}': '{kind}' is nothing a simulated machine has; it has "
            f"{', '.join(_READERS)}."
        )
    if not name.strip() and kind not in ("mcu", "probe", "frame"):
        raise config.error(f"Section '{config.get_name()}' needs a name: [simulator {kind} NAME].")
    if kind == "panel":
        LivePanel(config.get_printer(), name.strip()).register()
    return SimulatorSection(reader(config, name.strip()))
