#!/usr/bin/env python3
"""Makes docs/reference/Compatibility.md: the sections and commands of Klipper's reference pages, here or not.

    scripts/check/compatibility.py            writes the page
    scripts/check/compatibility.py --check    compares it; exit status 1 if it is out of date

The names of Klipper's pages are in scripts/check/klipper_names.py. A section is here if there is a module for it or the
toolhead reads it; a command is here if docs/reference/G-Codes.md has it, which tests compare with the program.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "klippy"))

import configabsent  # noqa: E402  (the path comes first)
import configfile  # noqa: E402
from klipper_names import COMMANDS, SECTIONS  # noqa: E402

PAGE = ROOT / "docs" / "reference" / "Compatibility.md"
G_CODES = ROOT / "docs" / "reference" / "G-Codes.md"
HEAD = """\
# Compatibility with Klipper

Written by `scripts/check/compatibility.py`; a test compares it with the program. Names are those of Klipper's reference
pages of summer 2026. Options and status fields have no table yet: [Config_Reference](Config_Reference.md) and
[Status_Reference](Status_Reference.md) list those of this program.

A section that is missing does not stop the printer ([why](Config_Reference.md#sections-of-klipper-that-are-missing)).
"""


def commands_here() -> set[str]:
    """Commands in the page of the program's commands."""
    return set(re.findall(r"`([A-Z][A-Z0-9_]*)`", G_CODES.read_text(encoding="utf-8")))


def table(names: Iterable[str], here: Iterable[str]) -> list[str]:
    """Two lists: what is here, what is not."""
    present = set(here)
    lists = {"here": sorted(set(names) & present), "missing": sorted(set(names) - present)}
    lines = ["| | count | |", "|---|---|---|"]
    for state, found in lists.items():
        lines.append(f"| {state} | {len(found)} | {' '.join(f'`{name}`' for name in found)} |")
    return lines


def page() -> str:
    """The text of the page."""
    modules = configfile.section_modules()
    sections = {
        name
        for name in SECTIONS
        if name in modules
        or name in configabsent.READ_BY
        or configabsent.is_read_last(name)
        or name == "stepper"
    }
    lines = [HEAD, "## Sections", "", *table(SECTIONS, sections), "", "## Commands", ""]
    lines += table(COMMANDS, commands_here())
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare only")
    args = parser.parse_args(argv)
    text = page()
    if not args.check:
        PAGE.write_text(text, encoding="utf-8")
    elif not PAGE.exists() or PAGE.read_text(encoding="utf-8") != text:
        print(f"{PAGE}: out of date; run scripts/check/compatibility.py", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
