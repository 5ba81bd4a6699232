#!/usr/bin/env python3
"""Checks the words: the field's terms instead of private ones, and short sentences in the documentation.

TERMS has what to write and what it replaces. A page of Markdown is checked without its inline code, since names
of options and commands are the program's. In a file of code, comments and all names are checked, the file's own
included: parts of snake_case and CamelCase names are words. ORDINARY has the phrases in which such a word is plain
English, DOCUMENTED the rooms in which it is a documented name.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from check_paths import ROOT, project_files

# Folders and files, from the top of the project.
ROOMS_CHECKED = (
    *("docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"),
    *("klippy", "src", "config", "test", "scripts"),
)
# Rooms within them that still have private words.
ROOMS_NOT_YET = ("test/unit/project/test_checks.py", "scripts/check/check_words.py")
WORDS_A_SENTENCE = 25

# What to write, and a pattern of what not to write.
TERMS: tuple[tuple[str, str], ...] = (
    ("steady state, report deadband", r"calm\w*"),
    ("batch, many", r"lots?"),
    ("set point, request", r"wish(?:es|ed)?|(?:an|the|each) ask|asks? (?:of|from) the"),
    ("identification run, step test", r"drills?"),
    ("deposited", r"laid|lays?|laying"),
    ("sent, reported, announced, said", r"told|untold|tells?|telling"),
    ("last received, last valid", r"heard|unheard|believ\w+|beliefs?"),
    ("plan options", r"crafts?"),
    ("min, max", r"least|most"),
    ("change detector (EWMA)", r"attention"),
    ("deadband exceeded", r"stray(?:s|ed|ing)?"),
    ("acquire, release, in calibration", r"borrow\w*|lent|lends?|lending|giv(?:es?|en|ing) back|seats?"),
    ("step buffers", r"desks?"),
    ("neighbouring stack", r"piles?"),
    ("two-period control", r"practical"),
    ("predictive control", r"model law"),
    ("sensing pipeline", r"block ?chains?"),
    ("heat-balance monitor", r"plausible"),
    ("temperature Kalman filter", r"(?:nozzle ?)?track"),
    ("proportional band, time constant, prediction horizon", r"knees?|fad(?:es?|ed|ing)|aim(?:s|ed|ing)?"),
    ("minimum layer time, speed factor", r"paces?"),
    ("phase signal, signal units", r"error units"),
    ("interval, term", r"spells?"),
    ("record, account", r"books?"),
    ("a key of docs/References.md", r"(?:sources?|seed) ?00\d"),
)

# Words of documented names, and the rooms that need them: options of [bed_mesh], names of earlier versions.
DOCUMENTED: tuple[tuple[str, str], ...] = (
    (
        r"fad(?:es?|ed|ing)",
        """klippy/extras/bed_mesh klippy/extras/probing/surface_fit.py klippy/chelper/motion/path_stage.c
        klippy/chelper/motion/path_stage.h config/example-probe.cfg test/klippy/bed_mesh.test
        test/loop/test_bed_mesh.py test/unit/motion/test_meshmath.py scripts/check/klipper_options.py""",
    ),
    (r"practical", "klippy/configtext.py test/unit/host/test_configfile.py"),
)

# Phrases in which these words are plain English.
ORDINARY = (
    "at least",
    "control: practical",
    "at most",
    "least squares",
    "most of",
    "mostly",
    "most significant",
    "most common",
    "most plastics",
    "keep track",
    "bed mesh fade",
    "Practical Nozzle Temperature Control",
)

_ORDINARY = re.compile("|".join(rf"\b{re.escape(phrase)}\b" for phrase in ORDINARY), re.IGNORECASE)
_DOCUMENTED = [(re.compile(rf"\b(?:{word})\b", re.IGNORECASE), rooms.split()) for word, rooms in DOCUMENTED]
_TERMS = [(use, re.compile(rf"\b(?:{pattern})\b", re.IGNORECASE)) for use, pattern in TERMS]
_CODE = re.compile(r"`[^`\n]*`")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_LINK = re.compile(r"\]\([^)]*\)")
# Lines that are no running text: tables, headings, pictures, rules.
_NO_PROSE = re.compile(r"^\s*(?:\||#|!\[|---)")
_ITEM = re.compile(r"\s*(?:[-*]|\d+\.) ")
_WORD = re.compile(r"[^\W_][\w.,%°/–−-]*")
_SENTENCE_END = re.compile(r"(?<=[.!?:;])\s+(?=[A-Z`\[(*\"0-9])")


def is_within(path: Path, rooms: Iterable[str]) -> bool:
    return any(path.is_relative_to(ROOT / room) for room in rooms)


def plain(path: Path, line: str) -> str:
    """A line without what is not to be judged."""
    if path.suffix == ".md":
        return _ORDINARY.sub("", _LINK.sub("]", _CODE.sub("X", line)))
    line = _ORDINARY.sub("", _CAMEL.sub(" ", line.replace("_", " ")))
    for pattern, rooms in _DOCUMENTED:
        if is_within(path, rooms):
            line = pattern.sub("", line)
    return line


def words(path: Path, lines: list[str]) -> Iterator[str]:
    """An offence for each private word."""
    for number, line in enumerate(lines, 1):
        text = plain(path, line)
        for use, pattern in _TERMS:
            for match in pattern.finditer(text):
                yield f"{path}:{number}: '{match[0]}': write '{use}' (or add a phrase to ORDINARY)"


def paragraphs(lines: list[str]) -> Iterator[tuple[int, str]]:
    """(line it begins at, text) of each paragraph and list item of a page."""
    start, text, fenced = 0, "", False
    for number, line in enumerate([*lines, ""], 1):
        fence = line.lstrip().startswith("```")
        fenced ^= fence
        item = _ITEM.match(line)
        prose = bool(line.strip()) and not (fenced or fence or _NO_PROSE.match(line))
        if text and (item or not prose):
            yield start, text
            text = ""
        if prose and (text or item or not line.startswith("    ")):  # four blanks: a block of code
            start = start if text else number
            text += " " + (line[item.end() :] if item else line.strip())


def sentences(path: Path, lines: list[str]) -> Iterator[str]:
    """An offence for each long sentence of a page; code and a link count as one word each."""
    for number, text in paragraphs(lines):
        short = re.sub(r"\[[^\]]*\]", "X", _LINK.sub("]", _CODE.sub("X", text)))
        for sentence in _SENTENCE_END.split(short):
            count = len(_WORD.findall(sentence))
            if count > WORDS_A_SENTENCE:
                start = sentence[:60].strip()
                yield f"{path}:{number}: {count} words in a sentence (max {WORDS_A_SENTENCE}): {start}..."


def offences(path: Path) -> Iterator[str]:
    """All that is wrong with a file."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        return  # pictures
    yield from words(path, lines)
    if path.suffix == ".md":
        yield from sentences(path, lines)
    else:
        yield from words(path, [path.stem])


def main() -> int:
    files = [p for p in project_files() if is_within(p, ROOMS_CHECKED) and not is_within(p, ROOMS_NOT_YET)]
    found = [text for path in files for text in offences(path)]
    for text in found:
        print(text)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
