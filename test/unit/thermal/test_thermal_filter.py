"""The filter in temperature and the heat balance beside it: quiet, quick, and honest about what they do not know."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from chain_rig import FFI, LIB, c_params, new_chain
from thermal.models import heat_loss
from thermal.records import SampleBlock, TempEstimate
from thermal.sensing import blocks, features, heat_balance_monitor, temperature_filter

BLOCK_S = 0.0016
LOSS, HEAT = heat_loss.LossLaw(), heat_loss.HeatCapacity()
CHAIN = new_chain(filtered=temperature_filter.FilterParameters(LOSS, HEAT))


class Filter:
    """The filter alone: blocks of given temperature and heat."""

    def __init__(self) -> None:
        self.state: Any = FFI.new("struct filter_state *")
        LIB.filter_reset(self.state)
        self._parameters = FFI.addressof(c_params(CHAIN), "filter")

    def block(self, n: int, power_w: float, temp_c: float, noise_c: float = 0.1) -> TempEstimate | None:
        one = blocks.Blocks()
        one.count = 1
        raw = one.raw[0]
        raw.time_s, raw.duration_s, raw.phase_ticks = n * BLOCK_S, BLOCK_S, 8000
        raw.centre_s, raw.end_s, raw.heat_w = (n + 0.5) * BLOCK_S, (n + 1) * BLOCK_S, power_w
        raw.temp_c, raw.sigma_c, raw.noise_c, raw.c_per_unit = temp_c, 1.0, noise_c, 1.3
        LIB.filter_block(self._parameters, self.state, one.raw)
        return one.tracked(0)


def run(temps: np.ndarray, power_w: np.ndarray, noise_c: float) -> tuple[np.ndarray, Filter]:
    filtered, out = Filter(), []
    random = np.random.default_rng(1)
    for n, (temp, watts) in enumerate(zip(temps, power_w, strict=True)):
        got = filtered.block(n, watts, temp + random.normal(0, noise_c), noise_c)
        out.append(got.temp_c if got else math.nan)
    return np.array(out), filtered


def test_at_rest_it_is_as_quiet_as_seventeen_bits() -> None:
    """4^5 samples of 1 LSB are 0.031 LSB = 0.04 degC; a block of 192 samples has 0.1 degC."""
    held = np.full(3000, 250.0)
    out, _ = run(held, np.full(3000, heat_loss.loss_w(LOSS, 250.0)), 0.1)
    assert np.std(out[500:] - 250.0) < 0.045


def test_a_step_of_the_drive_is_followed_without_lag_because_the_heat_is_known() -> None:
    power = np.where(np.arange(1000) < 500, heat_loss.loss_w(LOSS, 100.0), 60.0)
    temps, temp = [], 100.0
    for watts in power:  # 60 W: 120 K/s
        temps.append(temp)
        temp += BLOCK_S * (watts - heat_loss.loss_w(LOSS, temp)) / HEAT.at(temp)
    out, _ = run(np.array(temps), power, 0.1)
    assert np.abs(out[100:] - np.array(temps)[100:]).max() < 0.4


def test_an_unknown_disturbance_is_found_within_its_memory() -> None:
    """Extrusion takes 13 K/s from one block to the next: harder than 50 ms of a real melt."""
    time_s = np.arange(1500) * BLOCK_S
    temps = 250.0 - np.where(time_s > 1.0, 13.0 * (time_s - 1.0), 0.0)
    out, on = run(temps, np.full(1500, heat_loss.loss_w(LOSS, 250.0)), 0.1)
    assert np.abs(out[200:] - temps[200:]).max() < 0.5
    assert on.state.rate_k_s == pytest.approx(-13.0, abs=3.0)


def test_one_wild_block_is_left_out_and_several_are_accepted() -> None:
    _, on = run(np.full(500, 200.0), np.full(500, 3.0), 0.1)
    assert on.block(500, 3.0, 320.0) is None
    good = on.block(501, 3.0, 200.0)
    assert good is not None and good.temp_c == pytest.approx(200.0, abs=0.5)
    results = [on.block(n, 3.0, 320.0) for n in range(502, 506)]
    assert results[:3] == [None] * 3
    assert results[3] is not None and results[3].temp_c == 320.0


def test_after_a_long_silence_it_starts_anew() -> None:
    _, on = run(np.full(100, 200.0), np.full(100, 3.0), 0.1)
    got = on.block(1000, 0.0, 120.0)
    assert got is not None and got.temp_c == 120.0


def test_uncertainty_holds_the_laws_part_and_shrinks_only_the_noise() -> None:
    _, on = run(np.full(300, 200.0), np.full(300, 3.0), 0.1)
    got = on.block(300, 3.0, 200.0)
    assert got is not None
    assert got.sigma_noise_c < 0.06
    assert got.sigma_c >= math.sqrt(1.0 - 0.01)  # 1.0 in all, 0.1 of it noise


# Noise of the samples


@pytest.mark.parametrize("noise_lsb", [0.15, 0.3, 0.5, 1.0, 3.0])
def test_noise_is_distinguished_from_the_span_of_blocks(noise_lsb: float) -> None:
    random = np.random.default_rng(5)
    chain = new_chain()
    for n in range(400):
        codes = np.floor(500.0 + random.uniform() + noise_lsb * random.standard_normal(192) + 0.5)
        low, high = int(codes.min()), int(codes.max())
        block = SampleBlock(n, 0, n * BLOCK_S, BLOCK_S, 192, float(codes.mean()), low, high, 8000, 0, 0)
        chain.take(blocks.Blocks.of([block]))
    got = chain.noise_lsb()
    assert got == pytest.approx(noise_lsb, rel=0.1)
    assert (got < features.NOISE_NEEDED_LSB * 0.95) == (noise_lsb == 0.15)


@pytest.mark.parametrize("noise_lsb", [0.05, 0.2, 1.0, 4.0])
def test_the_span_is_as_many_sigma_as_gaussian_noise_gives(noise_lsb: float) -> None:
    random = np.random.default_rng(6)
    level, noise = random.uniform(0, 1, 4000)[:, None], noise_lsb * random.standard_normal((4000, 192))
    codes = np.floor(level + noise + 0.5)
    span = (codes.max(1) - codes.min(1)).mean()
    assert span == pytest.approx(features.SPAN_PER_NOISE * noise_lsb, rel=0.015, abs=0.03)


@pytest.mark.parametrize("noise_lsb", [0.0, 0.05, 0.1, 0.25, 0.5, 1.0])
def test_six_blocks_are_as_uncertain_as_they_say_with_any_noise(noise_lsb: float) -> None:
    """Without noise all samples are one code: 1/sqrt(12) LSB, however many; with enough their mean lies between."""
    random = np.random.default_rng(7)
    level, noise = random.uniform(0, 1, 600)[:, None], noise_lsb * random.standard_normal((600, 6 * 192))
    off = (np.floor(level + noise + 0.5) - level).mean(1)
    front = FFI.new(
        "struct front_params *", features.front_params(features.FeatureParameters(noise_lsb=noise_lsb))
    )
    one = blocks.Blocks.of([SampleBlock(0, 0, 0.0, BLOCK_S, 192, 500.0, 500, 501, 8000, 0, 0)])
    LIB.front_measure(front, one.raw, 1)
    # the bound takes the error's harmonics for its first: up to pi over root 6 too much
    assert 0.75 < np.sqrt((off**2).mean()) / (one.raw[0].noise_units / math.sqrt(6.0)) < 1.06


# Heat balance


def balance(
    power_factor: float, seconds: float, capacity: float = 1.0
) -> heat_balance_monitor.HeatBalanceState:
    """Hold 250 degC with `power_factor` times the heat the model needs for it."""
    loss = heat_balance_monitor.scaled(1.0, 25.0)
    parameters = heat_balance_monitor.HeatBalanceParameters(HEAT, loss, 0.03)
    state = heat_balance_monitor.HeatBalanceState(second_c=25.0)
    second = 25.0
    for n in range(int(seconds * 10)):
        watts = loss.skin_out_w(250.0, second) * power_factor
        second += 0.1 * loss.second_rate(250.0, second)
        heat_balance_monitor.observe(parameters, state, 0.1 * n, 250.0, 0.1 * watts, True)
    return state


def test_a_balance_that_closes_means_no_drift() -> None:
    assert balance(1.0, 60.0).drift_c == pytest.approx(0.0, abs=0.2)


def test_more_heat_than_the_reading_explains_means_it_reads_low() -> None:
    state = balance(1.08, 60.0)
    loss = heat_balance_monitor.scaled(1.0, 25.0)
    expected = -0.08 * loss.skin_out_w(250.0, state.second_c) / loss.slope_w_k(250.0)
    assert state.drift_c == pytest.approx(expected, rel=0.15)


def test_nothing_is_said_before_it_has_been_quiet_for_long() -> None:
    assert balance(1.3, 20.0).drift_c is None


@pytest.mark.parametrize(("factor", "named"), [(1.0, False), (0.5, True), (1.6, True), (1.2, False)])
def test_a_nozzle_of_another_mass_is_named_from_its_heat_up(factor: float, named: bool) -> None:
    parameters = heat_balance_monitor.HeatBalanceParameters(HEAT, heat_balance_monitor.scaled(1.0, 25.0))
    state, temp, second = heat_balance_monitor.HeatBalanceState(), 25.0, 25.0
    for n in range(60):
        heat_balance_monitor.observe(parameters, state, 0.1 * n, temp, 8.13, True)
        out = parameters.loss.skin_out_w(temp, second)
        temp += 0.1 * (81.3 - out) / (HEAT.at(temp) * factor)
        if temp > 300.0:
            break
    assert state.capacity_ratio == pytest.approx(factor, rel=0.05)
    assert ("wrong nozzle" in heat_balance_monitor.warning(parameters, state)) == named


def test_a_start_with_a_hot_nozzle_takes_the_unknown_second_mass_for_no_drift() -> None:
    """As after a RESTART in a print: the skin is known, what stands behind it is not."""
    loss = heat_balance_monitor.scaled(1.0, 25.0)
    parameters = heat_balance_monitor.HeatBalanceParameters(HEAT, loss, 0.03)
    for behind in (30.0, 70.0, 135.0):
        state, temp, second, drifts = heat_balance_monitor.HeatBalanceState(), 135.0, behind, []
        for n in range(1200):  # two minutes of cooling, exactly by the model
            heat_balance_monitor.observe(parameters, state, 0.1 * n, temp, 0.0, True)
            drifts.append(state.drift_c)
            rate = loss.second_rate(temp, second)
            temp -= 0.1 * loss.skin_out_w(temp, second) / HEAT.at(temp)
            second += 0.1 * rate
        said = [drift for drift in drifts if drift is not None]
        # it takes some 75 s to be sure, and then it is not silent for ever
        assert 300 < len(said) < 700
        assert max(map(abs, said)) < 2.0
