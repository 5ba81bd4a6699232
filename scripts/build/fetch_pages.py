#!/usr/bin/env python3
"""Downloads the release of a web front end and unpacks it: fetch_pages.py URL FOLDER (scripts/install.sh)."""

from __future__ import annotations

import io
import shutil
import sys
import urllib.error
import urllib.request
import zipfile
from collections.abc import Sequence
from pathlib import Path

TIMEOUT_S = 60.0


def fetch(url: str, folder: Path) -> None:
    """All or nothing: the folder is there afterwards if the release was whole."""
    with urllib.request.urlopen(url, timeout=TIMEOUT_S) as answer:
        data = answer.read()
    half = folder.with_name(f"{folder.name}.new")
    shutil.rmtree(half, ignore_errors=True)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if "index.html" not in archive.namelist():
            raise zipfile.BadZipFile("it has no index.html")
        archive.extractall(half)
    half.rename(folder)


def main(argv: Sequence[str]) -> int:
    url, folder = argv
    try:
        fetch(url, Path(folder))
    except (OSError, zipfile.BadZipFile) as e:
        reason = (
            e.reason
            if isinstance(e, urllib.error.URLError) and not isinstance(e, urllib.error.HTTPError)
            else e
        )
        print(f"install: {url} could not be downloaded: {reason}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
