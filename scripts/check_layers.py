#!/usr/bin/env python3
"""Checks who may know whom: the layers of klippy/, and the borders between the rooms of src/.

Python: a file of klippy/ imports only from its own layer or a lower one, so that what decides can be tested
without what acts. C: the pure files know no board, and nothing but a port knows that port. The rules are the
tables below; an offence is printed as file:line and the exit status is 1.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Lowest layer first. A name is a module, or a package with all it holds.
LAYERS: tuple[tuple[str, frozenset[str]], ...] = tuple(
    (name, frozenset(modules.split()))
    for name, modules in (
        ("helper", "chelper"),
        ("thermal", "thermal"),
        (
            "base",
            "util mathutil meshmath queuelogger reactor configtext configfile gcode_command gcode gcode_io pins"
            " msgproto",
        ),
        ("link", "serialport serialhdl clockfit clocksync mcu mcu_io mcu_homing mcu_session"),
        (
            "motion",
            "motionlimits stepper stepstream kinematics lookahead g1path toolhead tempplan pathpieces",
        ),
        ("extras", "extras"),
        ("app", "webhooks printer klippy parsedump"),
        ("simulation", "simulation"),
    )
)

# thermal/ computes and nothing else: it needs no more than the standard library and the C helper. Its fits run
# offline and may use the numeric packages; nothing that runs in the printer imports them.
PURE_PYTHON = "thermal"
OFFLINE = f"{PURE_PYTHON}/fit"
OFFLINE_PACKAGES = frozenset({"numpy", "scipy", "pyswarm"})

# C files that compute and nothing else (state and input in, result out), without suffix.
PURE_C = (
    *("oversample", "oversample_kernel", "phase", "guard", "filters", "wire"),
    *("simulator/plant", "simulator/plant_noise", "simulator/plant_tank", "simulator/plant_params"),
    "simulator/thermal_load",
)
FORBIDDEN_IN_PURE_C = re.compile(r"^(board/|sched\.h$|command\.h$|basecmd\.h$)")
PORTS = ("atmega2560", "stm32f334", "simulator", "template")

INCLUDE = re.compile(r'^\s*#\s*include\s*(["<])([^">]+)[">]')


@dataclass(frozen=True, slots=True)
class Offence:
    """One import or include that crosses a border."""

    path: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text}"


def layer_of(module: str) -> int | None:
    """Layer of the module whose dotted name begins so; None if it is none of klippy's."""
    first = module.partition(".")[0]
    for number, (_, names) in enumerate(LAYERS):
        if first in names:
            return number
    return None


def imported(tree: ast.Module, package: list[str]) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything a module imports, wherever in the file it does."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                yield node.lineno, f"{name}.{alias.name}" if name else alias.name


def check_python(klippy: Path) -> Iterator[Offence]:
    """Offences of all Python files below `klippy`."""
    own_modules = {p.stem for p in klippy.glob("*.py")} | {p.name for p in klippy.iterdir() if p.is_dir()}
    for path in sorted(klippy.rglob("*.py")):
        relative = path.relative_to(klippy)
        parts = list(relative.with_suffix("").parts)
        layer = layer_of(parts[0])
        if layer is None:
            yield Offence(path, 1, f"'{parts[0]}' is in no layer; give it one in scripts/check_layers.py")
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
        for line, name in imported(tree, parts[:-1]):
            yield from _check_import(path, relative, line, name, layer, own_modules)


def _check_import(
    path: Path, relative: Path, line: int, name: str, layer: int, own_modules: set[str]
) -> Iterator[Offence]:
    first = name.partition(".")[0]
    other = layer_of(name) if first in own_modules else None
    if other is not None and other > layer:
        here, there = LAYERS[layer][0], LAYERS[other][0]
        yield Offence(path, line, f"layer '{here}' imports {name} of the higher layer '{there}'")
    offline = relative.as_posix().startswith(OFFLINE)
    foreign = first not in own_modules and first not in sys.stdlib_module_names
    if relative.parts[0] == PURE_PYTHON and foreign and not (offline and first in OFFLINE_PACKAGES):
        yield Offence(path, line, f"{PURE_PYTHON}/ uses only the standard library, not {first}")
    if not offline and name.replace(".", "/").startswith(OFFLINE):
        yield Offence(path, line, f"{name} is for offline use; what runs in the printer may not need it")


def check_c(src: Path) -> Iterator[Offence]:
    """Offences of all C files below `src`."""
    for path in sorted([*src.rglob("*.c"), *src.rglob("*.h")]):
        relative = path.relative_to(src)
        pure = relative.with_suffix("").as_posix() in PURE_C
        for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            match = INCLUDE.match(text)
            if match:
                yield from _check_include(path, relative, line, match.group(2), pure)


def _check_include(path: Path, relative: Path, line: int, included: str, pure: bool) -> Iterator[Offence]:
    if pure and FORBIDDEN_IN_PURE_C.match(included):
        yield Offence(path, line, f"a pure file may not know {included}")
    port = included.partition("/")[0]
    if port in PORTS and "/" in included and relative.parts[0] != port:
        yield Offence(path, line, f"{included} belongs to the port {port}, which only that port may know")


def main() -> int:
    offences = [*check_python(ROOT / "klippy"), *check_c(ROOT / "src")]
    for offence in offences:
        print(offence)
    return 1 if offences else 0


if __name__ == "__main__":
    sys.exit(main())
