#!/usr/bin/env python3
"""Checks that no file of the project names a place on somebody's machine: a home directory, or this checkout.

Looks at what git would commit: tracked files and untracked ones that are not ignored.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

HOMES = (r"/home/(?!pi\b|USER\b)\w+", r"/Users/\w+", "/root")
SHARED_FOLDERS = {
    Path(p) for p in ("/", "/home", "/tmp", "/var/tmp", "/opt", "/usr", "/usr/src", "/srv", "/mnt")
}


def private_places() -> re.Pattern[str]:
    """Matches absolute paths into a home, into this checkout or into the folder it stands in."""
    here = [re.escape(str(p)) for p in (ROOT, ROOT.parent) if p not in SHARED_FOLDERS]
    return re.compile(rf"(?<![\w.~}})/-])(?:{'|'.join([*HOMES, *here])})(?:/|(?=[\s\"'`)]|$))")


def project_files() -> list[Path]:
    """Files git knows or would add."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    if listed.returncode != 0:
        sys.exit(f"check_paths: git cannot list the project's files: {listed.stderr.decode().strip()}")
    names = listed.stdout.decode().split("\0")
    return [ROOT / name for name in names if name and (ROOT / name).is_file()]


def offences(path: Path, places: re.Pattern[str]) -> Iterator[str]:
    """One line of text for each line of the file that names a private place."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return  # pictures and other binary files
    for number, line in enumerate(text.splitlines(), 1):
        if places.search(line):
            yield f"{path}:{number}: names a place on one machine: {line.strip()[:100]}"


def main() -> int:
    places = private_places()
    this = Path(__file__).resolve()
    found = [text for path in project_files() if path != this for text in offences(path, places)]
    for text in found:
        print(text)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
