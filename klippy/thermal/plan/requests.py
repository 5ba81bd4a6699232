"""What melt temperature a place on the path is asked to have, by name: explicit, object, feature, layer, height.

    lines of the file ─► read_comment ─► Requests (state, frozen) ─► at a piece of path: request_c or NaN (none)

The first that speaks wins: an explicit SET_SEGMENT_TEMPERATURE, then the object, the feature, the layer, the height.
Slicers name the same feature differently; `FEATURES` maps PrusaSlicer/SuperSlicer, OrcaSlicer/Bambu Studio and Cura to
one name each.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

# One name, and what the slicers call it (lower case, blanks for - and _).
_NAMES = {
    "external perimeter": ("outer wall", "wall outer", "overhang external perimeter"),
    "perimeter": ("inner wall", "wall inner", "internal perimeter"),
    "overhang": ("overhang perimeter", "overhang wall"),
    "infill": ("internal infill", "sparse infill", "fill"),
    "solid infill": ("internal solid infill", "skin", "bottom surface"),
    "top surface": ("top solid infill", "top skin"),
    "bridge": ("bridge infill", "internal bridge infill", "internal bridge"),
    "gap fill": ("gap infill",),
    "thin wall": (),
    "ironing": (),
    "skirt": ("skirt/brim", "brim"),
    "support": ("support material",),
    "support interface": ("support material interface",),
    "prime tower": ("wipe tower",),
    "custom": ("other",),
}
FEATURES = {alias: name for name, aliases in _NAMES.items() for alias in (name, *aliases)}

_TYPE = re.compile(r";\s*(?:TYPE|FEATURE)\s*:\s*(.+)", re.IGNORECASE)
_LAYER = re.compile(r";\s*(LAYER_CHANGE|CHANGE_LAYER|LAYER\s*:\s*-?\d+)\s*$", re.IGNORECASE)
_HEIGHT = re.compile(r";\s*(?:HEIGHT|LAYER_HEIGHT)\s*:\s*([0-9.]+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Comment:
    """What a slicer's comment line says; kind "feature", "layer" or "height"."""

    kind: str
    name: str = ""
    value: float = math.nan


def feature_name(text: str) -> str:
    """The one name of a feature; an unknown one keeps its own, in lower case."""
    plain = re.sub(r"[-_\s]+", " ", text.strip().lower())
    return FEATURES.get(plain, plain)


def read_comment(line: str) -> Comment | None:
    """What a comment line says about the path that follows, None if nothing."""
    found = _TYPE.match(line)
    if found is not None:
        return Comment("feature", feature_name(found[1]))
    if _LAYER.match(line):
        return Comment("layer")
    found = _HEIGHT.match(line)
    if found is None:
        return None
    try:
        height = float(found[1])
    except ValueError:
        return None
    return Comment("height", value=round(height, 4)) if 0.0 < height < 10.0 else None


@dataclass(frozen=True, slots=True)
class Range:
    """A temperature for layers or heights low..high, both ends included."""

    low: float
    high: float
    temp_c: float


@dataclass(frozen=True, slots=True)
class RequestTable:
    """What the config asks for, degC of the melt."""

    features: Mapping[str, float] = field(default_factory=dict)
    objects: Mapping[str, float] = field(default_factory=dict)  # names in upper case
    layers: tuple[Range, ...] = ()  # counted from 1
    heights_mm: tuple[Range, ...] = ()

    def entries(self) -> Iterator[tuple[str, str, float]]:
        """(option, place as it is written there, degC) of all that is asked for."""
        for option, names in (("features", self.features), ("objects", self.objects)):
            for name, temp_c in names.items():
                yield option, name, temp_c
        for option, ranges in (("layers", self.layers), ("heights", self.heights_mm)):
            for item in ranges:
                yield option, f"{item.low:g}-{item.high:g}", item.temp_c


@dataclass(frozen=True, slots=True)
class Requests:
    """Where the path is, by name, from `since_s` on."""

    since_s: float = -math.inf
    explicit_c: float = math.nan
    until: str = ""  # what ends the explicit request: "", "layer", "feature", "object"
    duration_s: float = math.inf  # or how long it holds
    feature: str = ""
    object_name: str = ""
    layer: int = 0  # counted by comments; 0: none seen
    height_mm: float = math.nan  # layer height by comments
    speed_factor: float = (
        1.0  # part of the file's speed at which it is deposited (thermal/plan/layer_time.py)
    )

    def comment(self, found: Comment) -> Requests:
        """After a slicer's comment."""
        if found.kind == "height":
            return replace(self, height_mm=found.value)
        if found.kind == "layer":
            return replace(self._ended("layer"), layer=self.layer + 1)
        return replace(self._ended("feature"), feature=found.name)

    def inside(self, object_name: str) -> Requests:
        """In another object, "" in none."""
        if object_name == self.object_name:
            return self
        return replace(self._ended("object"), object_name=object_name)

    def explicitly(self, temp_c: float, until: str = "", duration_s: float = math.inf) -> Requests:
        """After SET_SEGMENT_TEMPERATURE; NaN takes an explicit request back."""
        return replace(self, explicit_c=temp_c, until=until, duration_s=duration_s)

    def _ended(self, what: str) -> Requests:
        return self.explicitly(math.nan) if self.until == what else self

    def asks(self, table: RequestTable) -> tuple[float | None, ...]:
        """All of it that matters to the path with this table. Equal: it is asked for the same."""
        of_object = table.objects.get(self.object_name.upper()) if table.objects else None
        layer = self.layer if table.layers else 0
        of_feature = table.features.get(self.feature)
        return (
            self.explicit_c,
            self.duration_s,
            of_object,
            of_feature,
            layer,
            self.height_mm,
            self.speed_factor,
        )

    def request_c(self, table: RequestTable, time_s: float, layer: int, z_mm: float) -> float:
        """Melt temperature asked for at a piece of path, NaN if nothing is."""
        over = math.isfinite(self.duration_s) and time_s >= self.since_s + self.duration_s
        if not math.isnan(self.explicit_c) and not over:
            return self.explicit_c
        for found in (table.objects.get(self.object_name.upper()), table.features.get(self.feature)):
            if found is not None:
                return found
        for ranges, value in ((table.layers, float(self.layer or layer)), (table.heights_mm, z_mm)):
            for item in ranges:
                if item.low <= value <= item.high:
                    return item.temp_c
        return math.nan


def read_names(text: str) -> dict[str, float]:
    """Lines "NAME: temperature". Raises ValueError with the line."""
    table = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        name, colon, value = line.rpartition(":")
        if not colon or not name.strip():
            raise ValueError(f"'{line}' is not of the form NAME: temperature")
        table[name.strip()] = _number(value, line)
    return table


def read_ranges(text: str) -> tuple[Range, ...]:
    """Lines "LOW-HIGH: temperature" or "VALUE: temperature". Raises ValueError with the line."""
    ranges = []
    for line in filter(None, map(str.strip, text.splitlines())):
        span, colon, value = line.rpartition(":")
        if not colon:
            raise ValueError(f"'{line}' is not of the form FROM-TO: temperature")
        low, dash, high = span.partition("-")
        first = _number(low, line)
        last = _number(high, line) if dash else first
        if last < first:
            raise ValueError(f"'{line}': the range ends before it begins")
        ranges.append(Range(first, last, _number(value, line)))
    return tuple(ranges)


def _number(text: str, line: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"'{line}': '{text.strip()}' is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"'{line}': '{text.strip()}' is not a number")
    return value
