"""Parameters and memory of a nozzle's loop as plain JSON values and back.

A record (dataclass, named tuple) becomes {"type": its name, field: value, ...}, a C structure {"struct": [...]} of its
fields, a control law {"law": name}. A field that a version does not have keeps its default there, and an unknown one is
left out: a run recorded by one version can be replayed by another.
"""

from __future__ import annotations

from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import chelper
from thermal import records
from thermal.control import actuator, control_api, loop, pid, predictive, timeline, two_period
from thermal.drift import correction as drift
from thermal.drift import observer as drift_observer
from thermal.drift import rest
from thermal.models import drive_law, heat_loss, heater_model, melt_exchange
from thermal.sensing import (
    block_temperature,
    features,
    heat_balance_monitor,
    laws,
    supervision,
    temperature_filter,
)

Plain = Any  # what json takes: None, bool, int, float, str, list, dict

_MODULES = (
    *(records, actuator, control_api, loop, pid, predictive, timeline, two_period),
    *(drive_law, heat_loss, heater_model, melt_exchange),
    *(block_temperature, drift, drift_observer, features, heat_balance_monitor, laws, rest, supervision),
    temperature_filter,
)
_TYPES = {
    name: kind
    for module in _MODULES
    for name, kind in vars(module).items()
    if isinstance(kind, type) and (is_dataclass(kind) or hasattr(kind, "_fields"))
}
_CONTROL = {law.name: law for law in (pid.PID, pid.WATERMARK, two_period.TWO_PERIOD, predictive.MODEL)}


class UnknownType(ValueError):
    """A recording holds a record that this version does not have; the text is for people."""


def plain(value: Any) -> Plain:
    """JSON's form. Raises UnknownType where there is none (the control law of a calibration run)."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, control_api.Law):
        if value.name not in _CONTROL:
            raise UnknownType(f"control law '{value.name}' cannot be recorded")
        return {"law": value.name}
    if isinstance(value, (predictive.ModelState, timeline.Bridge)):
        raw = of_struct(value.raw)
        if "line" in raw:
            del raw["line"]["commands"][raw["line"]["count"] :]
        return {"type": type(value).__name__, "raw": raw}
    if isinstance(value, control_api.Reference):
        return {"type": "Reference", "times_s": list(value.times_s), "temps_c": list(value.temps_c)}
    if type(value).__name__ in _TYPES:
        names = [f.name for f in fields(value) if f.init] if is_dataclass(value) else value._fields
        return {"type": type(value).__name__, **{name: plain(getattr(value, name)) for name in names}}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    raise UnknownType(f"a {type(value).__name__} cannot be recorded")


def _as_field(field: Field[Any], value: Any) -> Any:
    """Lists where the field's default has them."""
    default = field.default_factory() if field.default_factory is not MISSING else None
    if not isinstance(default, list):
        return value
    return [list(item) if default and isinstance(default[0], list) else item for item in value]


def restored(value: Plain) -> Any:
    """The reverse of plain(); lists come back as tuples, but for fields that are lists, or lists of lists. Raises
    UnknownType."""
    if isinstance(value, list):
        return tuple(restored(item) for item in value)
    if not isinstance(value, dict):
        return value
    if "type" in value:
        return _record(value["type"], value)
    if value.get("law") in _CONTROL:
        return _CONTROL[value["law"]]
    raise UnknownType(f"control law '{value.get('law')}' is not known here")


def _record(name: str, value: dict[str, Plain]) -> Any:
    if name in ("ModelState", "Bridge"):
        state = predictive.ModelState() if name == "ModelState" else timeline.Bridge()
        fill_struct(state.raw, value["raw"])
        return state
    if name == "Reference":
        return control_api.Reference(tuple(value["times_s"]), tuple(value["temps_c"]))
    kind: Any = _TYPES.get(name)
    if kind is None:
        raise UnknownType(f"a record '{name}' is not known here")
    if not is_dataclass(kind):
        return kind(**{field: restored(value[field]) for field in kind._fields if field in value})
    given = {f.name: f for f in fields(kind) if f.init and f.name in value}
    values = {key: restored(value[key]) for key in given}
    made: Any = kind
    return made(**{key: _as_field(given[key], item) for key, item in values.items()})


def of_struct(raw: Any) -> Plain:
    """Fields of C's structure (or a pointer to one) by name; arrays as lists."""
    ffi = chelper.get_ffi()[0]
    if not isinstance(raw, ffi.CData):
        return raw
    kind = ffi.typeof(raw)
    if kind.kind == "array":
        return [of_struct(item) for item in raw]
    members = (kind.item if kind.kind == "pointer" else kind).fields
    return {name: of_struct(getattr(raw, name)) for name, _ in members}


def fill_struct(raw: Any, values: Plain) -> None:
    """The reverse; fields that the structure has not, or `values` has not, are left as they are."""
    ffi = chelper.get_ffi()[0]
    kind = ffi.typeof(raw)
    for name, member in (kind.item if kind.kind == "pointer" else kind).fields:
        if name not in values:
            continue
        value, place = values[name], member.type.kind
        if place == "struct":
            fill_struct(getattr(raw, name), value)
        elif place == "array" and value and isinstance(value[0], dict):
            for item, given in zip(getattr(raw, name), value, strict=False):
                fill_struct(item, given)
        else:
            setattr(raw, name, value)
