"""One HTML page of an offline temperature plan: every layer, coloured by nozzle, substrate or interface temperature."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermal.plan.materials import Material
from thermal.plan.planner import Summary

from ..plan_offline import OfflinePlan, PlannedMove
from .data import LAYER_STEP_MM

PAGE = Path(__file__).parent / "page" / "plan.html"
HUNDREDTH_MM = 100.0
MAX_MOVES = 300_000  # above, neighbours are left out: the page stays under 5 MB


def figures(plan: OfflinePlan, material: Material, plain: Summary | None = None) -> dict[str, Any]:
    """The table of the page, for programs. `plain`: of the file at its own speed, if the plan slows it down; that is
    what "fixed" means then."""
    totals, fixed_totals = plan.summary, plain or plan.summary
    planned, fixed = totals.interface_5_50_95_c[0], fixed_totals.interface_5_50_95_c[1]
    return {
        "material": material.name,
        "bonding_c": material.bonding_c,
        "length_mm": round(totals.length_mm, 1),
        "moves": len(plan.moves),
        "duration_s": round(plan.duration_s, 1),
        "bonded_share": round(totals.bonded_share[0], 5),
        "bonded_share_fixed": round(fixed_totals.bonded_share[1], 5),
        "interface_5_50_95_c": [round(v, 1) for v in planned],
        "interface_5_50_95_fixed_c": [round(v, 1) for v in fixed],
        "spread_c": round(totals.spread_c[0], 1),
        "spread_fixed_c": round(fixed_totals.spread_c[1], 1),
        "spread_fixed_same_speed_c": round(totals.spread_c[1], 1),
        "melt_against_wanted_rms_c": round(totals.melt_rms_c, 2),
        "cold_share": round(totals.cold_share, 4),
        "hot_share": round(totals.hot_share, 4),
        "min_speed_factor": round(min((move.speed_factor for move in plan.moves), default=1.0), 3),
        "pauses_s": round(sum(change.speed.pause_s for change in plan.speed_changes), 1),
    }


_UNITS = {"c": "°C", "mm": "mm", "s": "s"}


def _label(key: str) -> str:
    """ "spread_fixed_c" -> "spread fixed, °C"."""
    words, _, last = key.rpartition("_")
    if last not in _UNITS:
        return key.replace("_", " ")
    return f"{words.replace('5_50_95', '5, 50, 95 %').replace('_', ' ')}, {_UNITS[last]}"


def _shown(value: Any) -> str:
    return " · ".join(map(str, value)) if isinstance(value, list) else str(value)


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode("ascii")


def _layer_starts(moves: Sequence[PlannedMove]) -> list[int]:
    """First move of each layer; a path that rises all the time (a vase) is cut into steps that could be layers."""
    starts = [0]
    for number, move in enumerate(moves):
        first = moves[starts[-1]]
        if (move.layer != first.layer or not move.layer) and abs(
            move.end_mm[2] - first.end_mm[2]
        ) >= LAYER_STEP_MM:
            starts.append(number)
    return starts


def write(path: Path, name: str, plan: OfflinePlan, material: Material, plain: Summary | None = None) -> None:
    """Raises OSError."""
    moves = plan.moves[:: 1 + len(plan.moves) // MAX_MOVES]
    ways = np.array([(*m.start_mm[:2], *m.end_mm[:2]) for m in moves])
    low = ways.reshape(-1, 2).min(axis=0)
    ways = (ways - np.tile(low, 2)) * HUNDREDTH_MM
    temps = np.array([(m.wall_c, m.substrate_c, m.interface_c, m.interface_fixed_c) for m in moves])
    starts = _layer_starts(moves)
    data = {
        "ways": _packed(ways.round(), "<u2"),
        "temps": _packed((temps * 2.0).round().clip(0, 65535), "<u2"),  # half degrees
        "starts": starts,
        "heights": [round(moves[i].end_mm[2], 3) for i in starts],
        "bonding": material.bonding_c,
        "corners": _packed(plan.corners[:: 1 + len(plan.corners) // 4000].astype("<f4"), "<f4"),
    }
    rows = "".join(
        f"<tr><th>{html.escape(_label(key))}</th><td>{html.escape(_shown(value))}</td></tr>"
        for key, value in figures(plan, material, plain).items()
    )
    page = PAGE.read_text(encoding="utf-8")
    page = page.replace("@TITLE@", html.escape(name)).replace("@ROWS@", rows)
    page = page.replace("@DATA@", json.dumps(data).replace("<", "\\u003c"))
    path.write_text(page, encoding="utf-8")
