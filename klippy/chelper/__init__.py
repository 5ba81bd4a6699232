"""The C helper: compiles the host's C files into one shared library when stale and loads it through cffi.

The C files of motion and link are below this folder, those of the thermal chain beside their Python in klippy/thermal/.
Every C file NAME.c may come with NAME.cdef, the declarations Python may use; all of them are concatenated, so rooms
can add files without touching each other's. The library is named after a hash of everything that goes into it, so an
unchanged tree never compiles and two trees never mix.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cffi

HOST_DIR = Path(__file__).resolve().parents[1]
SOURCE_DIRS = (HOST_DIR / "chelper", HOST_DIR / "thermal")
BUILD_DIR = HOST_DIR.parent / "out" / "chelper"
# -fno-math-errno: sqrt() inline in the step solver. Kept strict otherwise: results must not depend on the machine.
COMPILE_FLAGS = (
    "-std=gnu11",
    "-O2",
    "-g",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-ffp-contract=off",
    "-Wall",
    "-Wextra",
)
LINK_FLAGS = ("-lm", "-lpthread")


class HelperError(Exception):
    """The helper library could not be built or loaded; the text is for people."""


def _files(*suffixes: str) -> list[Path]:
    return sorted(p for folder in SOURCE_DIRS for p in folder.rglob("*") if p.suffix in suffixes)


def _content_hash() -> str:
    digest = hashlib.sha256(" ".join(COMPILE_FLAGS + LINK_FLAGS).encode())
    for path in _files(".c", ".h", ".cdef"):
        digest.update(str(path.relative_to(HOST_DIR)).encode() + b"\0" + path.read_bytes() + b"\0")
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


def _compile(target: Path) -> None:
    """Compile beside the target and rename, so that two processes starting at once do no harm."""
    compiler = os.environ.get("CC", "gcc")
    handle, scratch_name = tempfile.mkstemp(suffix=".so", dir=target.parent)
    os.close(handle)
    scratch = Path(scratch_name)
    command = [
        compiler,
        *COMPILE_FLAGS,
        f"-I{HOST_DIR}",
        "-o",
        str(scratch),
        *map(str, _files(".c")),
        *LINK_FLAGS,
    ]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise HelperError(f"The C helper in {HOST_DIR} does not compile:\n{result.stderr.strip()}")
        scratch.chmod(0o755)
        scratch.replace(target)
    except FileNotFoundError:
        raise HelperError(
            f"The host needs the C compiler '{compiler}' once, to build its helper library, and it is not installed. "
            "On Debian: sudo apt-get install gcc libc6-dev. Another compiler can be named in the variable CC."
        ) from None
    finally:
        scratch.unlink(missing_ok=True)


def _remove_outdated(directory: Path) -> None:
    """Drop libraries older than an hour (another host may be about to load a younger one)."""
    limit = time.time() - 3600.0
    for old in directory.glob("c_helper-*.so"):
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


_lock = threading.Lock()
_loaded: tuple[Any, Any] | None = None


def get_ffi() -> tuple[Any, Any]:
    """(ffi, lib) of the helper, built and loaded at the first call. Raises HelperError."""
    global _loaded
    if _loaded is not None:
        return _loaded
    with _lock:
        if _loaded is None:
            path = build()
            ffi = cffi.FFI()
            ffi.cdef("\n".join(p.read_text() for p in _files(".cdef")))
            _loaded = (ffi, ffi.dlopen(str(path)))
        return _loaded
