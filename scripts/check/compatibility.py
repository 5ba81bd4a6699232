#!/usr/bin/env python3
"""Makes docs/reference/Compatibility.md: what Klipper's reference pages name, here or not.

    scripts/check/compatibility.py            writes the page
    scripts/check/compatibility.py --check    compares it; exit status 1 if it is out of date

The names of Klipper's pages are in klipper_names.py and klipper_options.py beside this file. A section is here if there
is a module for it or the toolhead reads it. Commands, options and fields are here if the pages of docs/reference have
them, which tests compare with the program.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "klippy"))

import configfile  # noqa: E402
import configreaders  # noqa: E402  (the path comes first)
from klipper_names import COMMANDS, SECTIONS  # noqa: E402
from klipper_options import FIELDS, OPTIONS  # noqa: E402

PAGE = ROOT / "docs" / "reference" / "Compatibility.md"
CONFIG = ROOT / "docs" / "reference" / "Config_Reference.md"
STATUS = ROOT / "docs" / "reference" / "Status_Reference.md"
G_CODES = ROOT / "docs" / "reference" / "G-Codes.md"
# Sections whose options the page describes at another section, or in a sentence.
LIKE = {
    "lis2dw": ("mpu9250",),
    "lis3dh": ("lis2dw", "mpu9250"),
    "bmi160": ("lis2dw", "mpu9250"),
    "icm20948": ("mpu9250",),
    "stepper": ("stepper_a", "stepper_left", "of a tower", "of a shoulder", "of a winch"),
    "stepper_z1": ("stepper_x",),
    "extruder": ("heater_bed",),
    "extruder1": ("extruder",),
    "heater_generic": ("heater_bed",),
}
HEAD = """\
# Compatibility with Klipper

Written by `scripts/check/compatibility.py`; a test compares it with the program. Names are those of Klipper's reference
pages; options and fields of 2026 may be missing. [Config_Reference](Config_Reference.md), [G-Codes](G-Codes.md) and
[Status_Reference](Status_Reference.md) list those of this program, with what each does.
"""


def commands_here() -> set[str]:
    """Commands in the page of the program's commands."""
    return set(re.findall(r"`([A-Z][A-Z0-9_]*)`", G_CODES.read_text(encoding="utf-8")))


def options_here() -> dict[str, set[str]]:
    """Section -> options in the page of the config; also of each "Options of X", under "of X"."""
    found: dict[str, set[str]] = {}
    links: dict[str, set[str]] = {}
    name = ""
    for line in CONFIG.read_text(encoding="utf-8").splitlines():
        if match := re.match(r"#+ Options of (.*)", line):
            name = f"of {match[1]}"
        elif match := re.match(r"#? ?\[(\w+)", line):
            name = match[1]
        elif match := re.match(r"# \+ options of (.*)", line):
            links.setdefault(name, set()).add(f"of {match[1].rstrip('.')}")
        elif match := re.match(r"#?([A-Za-z]\w*):", line):
            found.setdefault(name, set()).add(match[1])
        elif match := re.search(r"ptions (\w+_)(?:NAME|ANYTHING)\b", line):
            found.setdefault(name, set()).add(f"{match[1]}NAME")

    def all_of(owner: str, seen: frozenset[str]) -> set[str]:
        parts = (all_of(link, seen | {owner}) for link in links.get(owner, ()) if link not in seen)
        return found.get(owner, set()).union(*parts)

    options = {owner: all_of(owner, frozenset()) for owner in {*found, *links}}
    for owner, others in LIKE.items():
        options[owner] = options.get(owner, set()).union(*(options.get(other, set()) for other in others))
    return options


def fields_here() -> dict[str, set[str]]:
    """Object -> words in its part of the page of status."""
    parts = re.split(r"^### (\w+)$", STATUS.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {
        name: set(re.findall(r"`(\w+)", text)) for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def by_owner(names: dict[str, list[str]], here: dict[str, set[str]]) -> list[str]:
    """A row for each section or object: how many are here, and which are missing."""
    lines = ["| | here | missing |", "|---|---|---|"]
    for owner, wanted in names.items():
        missing = [name for name in wanted if name not in here.get(owner, ())]
        texts = " ".join(f"`{name}`" for name in missing)
        lines.append(f"| `{owner}` | {len(wanted) - len(missing)} of {len(wanted)} | {texts} |")
    return lines


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
        or name in configreaders.READ_BY
        or configreaders.is_read_last(name)
        or name == "stepper"
    }
    lines = [HEAD, "## Sections", "", *table(SECTIONS, sections), "", "## Commands", ""]
    lines += table(COMMANDS, commands_here())
    lines += ["", "## Options", "", "Of the sections that are here.", "", *by_owner(OPTIONS, options_here())]
    lines += ["", "## Status fields", "", *by_owner(FIELDS, fields_here())]
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
