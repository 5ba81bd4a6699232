"""The options of [temperature_plan]; scripts/plan_temperature.py reads them as well."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from configfile import ConfigWrapper
from thermal.control.loop import LoopParameters
from thermal.models.melt_exchange import NozzleLimits
from thermal.plan import requests
from thermal.plan.deposit import Surroundings
from thermal.plan.materials import MATERIALS, Material
from thermal.plan.planner import Deposited, PlanOptions
from thermal.plan.session import PlanSettings

FOLLOW_MM = 60000.0  # a fair part of a print: the weld is held where the user's own target has it on average
HEADROOM_C = 5.0  # the nozzle passes its reference by a degree or two, and at max_temp the printer shuts down
SLOWEST = 0.2  # of the file's speed; slicers go down to a tenth for their minimum layer time


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(PlanSettings):
    """The section's options."""

    heater: str
    exchange_w_k: float | None  # instead of the heater's own
    melt_mm3: float
    power_share: float
    enabled: bool
    record: str | None  # file for a row of each deposited piece
    written_at: Mapping[str, str]  # options of the table: file and line


def _refusal(config: ConfigWrapper, option: str, what: str) -> Exception:
    error: Exception = config.error(
        f"Option '{option}' in section '{config.get_name()}': {what} ({config.where(option)})."
    )
    return error


def _read(config: ConfigWrapper, option: str, reader: Callable[[str], Any]) -> Any:
    try:
        return reader(config.get(option, ""))
    except ValueError as e:
        raise _refusal(config, option, str(e)) from None


def _table(config: ConfigWrapper, material: Material) -> requests.RequestTable:
    """The temperatures requested by name. The material's window would silently clamp those outside it."""
    table = requests.RequestTable(
        {requests.feature_name(k): v for k, v in _read(config, "features", requests.read_names).items()},
        {k.upper(): v for k, v in _read(config, "objects", requests.read_names).items()},
        _read(config, "layers", requests.read_ranges),
        _read(config, "heights", requests.read_ranges),
    )
    for option, place, temp_c in table.entries():
        if not material.low_c <= temp_c <= material.high_c:
            raise _refusal(
                config,
                option,
                f"'{place}: {temp_c:g}' is no melt of {material.name}, which is deposited at {material.low_c:g} to"
                f" {material.high_c:g} C; melt_min and melt_max say otherwise if need be",
            )
    return table


def _is_record(path: Path) -> bool:
    """Whether a file is empty or an earlier record: only such a one is overwritten."""
    start = ",".join(Deposited._fields).encode()
    with path.open("rb") as stream:
        return stream.read(len(start)) in (b"", start)


def _record(config: ConfigWrapper) -> str | None:
    """A file that can be written, as far as can be checked without making it."""
    text = config.get("record", None)
    if text is None:
        return None
    path = Path(text).expanduser()
    if path.is_dir():
        wrong = f"'{text}' is a folder"
    elif path.is_fifo() or (path.is_file() and not _is_record(path)):
        wrong = f"'{text}' is another file, which would be lost"
    elif not path.parent.is_dir():
        wrong = f"there is no folder '{path.parent}'"
    elif not os.access(path if path.exists() else path.parent, os.W_OK):
        wrong = f"'{text}' cannot be written"
    else:
        return str(path)
    raise _refusal(config, "record", f"{wrong}; the name of a file in a folder that exists is needed")


def _material(config: ConfigWrapper) -> Material:
    names = {name: name for name in MATERIALS} | {name.lower(): name for name in MATERIALS}
    base = MATERIALS[config.getchoice("material", names, "PLA")]
    low_c = config.getfloat("melt_min", base.low_c, minval=100.0, maxval=500.0)
    high_c = config.getfloat("melt_max", base.high_c, above=low_c, maxval=500.0)
    if high_c <= low_c:  # the one is the material's own
        raise _refusal(config, "melt_min", f"{low_c:g} C is not below melt_max, which is {high_c:g} C")
    return replace(
        base,
        low_c=low_c,
        high_c=high_c,
        bonding_c=config.getfloat("bonding_temp", base.bonding_c, minval=0.0, maxval=400.0),
        flow_c=config.getfloat("flow_temp", base.flow_c, minval=0.0, maxval=450.0),
    )


def nozzle_limits(settings: Settings, parameters: LoopParameters, min_extrude_c: float) -> NozzleLimits:
    """What an [induction_heater] lets the plan do. Its melt exchange is as the heater knows it (MODEL_CALIBRATE with
    FLOW measures it), unless [temperature_plan] says otherwise."""
    holder, own = parameters.heat_balance.loss, parameters.melt
    return NozzleLimits(
        min_c=parameters.supervise.temp_low_c,
        max_c=parameters.supervise.temp_high_c - HEADROOM_C,
        min_extrude_c=min_extrude_c,
        power_w=settings.power_share * parameters.control.power_max_w,
        loss=parameters.loss,
        capacity=parameters.filter.heat,
        exchange=replace(own, ua_w_k=settings.exchange_w_k or own.ua_w_k, volume_mm3=settings.melt_mm3),
        holder_w_k=holder.link_w_k**2 / (holder.link_w_k + holder.second_w_k),
        holder_s=holder.second_j_k / (holder.link_w_k + holder.second_w_k),
    )


def read_settings(config: ConfigWrapper) -> Settings:
    """The section's options. Raises the config's error."""
    name = config.get("heater", "extruder")
    material = _material(config)
    margin_c = config.getfloat("bonding_margin", 15.0, minval=0.0, maxval=150.0)
    wanted_c = config.getfloat("interface_temp", None, above=0.0, maxval=500.0)
    lowest_c = material.bonding_c + margin_c
    filament_mm = 1.75
    if config.has_section(name):
        filament_mm = config.getsection(name).getfloat("filament_diameter", 1.75, above=0.0)
    return Settings(
        heater=name,
        material=material,
        surroundings=Surroundings(
            bed_c=config.getfloat("bed_temp", 60.0),
            chamber_c=config.getfloat("chamber_temp", 25.0),
            still_w_m2k=config.getfloat("still_air", 30.0, above=0.0),
            fan_w_m2k=config.getfloat("fan_air", 60.0, minval=0.0),
        ),
        options=PlanOptions(
            interface_c=(wanted_c or lowest_c) if config.getboolean("bonding", True) else None,
            follow_mm=FOLLOW_MM if wanted_c is None else 0.0,
            core=config.getboolean("flow", False),
            zone_mm=config.getfloat("melt_zone_length", 20.0, above=0.0),
            filament_mm=filament_mm,
            preview=config.getboolean("preview", True),
            smooth_s=config.getfloat("smooth_time", 0.3, minval=0.0, maxval=5.0),
        ),
        table=_table(config, material),
        exchange_w_k=config.getfloat("melt_exchange", None, above=0.0),
        melt_mm3=config.getfloat("melt_volume", 0.0, minval=0.0),
        power_share=config.getfloat("power_share", 0.8, above=0.0, maxval=1.0),
        slowest=config.getfloat("minimum_speed_factor", SLOWEST, above=0.0, maxval=1.0),
        longest_pause_s=config.getfloat("max_layer_pause", 0.0, minval=0.0, maxval=120.0),
        enabled=config.getboolean("enable", True),
        record=_record(config),
        written_at={option: config.where(option) for option in ("features", "objects", "layers", "heights")},
    )
