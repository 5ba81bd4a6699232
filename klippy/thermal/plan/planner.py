"""The temperature plan in the C helper (thermal/plan/planner.h), for the printer and for offline tools.

    pieces of path ─► add: substrate, wanted melt, wall ─► make: corners of the nozzle's temperature ─► finish: totals

The models and their sources are thermal/{deposit,weld,nozzle_melt,plan,filament_heat}.py. Times are print times in s.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import chelper
from thermal.control.control_api import Reference
from thermal.models import filament_heat
from thermal.models.heat_loss import loss_w
from thermal.models.melt_exchange import NozzleLimits, highest_c

from .deposit import Surroundings
from .layer_time import Ages
from .materials import Material
from .path_pieces import PathPieces

CORE_STEP_MM3_S = 0.5
CORE_FLOW_MAX_MM3_S = 60.0
CORNERS = 64  # of a reference, usually fewer
_PIECE = struct.Struct("=19d")
_DONE = struct.Struct("=9d")


class Piece(NamedTuple):
    """A straight piece of path at one extrusion rate. mm, s, mm3/s, degC; `request_c` NaN: none by name."""

    start_s: float
    end_s: float
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    flow_mm3_s: float
    height_mm: float
    fan: float = 0.0
    request_c: float = math.nan
    base_c: float = 0.0  # the user's own nozzle target
    speed_factor: float = 1.0  # part of its own speed at which it is deposited


class Deposited(NamedTuple):
    """What became of a piece: temperatures in degC; *_fixed_c as one fixed temperature would have deposited it."""

    start_s: float
    end_s: float
    wall_c: float
    wanted_melt_c: float
    melt_c: float
    substrate_c: float
    interface_c: float
    substrate_fixed_c: float
    interface_fixed_c: float


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """What besides names decides: the weld and the core of the filament."""

    interface_c: float | None = None  # temperature wanted at the weld; None: the weld has no say
    follow_mm: float = (
        0.0  # > 0: at least interface_c, and as warm as the user's own target welds over this path
    )
    core: bool = False  # the filament's core must reach the material's flow temperature
    zone_mm: float = 20.0  # heated length of the nozzle
    filament_mm: float = 1.75
    preview: bool = True  # False: turn at the border of each piece, as M104 would
    smooth_s: float = 0.0  # wanted walls are averaged over this time to both sides


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of what has been deposited; pairs are (planned, fixed)."""

    length_mm: float
    pieces: int
    bonded_share: tuple[float, float]
    interface_5_50_95_c: tuple[tuple[float, float, float], tuple[float, float, float]]
    melt_rms_c: float  # planned less wanted melt
    cold_share: float  # of the path: the wanted weld would have needed a hotter melt than the material bears
    hot_share: float
    slowed_s: float  # that hot layers took longer than the file's own speed
    band_c: tuple[
        float, float
    ]  # interface that the window can make of the hottest and of the coldest 5 % of the path

    @property
    def spread_c(self) -> tuple[float, float]:
        """5 to 95 % of the path, interface temperature."""
        a, b = self.interface_5_50_95_c
        return a[2] - a[0], b[2] - b[0]


def _percentiles(lengths: Sequence[float]) -> tuple[float, float, float]:
    total = sum(lengths)
    found: list[float] = []
    running = 0.0
    for degree, length in enumerate(lengths):
        while len(found) < 3 and running + length >= (0.05, 0.5, 0.95)[len(found)] * total and length > 0.0:
            share = ((0.05, 0.5, 0.95)[len(found)] * total - running) / length
            found.append(degree + share)
        running += length
    return (found[0], found[1], found[2]) if len(found) == 3 else (math.nan,) * 3


class TemperaturePlan:
    """One nozzle's plan. Raises ValueError if its power cannot hold the lowest temperature."""

    def __init__(
        self,
        limits: NozzleLimits,
        material: Material,
        surroundings: Surroundings,
        options: PlanOptions,
        cell_mm: float = 2.0,
    ) -> None:
        floor_c, ceiling_c = max(limits.min_c, limits.min_extrude_c), highest_c(limits)
        if ceiling_c < floor_c:
            raise ValueError(
                f"The power of {limits.power_w:.1f} W holds {ceiling_c:.0f} degC at most, below the lowest temperature"
                f" of {floor_c:.0f} degC at which this nozzle may extrude."
            )
        self._ffi, self._lib = chelper.get_ffi()
        self._limits = limits
        self._floor_c, self._ceiling_c, self._cell_mm = floor_c, ceiling_c, cell_mm
        degrees = range(math.ceil(ceiling_c) + 2)
        chi, radius_m = material.diffusivity_m2_s, 0.5e-3 * options.filament_mm
        cores = [1.0]
        while CORE_STEP_MM3_S * len(cores) <= CORE_FLOW_MAX_MM3_S:
            feed_m_s = 1e-9 * CORE_STEP_MM3_S * len(cores) / (math.pi * radius_m**2)
            cores.append(filament_heat.core_fraction(chi * 1e-3 * options.zone_mm / (feed_m_s * radius_m**2)))
        plan = self._lib.tempplan_alloc(
            self._parameters(material, surroundings, options),
            [loss_w(limits.loss, t) for t in degrees],
            [limits.capacity.at(t) for t in degrees],
            len(degrees),
            cores,
            len(cores),
        )
        if plan == self._ffi.NULL:
            raise MemoryError("no memory for the temperature plan")
        self._plan = self._ffi.gc(plan, self._lib.tempplan_free)
        self._done = bytearray()
        self._turn = self._ffi.new("struct path_turn *")
        self._take_turn = self._lib.tempplan_path_turn
        self._line_type = self._ffi.typeof("struct model_line *")
        self._line = self._new_line()

    def _parameters(self, material: Material, surroundings: Surroundings, options: PlanOptions) -> Any:
        limits = self._limits
        exchange = limits.exchange
        values = {
            "floor_c": self._floor_c,
            "ceiling_c": self._ceiling_c,
            "power_w": limits.power_w,
            "holder_w_k": limits.holder_w_k,
            "holder_s": limits.holder_s,
            "ua_w_k": exchange.ua_w_k,
            "heat_mj_m3k": exchange.heat_mj_m3k,
            "inlet_c": exchange.inlet_c,
            "bore_lag_s": exchange.bore_lag_s,
            "melt_mm3": exchange.volume_mm3,
            "low_c": material.low_c,
            "high_c": material.high_c,
            "diffusivity_m2_s": material.diffusivity_m2_s,
            "rho_c": material.density_kg_m3 * material.heat_j_kgk,
            "bonding_c": material.bonding_c,
            "bed_c": surroundings.bed_c,
            "chamber_c": surroundings.chamber_c,
            "still_w_m2k": surroundings.still_w_m2k,
            "fan_w_m2k": surroundings.fan_w_m2k,
            "bed_reach_mm": surroundings.bed_reach_mm,
            "cell_mm": self._cell_mm,
            "interface_c": math.nan if options.interface_c is None else options.interface_c,
            "follow_mm": options.follow_mm,
            "core_c": material.flow_c if options.core else math.nan,
            "core_step_mm3_s": CORE_STEP_MM3_S,
            "smooth_s": options.smooth_s,
            "preview": float(options.preview),
        }
        return self._ffi.new("struct tempplan_params *", values)

    def change(self, material: Material, surroundings: Surroundings, options: PlanOptions) -> None:
        """Other material, surroundings or requests from now on; what has been deposited stays.

        The table of the core keeps the material and zone it was made for.
        """
        self._lib.tempplan_set(self._plan, self._parameters(material, surroundings, options))

    def add(self, pieces: Sequence[Piece]) -> list[tuple[float, float, float]]:
        """Take pieces in order of time; (substrate, wanted melt, wanted wall) of each, NaN for travel."""
        rows = self._ffi.new("struct tempplan_piece[]", len(pieces))
        size = self._ffi.sizeof("struct tempplan_piece")
        buffer = self._ffi.buffer(rows)
        for i, piece in enumerate(pieces):
            _PIECE.pack_into(
                buffer, i * size, piece.start_s, piece.end_s, *piece.start_mm, *piece.end_mm, piece.flow_mm3_s,
                piece.height_mm, piece.fan, piece.request_c, piece.base_c, piece.speed_factor, 0.0, 0.0, 0.0, 0.0, 0.0,
            )  # fmt: skip
        if self._lib.tempplan_add(self._plan, rows, len(pieces)):
            raise MemoryError("no memory for the temperature plan")
        return [(row.substrate_c[0], row.melt_c, row.wall_c) for row in rows]

    def take(self, path: Any, request: Any) -> int:
        """The same with moves that wait on a path in the C helper (path_pieces.Taker)."""
        return int(self._lib.tempplan_path_take(path, request, self._plan))

    def make(self, from_s: float, start_c: float, within_c: float = 0.0) -> list[tuple[float, float]]:
        """Plan again from `from_s` on, where the nozzle is at `start_c`; corners (s, degC), also some of the past.

        Without corners within `within_c` of the line between others.
        """
        count = self._lib.tempplan_make(self._plan, from_s, start_c, within_c)
        return [(p.time_s, p.temp_c) for p in self._lib.tempplan_corners(self._plan)[0:count]]

    def ahead(self, from_s: float, start_c: float, within_c: float) -> Reference | None:
        """The same as a reference; None: nothing lies ahead."""
        count = self._lib.tempplan_make(self._plan, from_s, start_c, within_c)
        return self._reference(count) if count else None

    def turn(
        self, path: PathPieces, from_s: float, within_c: float, recorded_s: float
    ) -> tuple[float, Reference | None] | None:
        """All work of a timer's turn in one call: take the path's moves, record pieces before `recorded_s`, and plan
        again from `from_s` on. Returns (end of the plan, the reference from there; None: no path ahead).

        None: another request holds for moves that still wait (PathPieces.inquire).
        """
        turn, line = self._turn, self._line
        waiting = self._take_turn(
            path.handle, path.request, self._plan, from_s, within_c, recorded_s, turn, line, CORNERS
        )
        if waiting:
            path.check(waiting)
            return None
        count = turn.count
        if not count:
            return turn.end_s, None
        if count > CORNERS:
            return turn.end_s, self._reference(count)
        self._line = self._new_line()
        return turn.end_s, Reference.of_line(line)

    def _reference(self, count: int) -> Reference:
        return Reference.of_pairs(self._lib.tempplan_corners(self._plan), count)

    def _new_line(self) -> Any:
        return self._ffi.new(self._line_type, {"at": 2 * CORNERS})

    def lead(self, corners: Sequence[tuple[float, float]]) -> None:
        """From the first of these (s, degC) on the nozzle is led by them, not by the plan."""
        if self._lib.tempplan_lead(self._plan, corners, len(corners)):
            raise MemoryError("no memory for the temperature plan")

    def holder_c(self, time_s: float, nozzle_c: float) -> float:
        """Nozzle temperature at which its holder is in balance then."""
        return float(self._lib.tempplan_holder(self._plan, time_s, nozzle_c))

    def at(self, time_s: float, otherwise_c: float) -> float:
        """Planned nozzle temperature; `otherwise_c` if nothing is planned."""
        return float(self._lib.tempplan_at(self._plan, time_s, otherwise_c))

    def melt_at(self, time_s: float) -> float:
        """Melt temperature wanted then, NaN without extrusion; of the pieces not yet finished."""
        return float(self._lib.tempplan_melt_at(self._plan, time_s))

    def finish(self, until_s: float, rows: int = 0) -> list[Deposited]:
        """Add what has been deposited by now to the statistics; returns up to `rows` of it."""
        if not rows:
            self._lib.tempplan_finish(self._plan, until_s, self._ffi.NULL, 0)
            return []
        if (
            len(self._done) < rows * _DONE.size
        ):  # kept: zeroing it at each call would cost more than the totals
            self._done = bytearray(rows * _DONE.size)
        count = self._lib.tempplan_finish(
            self._plan, until_s, self._ffi.from_buffer("double[]", self._done), rows
        )
        return [Deposited._make(row) for row in _DONE.iter_unpack(self._done[: count * _DONE.size])]

    def shift(self, from_s: float, delta_c: float) -> None:
        """The user's own target moves: from then on all that is not asked for by name moves with it."""
        self._lib.tempplan_shift(self._plan, from_s, delta_c)

    @property
    def interface_c(self) -> float:
        """Temperature wanted at the weld now; NaN: none."""
        return float(self._lib.tempplan_interface(self._plan))

    @property
    def speed_interface_c(self) -> float:
        """Interface above which a layer is slowed down: near the bed higher than the weld's."""
        return float(self._lib.tempplan_speed_interface(self._plan))

    def ages(self) -> Ages:
        """How long ago the layer below was deposited, summed since the beginning."""
        report = self._lib.tempplan_report(self._plan)
        return Ages(
            report.above_mm, report.age_s, report.depositing_s, report.full_speed_s, report.side_per_mm
        )

    def cut(self, time_s: float) -> None:
        """Forget the plan ahead: the motion was stopped."""
        self._lib.tempplan_cut(self._plan, time_s)

    def sizes(self) -> tuple[int, int]:
        """(columns of the map, pieces held)."""
        sizes = self._ffi.new("uint64_t[2]")
        self._lib.tempplan_sizes(self._plan, sizes)
        return int(sizes[0]), int(sizes[1])

    def summary(self) -> Summary:
        """The totals."""
        report = self._lib.tempplan_report(self._plan)
        length = report.length_mm
        per = 1.0 / length if length > 0.0 else 0.0
        return Summary(
            length,
            int(report.pieces),
            (report.bonded_mm[0] * per, report.bonded_mm[1] * per),
            (_percentiles(list(report.interface_mm[0])), _percentiles(list(report.interface_mm[1]))),
            math.sqrt(report.off_squares * per),
            report.cold_mm * per,
            report.hot_mm * per,
            report.slowed_s,
            (report.lowest_c, report.highest_c),
        )
