#!/usr/bin/env python3
"""Checks who may know whom: layers and rooms of klippy/, import circles, and the borders between the rooms of src/.

Python: a file of klippy/ imports only from its own layer or a lower one, so that what decides can be tested
without what acts. Within klippy/thermal/ the same holds for its rooms. No two files import each other, not even in a
function or for type checking. Nothing outside test/ imports test/. C: the pure files know no board, nothing but a
port knows that port, and src/ does not know klippy/. Folders: none holds too many files. The rules are the tables
below; an offence is printed as file:line and the exit status is 1.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# Lowest layer first. A name is a module, or a package with all it holds.
LAYERS: tuple[tuple[str, frozenset[str]], ...] = tuple(
    (name, frozenset(modules.split()))
    for name, modules in (
        ("helper", "chelper"),
        ("thermal", "thermal vibration"),
        (
            "base",
            "util queuelogger reactor roles configreaders configtext configfile"
            " gcode_command gcode_waits gcode gcode_io pins msgproto",
        ),
        ("link", "link serialhdl clocksync mcu"),
        ("motion", "motionlimits stepper stepstream kinematics lookahead toolhead"),
        ("extras", "extras"),
        ("app", "webhooks printer klippy parsedump"),
        ("simulation", "simulation"),
    )
)
# Rooms of thermal/, lowest first; those of one entry do not know each other.
ROOMS: tuple[tuple[str, ...], ...] = (
    ("records",),
    ("models",),
    ("sensing",),
    ("drift",),
    ("control",),
    ("identification", "plan", "recording"),
)

# thermal/ computes and nothing else: it needs no more than the standard library and the C helper. Its fits run
# offline and may use the numeric packages; nothing that runs in the printer imports them.
PURE_PYTHON = "thermal"
OFFLINE = f"{PURE_PYTHON}/identification/fit"
OFFLINE_PACKAGES = frozenset({"numpy", "scipy", "pyswarm"})

# C files that compute and nothing else (state and input in, result out), without suffix.
PURE_C = (
    "oversample",
    "oversample_kernel",
    "phase",
    "guard",
    "signal_test",
    "block_record",
    "filters",
    "wire",
)
FORBIDDEN_IN_PURE_C = re.compile(r"^(board/|sched\.h$|command\.h$|basecmd\.h$)")
PORTS = ("atmega2560", "stm32f334", "simulator", "template")
# What the simulated world and the emulators may take from src/.
WORLD_MAY_INCLUDE = "sim_mcu.h"

# How many files a folder may hold, its folders apart. A file of src/ or extras/ has the name of what it declares;
# recorded runs are data.
FILES_MAX = 25
LARGE_FOLDERS = frozenset({"src", "klippy/extras", "test/data/runs"})

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


def room_of(module: str) -> int | None:
    """Number in ROOMS of the room of thermal/ that a dotted name lies in; None outside of them."""
    parts = module.split(".")
    if parts[0] != PURE_PYTHON or len(parts) < 2:
        return None
    return next((number for number, names in enumerate(ROOMS) if parts[1] in names), None)


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


@dataclass(frozen=True, slots=True)
class Module:
    """A Python file by its dotted name, and what it imports: line and dotted name."""

    name: str
    path: Path
    imports: tuple[tuple[int, str], ...]


def read_modules(root: Path, paths: Iterable[Path]) -> dict[str, Module]:
    """The modules of a folder by dotted name; a package has the name of its folder."""
    modules = {}
    for path in paths:
        parts = list(path.relative_to(root).with_suffix("").parts)
        package = parts[:-1]
        if parts[-1] == "__init__":
            parts = package
        if not parts:
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
        name = ".".join(parts)
        modules[name] = Module(name, path, tuple(imported(tree, package)))
    return modules


def check_python(klippy: Path) -> Iterator[Offence]:
    """Offences of all Python files below `klippy`."""
    modules = read_modules(klippy, sorted(klippy.rglob("*.py")))
    own = {name.partition(".")[0] for name in modules}
    for module in modules.values():
        first = module.name.partition(".")[0]
        layer = layer_of(first)
        if layer is None:
            yield Offence(module.path, 1, f"'{first}' is in no layer; give it one in {Path(__file__).name}")
            continue
        if first == PURE_PYTHON and "." in module.name and room_of(module.name) is None:
            yield Offence(
                module.path, 1, f"'{module.name}' is in no room; give it one in {Path(__file__).name}"
            )
        for line, name in module.imports:
            yield from _check_import(module, line, name, layer, own)
    yield from find_circles(modules)


def _check_import(module: Module, line: int, name: str, layer: int, own: set[str]) -> Iterator[Offence]:
    path, first = module.path, name.partition(".")[0]
    other = layer_of(name) if first in own else None
    if other is not None and other > layer:
        here, there = LAYERS[layer][0], LAYERS[other][0]
        yield Offence(path, line, f"layer '{here}' imports {name} of the higher layer '{there}'")
    room, target = room_of(module.name), room_of(name)
    if room is not None and target is not None and (target > room or _are_neighbours(module.name, name)):
        here, there = module.name.split(".")[1], name.split(".")[1]
        yield Offence(path, line, f"room '{here}' of {PURE_PYTHON}/ may not import from '{there}'")
    offline = module.name.replace(".", "/").startswith(OFFLINE)
    foreign = first not in own and first not in sys.stdlib_module_names
    if module.name.startswith(f"{PURE_PYTHON}.") and foreign and not (offline and first in OFFLINE_PACKAGES):
        yield Offence(path, line, f"{PURE_PYTHON}/ uses only the standard library, not {first}")
    if not offline and name.replace(".", "/").startswith(OFFLINE):
        yield Offence(path, line, f"{name} is for offline use; what runs in the printer may not need it")


def _are_neighbours(one: str, other: str) -> bool:
    """Different rooms of one rank."""
    return room_of(one) == room_of(other) and one.split(".")[1] != other.split(".")[1]


def find_circles(modules: Mapping[str, Module]) -> Iterator[Offence]:
    """Each group of modules that import one another, once, at the first module's first such import."""
    targets = {name: dict(_targets(module, modules)) for name, module in modules.items()}
    reach: dict[str, set[str]] = {name: _reachable(name, targets) for name in modules}
    done: set[str] = set()
    for name in sorted(modules):
        circle = sorted(other for other in reach[name] if name in reach[other])
        if name in done or name not in reach[name]:
            continue
        done.update(circle)
        line = min(line for other, line in targets[name].items() if other in circle)
        yield Offence(modules[name].path, line, f"these import one another: {', '.join(circle)}")


def _targets(module: Module, modules: Mapping[str, Module]) -> Iterator[tuple[str, int]]:
    """Other modules that one imports, with the line; `from a import b` is a.b where there is such a module, else a."""
    for line, name in reversed(module.imports):
        target = name
        while target and target not in modules:
            target = target.rpartition(".")[0]
        if target and target != module.name:
            yield target, line


def _reachable(start: str, targets: Mapping[str, Mapping[str, int]]) -> set[str]:
    found: set[str] = set()
    waiting = [start]
    while waiting:
        for target in targets[waiting.pop()]:
            if target not in found:
                found.add(target)
                waiting.append(target)
    return found


def check_tests_stay_apart(root: Path) -> Iterator[Offence]:
    """Imports of a test or of a file beside the tests by anything else."""
    tests = {path.stem for path in (root / "test").rglob("*.py")} | {"test"}
    tests |= {path.name for path in (root / "test").iterdir() if path.is_dir()}
    product = [*(root / "klippy").rglob("*.py"), *(root / "scripts").rglob("*.py")]
    own = {path.stem for path in product} | {path.name for path in root.glob("klippy/*/")}
    for path in product:
        tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
        for line, name in imported(tree, ["."]):
            first = name.partition(".")[0]
            if first in tests - own - sys.stdlib_module_names:
                yield Offence(path, line, f"{name} belongs to the tests, which nothing else may import")


def check_c(src: Path) -> Iterator[Offence]:
    """Offences of all C files below `src`."""
    for path in sorted([*src.rglob("*.c"), *src.rglob("*.h")]):
        relative = path.relative_to(src)
        pure = relative.with_suffix("").as_posix() in PURE_C
        for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            match = INCLUDE.match(text)
            if match:
                yield from _check_include(path, relative, line, match.group(2), pure)
            elif "klippy/" in text:
                yield Offence(path, line, "the firmware may not know the host")


def _check_include(path: Path, relative: Path, line: int, included: str, pure: bool) -> Iterator[Offence]:
    if pure and FORBIDDEN_IN_PURE_C.match(included):
        yield Offence(path, line, f"a pure file may not know {included}")
    port = included.partition("/")[0]
    if port in PORTS and "/" in included and relative.parts[0] != port:
        yield Offence(path, line, f"{included} belongs to the port {port}, which only that port may know")


def check_world(simulation: Path, src: Path) -> Iterator[Offence]:
    """Headers of the firmware that the simulated world or an emulator includes beside the one it may."""
    headers = {path.name for path in src.rglob("*.h")} - {path.name for path in simulation.rglob("*.h")}
    for path in sorted([*simulation.rglob("*.c"), *simulation.rglob("*.h")]):
        for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            match = INCLUDE.match(text)
            name = Path(match.group(2)).name if match else ""
            if match and match.group(1) == '"' and name in headers and name != WORLD_MAY_INCLUDE:
                yield Offence(
                    path, line, f"takes {match.group(2)} from src/; {WORLD_MAY_INCLUDE} is the one to take"
                )


def check_tables() -> Iterator[Offence]:
    """Names in the tables above that no file has any more."""
    here = Path(__file__)
    klippy = {path.stem for path in (ROOT / "klippy").iterdir()}
    for _, names in LAYERS:
        for name in sorted(names - klippy):
            yield Offence(here, 1, f"klippy/ has no {name}")
    rooms = {path.stem for path in (ROOT / "klippy" / PURE_PYTHON).iterdir()}
    for name in sorted({room for names in ROOMS for room in names} - rooms):
        yield Offence(here, 1, f"klippy/{PURE_PYTHON}/ has no {name}")
    for name in PURE_C:
        if not list((ROOT / "src").glob(f"{name}.[ch]")):
            yield Offence(here, 1, f"src/ has no {name}")


def project_files(root: Path) -> list[str]:
    """What git would commit, relative to `root`."""
    command = ["git", "ls-files", "-co", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.splitlines() if (root / name).exists()]


def check_every_c_file_is_built(root: Path, built: Iterable[str]) -> Iterator[Offence]:
    """C files under git that no build rule names. `built`: the files that the rules name, relative to `root`."""
    for name in sorted({*project_files(root)} - {*built}):
        if name.endswith(".c") and not name.startswith("test/"):
            yield Offence(Path(name), 1, "no build rule names this file")


def check_folders(names: Iterable[str]) -> Iterator[Offence]:
    """Folders that hold too many files of their own. `names`: all files of the project."""
    counts = Counter(Path(name).parent for name in names)
    for folder, count in sorted(counts.items()):
        if count > FILES_MAX and folder.as_posix() not in LARGE_FOLDERS:
            yield Offence(folder, 1, f"holds {count} files, more than {FILES_MAX}: part it by subject")


def main(arguments: list[str]) -> int:
    """`arguments`: the C files that the build rules name."""
    offences = [
        *check_python(ROOT / "klippy"),
        *check_tests_stay_apart(ROOT),
        *check_c(ROOT / "src"),
        *check_world(ROOT / "klippy" / "simulation", ROOT / "src"),
        *check_tables(),
        *check_folders(project_files(ROOT)),
        *(check_every_c_file_is_built(ROOT, arguments) if arguments else ()),
    ]
    for offence in offences:
        print(offence)
    return 1 if offences else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
