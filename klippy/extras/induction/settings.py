"""The options of [induction_heater NAME] as the plain values of the thermal chain; nothing in here acts."""

from __future__ import annotations

import math
from dataclasses import fields, replace

from configfile import ConfigWrapper
from thermal.control import actuator, loop, nozzle_model, predictive, two_period
from thermal.control import pid as pid_control
from thermal.drift import observer as drift_observer
from thermal.identification.sweep import LOW_PHASES_TICKS
from thermal.models import heat_loss, melt_exchange
from thermal.models.drive_law import DriveLaw
from thermal.records import PHASE_MAX_TICKS, ParameterError
from thermal.sensing import (
    block_temperature,
    features,
    guard_limits,
    heat_balance_monitor,
    laws,
    supervision,
    temperature_filter,
)

from ..heater import laws as heater_laws
from .mcu import TestSettings, UnitSettings

LOOK_SAMPLES, LONG_LOOK_SAMPLES = 16, 64
HOLD_LOOK_S = 1.0  # a strong look out of a hold: 21 mJ ...
HOLD_LOOK_K = 0.05  # ... which warms the reference nozzle by so much ...
HOLD_LOOK_MIN_TICKS = 28000  # ... and a weaker one shows nothing
WORKING_C = 220.0  # where a law's error at strong drive is judged
SETTLE_MARGIN_SAMPLES = 4  # a sensing pulse lasts this much longer than settling plus one block
# 20 % of the square of the phase, half of full power: no nozzle is held with that.
CEILING_PHASE_TICKS = 20125
TEST_INTERVAL_MIN_S = 0.005
GUARD_LOW_C = -150.0  # a tank detuned by 0.2 % of C1 reads -90 at full drive; an open coil reads far below
ADC_MAX_12_BIT = 4095
UNCALIBRATED = "uncalibrated"

# Defaults for the reference nozzle (0.9 g, 0.45 J/K): found in test/loop, where mass, losses and efficiency
# vary.
DEFAULT_KP_W_PER_K = 5.0
DEFAULT_KI_W_PER_K_S = 10.0
DEFAULT_KD_W_S_PER_K = 0.15
DEFAULT_DERIVATIVE_S = 0.010
DEFAULT_LEAD_S = 0.015
# So far a nozzle warms on once a law that swings has cut the power; supervision leaves as much again.
LATE_C = 5.0
DEFAULT_BLOCK_SAMPLES = 192  # 1.6 ms at 120 kHz
DEFAULT_RECORDS = 3  # a message each 4.8 ms: 7.5 kB/s of a 25 kB/s line
DEFAULT_CONTROL_S = 0.008  # a phase step costs 20 samples of settling: 2 % of the signal

# A calibrated law follows the drive at any power: it may arrive faster, and its steps are no jumps.
CALIBRATED_APPROACH = loop.Approach(power_w=60.0, band_c=45.0, leave_c=80.0, rebase_fraction=math.inf)


def read_law(config: ConfigWrapper) -> tuple[laws.Law, bool]:
    """(sensing law, calibrated); each coefficient is an option with the seeds' value as default.

    The options of all laws are read: changing `estimator` is no reason to delete a calibration.
    """
    names = {name: name for name in (*laws.LAWS, UNCALIBRATED)}
    choice = config.getchoice("estimator", names, "exp")
    found: dict[str, laws.Law] = {}
    for name, kind in laws.LAWS.items():
        default = kind()
        values = {
            f.name: config.getfloat(f"{name}_{f.name}", getattr(default, f.name))
            for f in fields(kind)
            if f.name not in laws.NO_COEFFICIENTS
        }
        found[name] = replace(default, **values)
    law = found["exp" if choice == UNCALIBRATED else choice]
    residual = config.getfloat("law_residual", law.residual_units, minval=0.0)
    table = _read_table(config)
    return laws.law_of(*laws.coefficients_of(law), residual, table), choice != UNCALIBRATED


def _read_table(config: ConfigWrapper) -> laws.LawTable | None:
    rows = config.getlists("tank_table", None, seps=(",", "\n"), parser=float)
    if not rows:
        return None
    try:
        return laws.LawTable.of_rows(rows)
    except ValueError as e:
        raise config.error(
            f"Option 'tank_table' in section '{config.get_name()}' {e} ({config.where('tank_table')})."
        ) from None


def read_unit(config: ConfigWrapper) -> UnitSettings:
    oversample = config.getint("oversample", 4, minval=3, maxval=7)
    longest = 4**oversample
    frequency_hz = config.getfloat("frequency", 120000.0, minval=20000.0, maxval=1000000.0)
    block_samples = config.getint(
        "block_samples",
        DEFAULT_BLOCK_SAMPLES if oversample == 4 else longest,
        minval=longest // 16,
        maxval=longest,
    )
    records = config.getint("records_per_message", DEFAULT_RECORDS, minval=1, maxval=3)
    return UnitSettings(
        config.getint("bridge", 0, minval=0, maxval=255),
        frequency_hz,
        oversample,
        config.getint("settle_samples", 20, minval=0, maxval=1000),
        config.getint("ema_shift", 0, minval=0, maxval=8),
        config.getfloat("max_duration", 0.100, minval=0.030, maxval=5.0),
        config.getint("guard_trip_blocks", 12, minval=1, maxval=255),
        block_samples,
        records,
    )


def read_tests(config: ConfigWrapper, parameters: loop.LoopParameters) -> TestSettings:
    """The board's tests of its signal; all of them are off with an interval of 0.

    Before a calibration it is not known yet whether the smallest phase drives a current (sweep.LOW_PHASES_TICKS).
    """
    interval_s = config.getfloat("signal_test_interval", 0.0084, minval=0.0, maxval=0.1)
    if 0.0 < interval_s < TEST_INTERVAL_MIN_S:
        raise config.error(
            f"Option 'signal_test_interval' in section '{config.get_name()}'"
            f" ({config.where('signal_test_interval')}): {interval_s:g} s leaves no time for the signal itself; 0 (no"
            f" tests) or {TEST_INTERVAL_MIN_S:g} to 0.1."
        )
    gain = config.getfloat("signal_gain", None, above=0.0)
    known = parameters.supervise.calibrated
    phase_ticks = parameters.estimator.phase_low_ticks if known else LOW_PHASES_TICKS[1]
    return TestSettings(interval_s, gain, parameters.front, phase_ticks)


def _timing(config: ConfigWrapper, unit: UnitSettings) -> loop.Timing:
    period_s = 1.0 / unit.frequency_hz
    return loop.Timing(
        period_s * unit.block_samples,
        period_s * unit.settle_samples,
        config.getfloat("command_lead", DEFAULT_LEAD_S, minval=0.001, maxval=0.200),
        unit.max_duration_s,
        control_s=config.getfloat("control_interval", DEFAULT_CONTROL_S, minval=0.0, maxval=0.025),
    )


def look_times_s(unit: UnitSettings) -> tuple[float, float]:
    """(Short, long) look at the sensing phase: settling, and a block cut as short as the MCU sends; 0: too long."""
    smallest = unit.block_samples // 16 + 4
    if smallest > LONG_LOOK_SAMPLES:
        return 0.0, 0.0
    short, long = (unit.settle_samples + max(smallest, n) for n in (LOOK_SAMPLES, LONG_LOOK_SAMPLES))
    return short / unit.frequency_hz, long / unit.frequency_hz


def _drive(
    config: ConfigWrapper, timing: loop.Timing, unit: UnitSettings, heat: heat_loss.HeatCapacity
) -> actuator.ActuatorParameters:
    vdc_v = config.getfloat("vdc", 24.0, above=0.0)
    law = DriveLaw(
        config.getfloat("power_full_w", 81.3, above=0.0),
        config.getfloat("drive_exponent", 1.5, above=0.0),
        vdc_v,
        config.getfloat("vdc_reference", 24.0, above=0.0),
    )
    pulse_s = timing.block_s + timing.settle_s + SETTLE_MARGIN_SAMPLES / unit.frequency_hz
    look_s, long_look_s = look_times_s(unit)
    hold_ticks = round(law.phase_ticks(HOLD_LOOK_K * heat.at_25c_j_k / look_s)) if look_s else 0
    return actuator.ActuatorParameters(
        law,
        pulse_s,
        config.getfloat("sense_interval", 0.100, minval=2.0 * pulse_s, maxval=1.0),
        config.getfloat("idle_interval", 0.500, minval=2.0 * pulse_s, maxval=1.0),
        pulses_max=max(2, math.ceil(timing.control_s / pulse_s) + 1),
        look_s=look_s,
        watch_interval_s=timing.control_s,
        long_look_s=long_look_s,
        phase_low_ticks=config.getint(
            "sensing_phase", LOW_PHASES_TICKS[0], minval=LOW_PHASES_TICKS[0], maxval=LOW_PHASES_TICKS[-1]
        ),
        hold_look_s=HOLD_LOOK_S if hold_ticks > HOLD_LOOK_MIN_TICKS else 0.0,
        hold_look_ticks=(hold_ticks,),
    )


def _pid(config: ConfigWrapper, power_max_w: float) -> pid_control.PidParameters:
    return pid_control.PidParameters(
        config.getfloat("pid_kp_w_per_k", DEFAULT_KP_W_PER_K, above=0.0),
        config.getfloat("pid_ki_w_per_k_s", DEFAULT_KI_W_PER_K_S, minval=0.0),
        config.getfloat("pid_kd_w_s_per_k", DEFAULT_KD_W_S_PER_K, minval=0.0),
        0.0,
        power_max_w,
        config.getfloat("pid_derivative_time", DEFAULT_DERIVATIVE_S, minval=0.0, maxval=1.0),
    )


def _control(
    config: ConfigWrapper,
    drive: DriveLaw,
    heat: heat_loss.HeatCapacity,
    loss: heat_balance_monitor.TwoNodeLoss,
    timing: loop.Timing,
    melt: melt_exchange.MeltExchange,
    law: laws.Law,
) -> loop.Control:
    """The control law by name; the options of all are read, switching is no reason to delete a tuning."""
    choice = config.getchoice(
        "control", {name: name for name in ("model", "pid", "watermark", "two_period")}, "model"
    )
    power_max_w = config.getfloat("max_power_w", drive.power_max_w, above=0.0, maxval=drive.power_max_w)
    pid = _pid(config, power_max_w)
    watermark = pid_control.WatermarkParameters(
        config.getfloat("max_delta", 2.0, above=0.0, maxval=heater_laws.MAX_DELTA_MAX_C), power_max_w
    )
    table = heater_laws.read_two_period(config, power_max_w)
    try:
        held = nozzle_model.nozzle_model(
            heat, loss, power_max_w, timing, melt, calibrated=isinstance(law, laws.TankLaw)
        )
    except ParameterError as e:
        where = config.where("heat_capacity_j_per_k")
        raise config.error(f"Section '{config.get_name()}': {e} (heat_capacity_j_per_k: {where}).") from None
    if choice == "pid":
        return loop.Control(pid_control.PID, pid, power_max_w)
    if choice == "watermark":
        cycle_c, beyond_c = watermark.max_delta_c, watermark.max_delta_c + LATE_C
        return loop.Control(pid_control.WATERMARK, watermark, power_max_w, cycle_c=cycle_c, beyond_c=beyond_c)
    if choice == "two_period":
        cycle_c = heater_laws.TWO_PERIOD_BUSY_C
        beyond_c = table.cutoff_c + LATE_C
        return loop.Control(two_period.TWO_PERIOD, table, power_max_w, cycle_c=cycle_c, beyond_c=beyond_c)
    return loop.Control(predictive.MODEL, held, power_max_w, models=True)


def remodelled(parameters: loop.LoopParameters) -> loop.LoopParameters:
    """The same, the predictive law with the losses of the heat balance: a calibration measures both at once."""
    chosen = parameters.control
    if not chosen.models:
        return parameters
    balance = parameters.heat_balance
    held = nozzle_model.nozzle_model(
        balance.heat,
        balance.loss,
        chosen.power_max_w,
        parameters.timing,
        parameters.melt,
        calibrated=isinstance(parameters.estimator.law, laws.TankLaw),
    )
    return replace(parameters, control=replace(chosen, parameters=held))


def approach_for(law: laws.Law, drive: DriveLaw) -> loop.Approach:
    """How a nozzle with this law may arrive at its target."""
    default = CALIBRATED_APPROACH if isinstance(law, laws.TankLaw) else loop.Approach()
    return replace(default, power_w=min(default.power_w, drive.power_max_w))


def _approach(config: ConfigWrapper, drive: DriveLaw, law: laws.Law) -> loop.Approach:
    default = approach_for(law, drive)
    band_c = config.getfloat("approach_band", default.band_c, minval=10.0, maxval=300.0)
    power_w = config.getfloat("approach_power_w", default.power_w, above=0.0, maxval=drive.power_max_w)
    return loop.Approach(power_w, band_c, band_c + default.leave_c - default.band_c, default.rebase_fraction)


def _loss(config: ConfigWrapper) -> heat_loss.LossLaw:
    default = heat_loss.LossLaw()
    factor = config.getfloat("loss_factor", 1.0, above=0.0, maxval=10.0)
    conductance_w_k = config.getfloat("loss_w_per_k", default.conductance_w_k, minval=0.0)
    radiation_m2 = config.getfloat("loss_radiation_m2", default.radiation_m2, minval=0.0)
    if not conductance_w_k + radiation_m2:
        raise config.error(
            f"Options 'loss_w_per_k' and 'loss_radiation_m2' in section '{config.get_name()}': one of them must be"
            f" above 0, there is no nozzle without losses ({config.where('loss_w_per_k')})."
        )
    return heat_loss.LossLaw(
        factor * conductance_w_k,
        factor * radiation_m2,
        config.getfloat("ambient_temp", default.ambient_c, minval=-50.0, maxval=100.0),
    )


def _melt(config: ConfigWrapper) -> melt_exchange.MeltExchange:
    """What the filament takes; MODEL_CALIBRATE with FLOW measures it."""
    default = melt_exchange.MeltExchange()
    return replace(
        default,
        ua_w_k=config.getfloat("melt_exchange", default.ua_w_k, above=0.0, maxval=1.0),
        heat_mj_m3k=config.getfloat("melt_heat", default.heat_mj_m3k, above=0.1, maxval=20.0),
        inlet_c=config.getfloat("melt_inlet_temp", default.inlet_c, minval=-50.0, maxval=150.0),
        tip_k_w=config.getfloat("melt_tip", default.tip_k_w, minval=0.0, maxval=50.0),
    )


def _heat_balance(
    config: ConfigWrapper, heat: heat_loss.HeatCapacity, loss: heat_loss.LossLaw
) -> heat_balance_monitor.HeatBalanceParameters:
    return heat_balance_monitor.HeatBalanceParameters(
        heat,
        heat_balance_monitor.scaled(
            config.getfloat("loss_factor", 1.0, above=0.0, maxval=10.0),
            loss.ambient_c,
            config.getfloat("second_mass_factor", 1.0, above=0.0, maxval=10.0),
        ),
        config.getfloat("loss_uncertainty", 0.25, above=0.0, maxval=2.0),
        config.getfloat("drift_limit", 8.0, above=0.0, maxval=200.0),
    )


def _drift(
    config: ConfigWrapper, loss: heat_loss.LossLaw, law: laws.Law, drive: actuator.ActuatorParameters
) -> drift_observer.DriftParameters:
    """What may be wrong by how much; a measured supply is known better."""
    default = drift_observer.DriftParameters(room_c=loss.ambient_c, power_max_w=drive.law.power_max_w)
    if isinstance(law, laws.TankLaw):
        # A zero at the room's temperature shows the law's own error there, too, and looks that at strong drive.
        cold_c, strong_c = (
            law.residual_units * law.invert(law.error(temp_c, phase), phase)[1]
            for temp_c, phase in (
                (loss.ambient_c, drive.phase_low_ticks),
                (WORKING_C, PHASE_MAX_TICKS),
            )
        )
        if law.table is not None:
            strong_c = 2.0 * law.table.error_c[-1]
        default = replace(
            default,
            ambient_c=math.hypot(default.ambient_c, cold_c),
            law_c=max(default.law_c, strong_c),
        )
    is_measured = config.get("vdc_pin", None, note_valid=False) is not None
    return replace(default, supply=0.003) if is_measured else default


def read_parameters(config: ConfigWrapper, unit: UnitSettings) -> loop.LoopParameters:
    """All parameters of the chain of one nozzle."""
    law, calibrated = read_law(config)
    front = features.FeatureParameters(
        config.getfloat("adc_zero", 256.0),
        config.getfloat("units_per_lsb", 1.0, above=0.0),
        config.getfloat("noise_lsb", 1.0, minval=0.0),
        ADC_MAX_12_BIT,
        block_samples=unit.block_samples,
    )
    temp_low_c = config.getfloat("min_temp", -10.0, minval=-20.0)
    temp_high_c = config.getfloat("max_temp", above=max(temp_low_c, 0.0), maxval=700.0)
    timing = _timing(config, unit)
    loss = _loss(config)
    heat = heat_loss.HeatCapacity(config.getfloat("heat_capacity_j_per_k", 0.414, above=0.0))
    drive = _drive(config, timing, unit, heat)
    balance = _heat_balance(config, heat, loss)
    melt = _melt(config)
    return loop.LoopParameters(
        front,
        block_temperature.EstimatorParameters(
            law,
            phase_low_ticks=drive.phase_low_ticks,
            supply=drive.law.vdc_v / drive.law.vdc_reference_v,
        ),
        _control(config, drive.law, heat, balance.loss, timing, melt, law),
        loss,
        drive,
        supervision.SuperviseParameters(temp_low_c, temp_high_c, calibrated=calibrated),
        timing,
        _approach(config, drive.law, law),
        temperature_filter.FilterParameters(loss, heat),
        balance,
        melt,
        _drift(config, loss, law, drive),
    )


def guard_rows(config: ConfigWrapper, parameters: loop.LoopParameters) -> list[guard_limits.LimitRow]:
    """The MCU's table; without a calibration only the ends of the ADC can be judged."""
    margin_c = config.getfloat("guard_margin", 40.0, minval=5.0, maxval=200.0)
    if not parameters.supervise.calibrated:
        return [guard_limits.LimitRow(parameters.estimator.phase_low_ticks, 0, 65535)]
    try:
        return guard_limits.guard_limits(
            parameters.estimator.law,
            parameters.front,
            GUARD_LOW_C,
            parameters.supervise.temp_high_c + margin_c,
            parameters.estimator.phase_low_ticks,
        )
    except ValueError as e:
        raise config.error(f"Section '{config.get_name()}': {e}") from None


def ceiling(
    config: ConfigWrapper, parameters: loop.LoopParameters, rows: list[guard_limits.LimitRow]
) -> guard_limits.Ceiling | None:
    """The limit that follows the target; None without a calibration."""
    margin_c = config.getfloat("guard_margin", 40.0, minval=5.0, maxval=200.0)
    if not parameters.supervise.calibrated:
        return None
    law, front = parameters.estimator.law, parameters.front
    return guard_limits.Ceiling(CEILING_PHASE_TICKS, law, front, tuple(rows), margin_c)
