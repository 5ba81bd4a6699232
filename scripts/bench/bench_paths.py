"""Imported first by the benches: puts the product, the programs and the rigs on the path, then enters .venv."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
for _folder in ("klippy", "scripts", "scripts/bench", "scripts/bench/rigs"):
    if str(ROOT / _folder) not in sys.path:
        sys.path.append(str(ROOT / _folder))

import in_venv  # noqa: E402, F401
