"""`make soak-api` in short: misdeeds of clients beside a print, none of which it notices."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest

import soak_api


def test_ten_minutes_of_misdeeds_cost_a_print_nothing(tmp_path: Path) -> None:
    count, rows, wrong = soak_api.soak(600.0, tmp_path)
    assert wrong == ""
    assert count > 3 * len(soak_api.misdeeds())
    steady = [mb for now_s, mb in rows if now_s > soak_api.SETTLED_S]
    assert max(steady) - steady[0] < soak_api.GROWTH_MAX_MB


def test_each_misdeed_for_two_seconds_without_a_rest_costs_a_print_nothing(tmp_path: Path) -> None:
    """`make soak-api EACH=60` in short."""
    each_s, kinds = 2.0, len(soak_api.misdeeds())
    count, _, wrong = soak_api.soak(soak_api.SETTLED_S + each_s * (kinds + 0.5), tmp_path, each_s=each_s)
    assert wrong == ""
    assert count > 5 * kinds


def test_a_host_that_does_not_refuse_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    misdeed = functools.partial(soak_api.run_script, "M114", "must be refused")
    monkeypatch.setattr(soak_api, "misdeeds", lambda: [misdeed])
    _, _, wrong = soak_api.soak(300.0, tmp_path)
    assert "not answered with an error: M114" in wrong
