"""`control:` of an ordinary heater: options in, a control law with its memory out.

The laws themselves are thermal/'s, behind one `step`; here they get their options' names and the answer to "is it
there yet?". Output is PWM duty 0..max_power. A tuning is the options that belong to a law, by name: what a profile
keeps (heater_profile.py) and what SAVE_CONFIG writes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from thermal.control import control_api, pid, predictive, two_period
from thermal.models.heater_model import ModelParameters
from thermal.records import ParameterError

PID_BUSY_C = 1.0  # M109 returns when this near to the target ...
PID_BUSY_SLOPE_C_S = 0.1  # ... and changing slower than this
TWO_PERIOD_BUSY_C = 5.0  # its cycle does not come nearer

MAX_DELTA_MAX_C = 50.0  # with more a watermark heater counts as arrived before it has begun

# What a model controller of an ordinary heater wants: a small deviation is run down within seconds.
MODEL_TAU_LAGS = 2.0  # of all the lags
MODEL_TAU_MIN_S = 1.0
MODEL_SIGMA_C = 0.1
MODEL_GAP_S = 10.0
MODEL_GAIN_START = 0.05  # the calibration knows the drive about so well
MODEL_DISTURBANCE_SHARE = 0.01  # of full power, in a second
MODEL_DELAY_S = 0.6  # reading to PWM: heaters.PWM_DELAY_S and one report

OPTIONS: dict[str, tuple[str, ...]] = {
    "pid": ("pid_kp", "pid_ki", "pid_kd"),
    "watermark": ("max_delta",),
    "two_period": ("two_period_turn", "two_period_cutoff"),
    "mcu_onoff": (),
    "model": (
        "heater_power_w",
        "model_heat_j_per_k",
        "model_loss_w_per_k",
        "model_element_j_per_k",
        "model_element_w_per_k",
        "model_sensor_lag",
        "model_fan_w_per_k",
        "model_melt_w_per_k",
        "model_ambient_temp",
    ),
}


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What takes heat now: flow in mm^3/s, part fan 0..1."""

    flow_mm3_s: float = 0.0
    fan: float = 0.0


class HeaterLaw:
    """One heater's control law with its memory; duty is PWM 0..1."""

    def __init__(self, law: control_api.Law[Any, Any], parameters: Any, options: dict[str, str]) -> None:
        self.law = law
        self.parameters = parameters
        self.options = options
        self.state: Any = law.start
        self.surroundings: Callable[[], Surroundings] = Surroundings

    @property
    def name(self) -> str:
        return self.law.name

    def _inputs(self, temp_c: float, target_c: float) -> control_api.ControlInput:
        around = self.surroundings()
        return control_api.ControlInput(
            target_c,
            temp_c,
            flow_mm3_s=control_api.Schedule.constant(around.flow_mm3_s),
            fan=control_api.Schedule.constant(around.fan),
        )

    def decide(self, time_s: float, temp_c: float, target_c: float) -> float:
        """Duty from a reading; the law goes on observing with the heater off."""
        if target_c <= 0.0:
            self.state = self._resting()
        output, self.state = self.law.step(
            self.parameters, self.state, self._inputs(temp_c, target_c), time_s
        )
        return output.value if target_c > 0.0 else 0.0

    def _resting(self) -> Any:
        """Memory to keep while the heater is off."""
        return self.law.start

    def take_over(self, before: HeaterLaw, temp_c: float, target_c: float, duty: float) -> None:
        """Go on where another law left off, at its duty."""
        if target_c > 0.0:
            self.state = self.law.follow(self.parameters, self.state, self._inputs(temp_c, target_c), duty)

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        """Still on the way to the target?"""
        return abs(target_c - smoothed_c) > PID_BUSY_C


class PidLaw(HeaterLaw):
    """PID with Klipper's documented gains: duty = (Kp e + Ki integral - Kd slope) / 255."""

    def _resting(self) -> pid.PidState:
        state: pid.PidState = self.state
        return pid.PidState(state.time_s, state.measured_c, state.slope_c_s, 0.0)

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        slope = abs(self.state.slope_c_s)
        return abs(target_c - smoothed_c) > PID_BUSY_C or slope > PID_BUSY_SLOPE_C_S

    def take_over(self, before: HeaterLaw, temp_c: float, target_c: float, duty: float) -> None:
        if isinstance(before, PidLaw):
            self.state = before.state  # the slope is known already
        super().take_over(before, temp_c, target_c, duty)


class WatermarkLaw(HeaterLaw):
    """On-off control around the target."""

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        return smoothed_c < target_c - float(self.parameters.max_delta_c)


class TwoPeriodLaw(HeaterLaw):
    """Liu 2019's table."""

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        return abs(target_c - smoothed_c) > TWO_PERIOD_BUSY_C


class PredictiveLaw(HeaterLaw):
    """Kalman filter and prediction; knows temperatures with the heater off as well."""

    def _resting(self) -> Any:
        return self.state

    def take_over(self, before: HeaterLaw, temp_c: float, target_c: float, duty: float) -> None:
        if isinstance(before, PredictiveLaw):
            self.state = before.state
        super().take_over(before, temp_c, target_c, duty)

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        return abs(target_c - smoothed_c) > PID_BUSY_C


def _read_pid(config: ConfigWrapper, max_power: float, smooth_s: float) -> tuple[Any, Any]:
    pid_kp = config.getfloat("pid_Kp", above=0.0)
    pid_ki, pid_kd = (config.getfloat(option, minval=0.0) for option in ("pid_Ki", "pid_Kd"))
    return pid.PID, pid.klipper_pid(pid_kp, pid_ki, pid_kd, max_power, smooth_s)


def _read_watermark(config: ConfigWrapper, max_power: float, smooth_s: float) -> tuple[Any, Any]:
    max_delta_c = config.getfloat("max_delta", 2.0, above=0.0, maxval=MAX_DELTA_MAX_C)
    return pid.WATERMARK, pid.WatermarkParameters(max_delta_c, max_power)


def read_two_period(config: ConfigWrapper, output_high: float) -> two_period.TwoPeriodParameters:
    """The options of `control: two_period`; `output_high` is full drive in the heater's unit (duty or watts)."""
    return two_period.TwoPeriodParameters(
        output_high,
        config.getfloat("two_period_turn", 0.3, above=0.0, maxval=5.0),
        config.getfloat("two_period_cutoff", 15.0, above=0.0, maxval=50.0),
    )


def _read_two_period(config: ConfigWrapper, max_power: float, smooth_s: float) -> tuple[Any, Any]:
    return two_period.TWO_PERIOD, read_two_period(config, max_power)


def model_parameters(values: dict[str, float], max_power: float) -> ModelParameters:
    """Model of an ordinary heater from the values of its options. Raises ParameterError."""
    power_w, heat_j_k = values["heater_power_w"], values["model_heat_j_per_k"]
    element_j_k, element_w_k = values["model_element_j_per_k"], values["model_element_w_per_k"]
    sensor_s = values["model_sensor_lag"]
    lags_s = sensor_s + (element_j_k / element_w_k if element_w_k > 0.0 else 0.0)
    return ModelParameters(
        heat_j_k=heat_j_k,
        loss_w_k=values["model_loss_w_per_k"],
        output_w=power_w,
        output_high=max_power,
        ambient_c=values["model_ambient_temp"],
        element_j_k=element_j_k,
        element_w_k=element_w_k,
        sensor_s=sensor_s,
        fan_w_k=values["model_fan_w_per_k"],
        melt_ua_w_k=values["model_melt_w_per_k"],
        hold_s=0.3,
        horizon_s=max(1.0, 1.5 * lags_s),
        tau_s=max(MODEL_TAU_MIN_S, MODEL_TAU_LAGS * lags_s),
        delay_s=MODEL_DELAY_S,
        sigma_c=MODEL_SIGMA_C,
        disturbance_w=MODEL_DISTURBANCE_SHARE * power_w,
        disturbance_start_w=0.05 * power_w,
        disturbance_max_w=0.6 * power_w,
        gain_start=MODEL_GAIN_START,
        gain_walk=0.0005,
        gap_s=MODEL_GAP_S,
    )


def _read_model(config: ConfigWrapper, max_power: float, smooth_s: float) -> tuple[Any, Any]:
    values = {
        "heater_power_w": config.getfloat("heater_power_w", above=0.0),
        "model_heat_j_per_k": config.getfloat("model_heat_j_per_k", above=0.0),
        "model_loss_w_per_k": config.getfloat("model_loss_w_per_k", above=0.0),
        "model_element_j_per_k": config.getfloat("model_element_j_per_k", 0.0, minval=0.0),
        "model_element_w_per_k": config.getfloat("model_element_w_per_k", 0.0, minval=0.0),
        "model_sensor_lag": config.getfloat("model_sensor_lag", 0.0, minval=0.0, maxval=60.0),
        "model_fan_w_per_k": config.getfloat("model_fan_w_per_k", 0.0, minval=0.0),
        "model_melt_w_per_k": config.getfloat("model_melt_w_per_k", 0.0, minval=0.0),
        "model_ambient_temp": config.getfloat("model_ambient_temp", 25.0, minval=-50.0, maxval=100.0),
    }
    _both(config, values, "model_element_j_per_k", "model_element_w_per_k")
    return predictive.MODEL, model_parameters(values, max_power)


def _both(config: ConfigWrapper, values: dict[str, float], *options: str) -> None:
    """Options of which one says nothing without the other."""
    given = [option for option in options if values[option]]
    if len(given) == 1:
        (other,) = set(options) - set(given)
        raise config.error(
            f"Option '{given[0]}' in section '{config.get_name()}' needs '{other}', above 0, too; without a heating"
            f" element of its own leave both out ({config.where(given[0])})."
        )


def _read_mcu_onoff(config: ConfigWrapper, max_power: float, smooth_s: float) -> tuple[Any, Any]:
    """What the MCU does by itself, in words of the watermark law: for status and M190 only."""
    onoff = control_api.Law("mcu_onoff", pid.watermark_step, pid.WatermarkState(), pid.WATERMARK.follow)
    return onoff, pid.WatermarkParameters(2.0, max_power)


Reader = Callable[[Any, float, float], tuple[Any, Any]]
LAWS: dict[str, tuple[Reader, type[HeaterLaw]]] = {
    "pid": (_read_pid, PidLaw),
    "watermark": (_read_watermark, WatermarkLaw),
    "two_period": (_read_two_period, TwoPeriodLaw),
    "model": (_read_model, PredictiveLaw),
    "mcu_onoff": (_read_mcu_onoff, WatermarkLaw),
}


def read_law(config: ConfigWrapper, max_power: float, smooth_time_s: float) -> HeaterLaw:
    """The law of `control:` with its options; raises the config's error, in plain words, on impossible ones."""
    name = config.getchoice("control", {name: name for name in LAWS})
    reader, kind = LAWS[name]
    try:
        law, parameters = reader(config, max_power, smooth_time_s)
    except ParameterError as e:
        written = [option for option in OPTIONS[name] if config.get(option, None) is not None]
        lines = "; ".join(f"{option}: {config.where(option)}" for option in written)
        raise config.error(f"Section '{config.get_name()}': {e} ({lines}).") from None
    options = {"control": name}
    for option in OPTIONS[name]:
        text = config.get(option, None, note_valid=False)
        if text is not None:
            options[option] = text
    _let_be(config, name)
    return kind(law, parameters, options)


def _let_be(config: ConfigWrapper, own: str) -> None:
    """Options of the other laws are no mistake: changing `control` is no reason to delete a tuning."""
    for law, options in OPTIONS.items():
        for option in options if law != own else ():
            config.get(option, None)
