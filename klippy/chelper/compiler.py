"""The C compiler: running it, and reading headers for cffi with its preprocessor."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterable
from pathlib import Path

_MARKER = re.compile(r'# \d+ "[^"]*"(?P<flags>[ \d]*)$')
_SYSTEM_HEADER = "3"
_BLOCK = r"\{[^{}]*\}"
for _ in range(3):  # three levels of braces within braces
    _BLOCK = rf"\{{(?:[^{{}}]|{_BLOCK})*\}}"
# Inline functions, which no library exports; attributes; `const` of a number, which cffi wants to know beforehand.
_NOT_FOR_CFFI = re.compile(
    rf'static inline [^{{;]*{_BLOCK}|__attribute__\(\(visibility\("default"\)\)\)|(?<=extern )const (?=\w+ \w+;)'
)


class HelperError(Exception):
    """The helper library could not be built or loaded; the text is for people."""


def run_compiler(arguments: Iterable[str], what: str, source: str = "") -> str:
    """What the C compiler prints. `source` is its standard input. Raises HelperError."""
    compiler = os.environ.get("CC", "gcc")
    try:
        done = subprocess.run(
            [compiler, *arguments], input=source, capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        raise HelperError(
            f"The host needs the C compiler '{compiler}' once, to build its helper library, and it is not installed. "
            "On Debian: sudo apt-get install gcc libc6-dev. Another compiler can be named in the variable CC."
        ) from None
    if done.returncode:
        raise HelperError(f"{what} does not compile:\n{done.stderr.strip()}")
    return done.stdout


def read_headers(headers: Iterable[Path], *flags: str) -> str:
    """The declarations of headers and of those they include, without system headers and inline functions."""
    includes = "".join(f'#include "{header}"\n' for header in headers)
    kept, in_system_header = [], False
    for line in run_compiler(
        ["-E", *flags, "-x", "c", "-"], f"A header of {includes}", includes
    ).splitlines():
        if marker := _MARKER.match(line):
            in_system_header = _SYSTEM_HEADER in marker["flags"].split()
        elif not in_system_header and not line.startswith("#"):
            kept.append(line)
    return _NOT_FOR_CFFI.sub("", "\n".join(kept))
