"""The parts of a probe that plugins with a probe of their own put together.

parameters ─► session (samples, tolerance) ─► touch: HomingViaProbeHelper, or the plugin's own
commands   ─► session
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper

from .commands import ProbeCommands
from .sampling import RESULTS, Sampling, check_homed, take_samples
from .switch import ProbeEvents


def _one_of(kind: type, helpers: tuple[Any, ...]) -> Any:
    """The helper of that kind among those handed over: their number has grown with time."""
    return next((helper for helper in helpers if isinstance(helper, kind)), None)


class ProbeOffsetsHelper:
    """Place of the probe against the nozzle, and height of the nozzle at the trigger; mm."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._offsets = (
            config.getfloat("x_offset", 0.0), config.getfloat("y_offset", 0.0), config.getfloat("z_offset"),
        )  # fmt: skip

    def get_offsets(self, gcmd: Any = None) -> tuple[float, float, float]:
        return self._offsets


class ProbeParameterHelper:
    """Speeds and samples: of the config, changed by a command."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._sampling = Sampling.read(config)

    def sampling(self, gcmd: Any = None) -> Sampling:
        return self._sampling.changed_by(gcmd)

    def get_probe_params(self, gcmd: Any = None) -> dict[str, Any]:
        return self.sampling(gcmd).as_params()


class HomingViaProbeHelper:
    """Sessions of single touches by homing moves; also makes the probe an endstop, `probe:z_virtual_endstop`."""

    def __init__(self, config: ConfigWrapper, mcu_probe: Any, *helpers: Any) -> None:
        self.printer = config.get_printer()
        self.mcu_probe = mcu_probe
        self._parameters = _one_of(ProbeParameterHelper, helpers) or ProbeParameterHelper(config)
        self._results: list[list[float]] = []
        ProbeEvents(self.printer, mcu_probe)
        self.printer.lookup_object("pins").register_chip("probe", self)
        self.printer.register_event_handler("klippy:mcu_identify", self._attach_steppers)

    def _attach_steppers(self) -> None:
        for motor in self.printer.lookup_object("toolhead").get_kinematics().get_steppers():
            if motor.is_active_axis("z"):
                self.mcu_probe.add_stepper(motor)

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for `probe:z_virtual_endstop`."""
        return check_virtual_endstop(self.printer, pin_type, pin_params, self.mcu_probe)

    def start_probe_session(self, gcmd: Any) -> HomingViaProbeHelper:
        self.mcu_probe.multi_probe_begin()
        self._results = []
        return self

    def run_probe(self, gcmd: Any) -> None:
        """One touch."""
        target = self.printer.lookup_object("toolhead").get_position()
        target[2] = check_homed(self.printer)["axis_minimum"][2]
        speed = self._parameters.get_probe_params(gcmd)["probe_speed"]
        homing = self.printer.lookup_object("homing")
        self._results.append(list(homing.probing_move(self.mcu_probe, target, speed))[:3])

    def pull_probed_results(self) -> list[list[float]]:
        results, self._results = self._results, []
        return results

    def end_probe_session(self) -> None:
        self._results = []
        self.mcu_probe.multi_probe_end()


class ProbeSessionHelper:
    """Sessions in which each point is sampled as the parameters say."""

    def __init__(self, config: ConfigWrapper, *helpers: Any) -> None:
        self.printer = config.get_printer()
        self._parameters = _one_of(ProbeParameterHelper, helpers) or ProbeParameterHelper(config)
        self._start = next((helper for helper in helpers if callable(helper)), None) or (
            HomingViaProbeHelper(config, helpers[0], self._parameters).start_probe_session
        )
        self._session: Any = None
        self._results: list[list[float]] = []
        self.printer.register_event_handler("gcode:command_error", self._on_error)

    def _on_error(self) -> None:
        """A command has failed."""
        if self._session is not None:
            self.end_probe_session()

    def get_probe_params(self, gcmd: Any = None) -> dict[str, Any]:
        return dict(self._parameters.get_probe_params(gcmd))

    def start_probe_session(self, gcmd: Any) -> ProbeSessionHelper:
        if self._session is not None:
            raise self.printer.command_error("A probing session is under way already")
        self._session = self._start(gcmd)
        self._results = []
        return self

    def run_probe(self, gcmd: Any) -> None:
        """Probe here."""
        session = self._session
        if session is None:
            raise self.printer.command_error("No probing session is under way")

        def touch(speed: float) -> list[float]:
            session.run_probe(gcmd)
            x, y, z = session.pull_probed_results()[-1][:3]
            gcmd.respond_info(f"probe at {x:.3f},{y:.3f} is z={z:.6f}")
            return [x, y, z]

        sampling = self._parameters.sampling(gcmd)
        self._results.append(sampling.combine(take_samples(self.printer, gcmd, sampling, touch)))

    def pull_probed_results(self) -> list[list[float]]:
        results, self._results = self._results, []
        return results

    def end_probe_session(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.end_probe_session()


class ProbeCommandHelper(ProbeCommands):
    """The commands of a plugin's probe."""

    def __init__(
        self,
        config: ConfigWrapper,
        probe: Any,
        query_endstop: Callable[[float], int] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(config.get_printer(), config.get_name(), probe, query_endstop)
        self.register()


def check_virtual_endstop(printer: Any, pin_type: str, pin_params: dict[str, Any], mcu_probe: Any) -> Any:
    """The probe as the endstop `probe:z_virtual_endstop`."""
    pins = printer.lookup_object("pins")
    if pin_type != "endstop" or pin_params["pin"] != "z_virtual_endstop":
        raise pins.error("Probe virtual endstop only useful as endstop pin: probe:z_virtual_endstop")
    if pin_params["invert"] or pin_params["pullup"]:
        raise pins.error("Can not pullup/invert probe virtual endstop; do so with the probe's own pin")
    return mcu_probe


def calc_probe_z_average(positions: list[list[float]], method: str = "average") -> list[float]:
    """One place of several samples."""
    return [RESULTS[method]([place[axis] for place in positions]) for axis in range(3)]
