"""The C helper: compiles the host's C files into one shared library when stale and loads it through cffi.

The C files of motion and link are below this folder, the others beside their Python in thermal/ and vibration/.
helper_api.h includes the headers that Python sees. cffi's form of them is made with the library and lies beside it.
Both are named after a hash of all that goes into them: an unchanged tree never compiles, and two trees never mix.
"""

from __future__ import annotations

import hashlib
import os
import runpy
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cffi

from .compiler import HelperError, read_headers, run_compiler

__all__ = ["HelperError", "build", "get_ffi"]

HOST_DIR = Path(__file__).resolve().parents[1]
SOURCE_DIRS = (HOST_DIR / "chelper", HOST_DIR / "thermal", HOST_DIR / "vibration")
API_HEADER = "chelper/helper_api.h"
BUILD_DIR = HOST_DIR.parent / "out" / "chelper"
# -fno-math-errno: sqrt() inline in the step solver. Kept strict otherwise: results must not depend on the machine.
COMPILE_FLAGS = (
    "-std=gnu11",
    "-O2",
    "-g",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-fno-semantic-interposition",
    "-ffp-contract=off",
    "-Wall",
    "-Wextra",
)
LINK_FLAGS = ("-lm", "-lpthread")


def _files(*suffixes: str) -> list[Path]:
    return sorted(p for folder in SOURCE_DIRS for p in folder.rglob("*") if p.suffix in suffixes)


def _content_hash() -> str:
    digest = hashlib.sha256(" ".join((*COMPILE_FLAGS, *LINK_FLAGS, cffi.__version__)).encode())
    for path in _files(".c", ".h"):
        digest.update(str(path.relative_to(HOST_DIR)).encode() + b"\0" + path.read_bytes() + b"\0")
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _writable_build_dir() -> Path:
    """out/chelper, or a private cache directory if the tree is read-only."""
    try:
        BUILD_DIR.mkdir(parents=True, exist_ok=True)
        if os.access(BUILD_DIR, os.W_OK):
            return BUILD_DIR
    except OSError:
        pass
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ferrite" / "chelper"
    cache.mkdir(parents=True, exist_ok=True)
    return cache


def _structures(ffi: Any) -> dict[str, list[str]]:
    """Fields of every structure of which more than the name is declared."""
    fields = {name: ffi.typeof(f"struct {name}").fields for name in ffi.list_types()[1]}
    return {f"struct {name}": [field for field, _ in rows] for name, rows in fields.items() if rows}


def _compile(target: Path) -> None:
    """Library and declarations, made elsewhere and moved, so that two processes starting at once do no harm.

    The library holds the layout that the C compiler gave every structure: sizes and places of fields, for _load.
    """
    ffi = cffi.FFI()
    ffi.cdef(read_headers([Path(API_HEADER)], f"-I{HOST_DIR}") + "extern const uint32_t chelper_layout[];")
    ffi.set_source(target.stem, None, compiler_verbose=0)
    structures = _structures(ffi)
    layout = [
        expression
        for name, fields in structures.items()
        for expression in (f"sizeof({name})", *(f"offsetof({name}, {field})" for field in fields))
    ]
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        library, declarations, table = (Path(scratch, f"helper.{suffix}") for suffix in ("so", "py", "c"))
        ffi.emit_python_code(str(declarations))
        with declarations.open("a") as text:
            print(f"structures = {structures}", file=text)
        table.write_text(
            f'#include <stddef.h>\n#include <stdint.h>\n#include "{API_HEADER}"\n'
            f"const uint32_t chelper_layout[] = {{{', '.join(layout)}}};\n"
        )
        files = map(str, (table, *_files(".c")))
        run_compiler(
            [*COMPILE_FLAGS, f"-I{HOST_DIR}", "-o", str(library), *files, *LINK_FLAGS],
            f"The C helper in {HOST_DIR}",
        )
        declarations.replace(target.with_suffix(".py"))
        library.replace(target)


def _remove_outdated(directory: Path) -> None:
    """Drop libraries older than an hour (another host may be about to load a younger one)."""
    limit = time.time() - 3600.0
    for old in directory.glob("c_helper-*"):
        try:
            if old.stat().st_mtime < limit:
                old.unlink()  # a process that still uses it keeps its mapping
        except OSError:
            continue


def build() -> Path:
    """Path of an up-to-date library; compiles it first if there is none. Raises HelperError."""
    name = f"c_helper-{_content_hash()}.so"
    existing = BUILD_DIR / name
    if existing.exists():
        return existing
    directory = _writable_build_dir()
    target = directory / name
    if not target.exists():
        _compile(target)
        _remove_outdated(directory)
    return target


def _load(path: Path) -> tuple[Any, Any]:
    made = runpy.run_path(str(path.with_suffix(".py")))
    ffi, structures = made["ffi"], made["structures"]
    lib = ffi.dlopen(str(path))
    layout = iter(lib.chelper_layout[0 : sum(1 + len(fields) for fields in structures.values())])
    for name, fields in structures.items():
        here = [ffi.sizeof(name), *(ffi.offsetof(name, field) for field in fields)]
        there = [next(layout) for _ in here]
        if here != there:
            raise HelperError(
                f"{path.name} does not fit its declarations: the size of {name} and the places of "
                f"{', '.join(fields)} are {there} in C and {here} in Python."
            )
    return ffi, lib


_lock = threading.Lock()
_loaded: tuple[Any, Any] | None = None


def get_ffi() -> tuple[Any, Any]:
    """(ffi, lib) of the helper, built and loaded at the first call. Raises HelperError."""
    global _loaded
    if _loaded is not None:
        return _loaded
    with _lock:
        if _loaded is None:
            _loaded = _load(build())
        return _loaded
