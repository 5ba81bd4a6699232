"""docs/reference/Config_Reference.md and the program have the same options; the config blocks of all pages load."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from doc_rig import DOCS, HOST, Block, Loaded, config_blocks, load, read_page, string_constants

PAGE = "Config_Reference.md"
PIN = re.compile(r"\bP[A-H]\d+\b")

# A machine to put the blocks on. Its pins are on a board of its own: those of the blocks are free.
BASE = """
[mcu]
serial: /tmp/none
[mcu board]
serial: /tmp/none2
[printer]
kinematics: none
max_velocity: 300
max_accel: 3000
[extruder]
step_pin: board:PA0
dir_pin: board:PA1
microsteps: 16
rotation_distance: 7.6
nozzle_diameter: 0.4
filament_diameter: 1.75
heater: nozzle
[induction_heater nozzle]
sense_pin: board:PA2
max_temp: 300
"""

# Sections that only tests, simulations or other sections read.
ELSEWHERE = ("simulator",)
# Not sections, but what the sensor types MAX* and boards on a CAN bus load.
INTERNAL = {"canbus_stats", "motion_queuing", "spi_temperature"}
# Whose names are put together in the code; config/sim-induction.cfg has them, and loads.
COMPOSED = ("tank_",)


def groups() -> dict[str, Block]:
    """Options that several sections share, by the words after "Options of"."""
    return {
        block.heading.lower().removeprefix("options of "): block
        for block in config_blocks(PAGE)
        if not block.section
    }


def documents() -> list[list[Block]]:
    """The sections of each fenced block of the pages."""
    found: dict[tuple[str, int], list[Block]] = {}
    for page in sorted(path.name for path in DOCS.rglob("*.md")):
        for block in config_blocks(page):
            if block.section:
                found.setdefault((page, block.fence), []).append(block)
    return list(found.values())


def included(block: Block, known: dict[str, Block]) -> list[Block]:
    """The block and the shared options it takes, the nearest first."""
    found = [block]
    for name in block.includes:
        key = re.sub(r"^an? ", "a ", name)
        assert key in known or name in known, f"{block.where}: there is no heading 'Options of {name}'"
        found += included(known.get(key) or known[name], known)
    return found


class Fresh:
    """Gives every pin of a text one of its own."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, text: str) -> str:
        def pin(match: re.Match[str]) -> str:
            number, self.count = self.count, self.count + 1
            return f"P{'ABCDEFGH'[number // 16]}{number % 16}"

        return PIN.sub(pin, text)


def config_of(blocks: list[Block], everything: bool) -> str:
    """A config with the sections of a fenced block; with `everything` the options that may be given, too."""
    known, fresh = groups(), Fresh()
    sections: dict[str, dict[str, str]] = {}
    for block in blocks:
        options = sections.setdefault(block.section, {})
        for part in included(block, known):
            for name, value in part.required.items():
                options.setdefault(name, fresh(_whole(part, name, value)))
        for part in included(block, known) if everything else ():
            for name, value in part.optional.items():
                if value and not any(name.lower() == key.lower() for key in options):
                    options[name] = fresh(value)
    text = "".join(
        f"[{name}]\n" + "".join(f"{key}: {value}\n" for key, value in options.items())
        for name, options in sections.items()
    )
    return text + _base_without(sections)


def _whole(block: Block, name: str, value: str) -> str:
    """The value with the indented lines that follow it."""
    start = next(number for number, line in enumerate(block.text) if line.startswith(f"{name}:"))
    lines = [value]
    for line in block.text[start + 1 :]:
        if not line.startswith((" ", "\t")):
            break
        lines.append(line)
    return "\n".join(lines)


def _base_without(sections: dict[str, Any]) -> str:
    """BASE without the sections a block brings itself."""
    parts = re.split(r"(?m)^(?=\[)", BASE)
    kept = [part for part in parts if part.partition("]")[0].lstrip("[") not in sections]
    return "\n" + "".join(kept)


def name_of(blocks: list[Block]) -> str:
    return f"{blocks[0].where.partition(':')[0]} {blocks[0].fence} [{blocks[0].section}]"


@pytest.fixture(scope="module", params=documents(), ids=name_of)
def document(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(sections of a fenced block, the printer it makes)."""
    blocks: list[Block] = request.param
    loaded = load(tmp_path_factory.mktemp("block"), config_of(blocks, everything=False))
    return blocks, loaded


def test_a_block_loads(document: tuple[list[Block], Loaded]) -> None:
    blocks, loaded = document
    assert loaded.message == "Printer is ready", blocks[0].where


def test_a_block_loads_with_all_it_offers(document: tuple[list[Block], Loaded], tmp_path: Path) -> None:
    blocks, _ = document
    loaded = load(tmp_path, config_of(blocks, everything=True))
    assert loaded.message == "Printer is ready", blocks[0].where


def test_a_block_names_every_option_its_section_reads(document: tuple[list[Block], Loaded]) -> None:
    blocks, loaded = document
    known = groups()
    missing = []
    for section in {block.section for block in blocks}:
        named = {
            option
            for block in config_blocks(PAGE)
            if _kind(block.section) == _kind(section) and block.section
            for part in included(block, known)
            for option in part.options
        }
        read = loaded.access.get(section.lower(), {})
        missing += [
            f"[{section}] {option}: {read[option]}" for option in read if not _is_named(option, named)
        ]
    assert not missing, f"options missing in {PAGE} ({blocks[0].where}): {missing}"


def test_a_block_reports_the_right_defaults(document: tuple[list[Block], Loaded]) -> None:
    blocks, loaded = document
    wrong = []
    for block in blocks:
        read = loaded.access.get(block.section.lower(), {})
        for part in included(block, groups()):
            for name, value in part.optional.items():
                given = name in {key for b in included(block, groups()) for key in b.required}
                if value and not given and name.lower() in read and not _same(value, read[name.lower()]):
                    wrong.append(f"[{block.section}] {name}: {value} (the program: {read[name.lower()]!r})")
    assert not wrong, f"{PAGE}: {wrong}"


def test_every_option_the_code_asks_for_by_name_is_documented() -> None:
    """Also those that are read only sometimes, which no block shows."""
    text = read_page(PAGE).lower()
    words = set(re.findall(r"[a-z_][a-z0-9_]*", text))
    missing = []
    pattern = re.compile(
        r"\b\w*config\w*\.get(?:int|float|boolean|choice|list|lists|floatlist|intlist)?\(\s*\"(\w+)\""
    )
    for path in sorted(HOST.rglob("*.py")):
        if path.stem in ELSEWHERE or "simulation" in path.parts:
            continue
        for option in pattern.findall(path.read_text(encoding="utf-8")):
            if option.lower() not in words:
                missing.append(f"{option} ({path.relative_to(HOST)})")
    assert not missing, f"options missing in {PAGE}: {sorted(set(missing))}"


def test_every_option_of_the_simulated_machine_is_in_its_page() -> None:
    page = read_page("Simulation.md")
    code = (HOST / "extras" / "simulator.py").read_text(encoding="utf-8")
    options = set(re.findall(r"\bconfig\.get\w*\(\s*\"(\w+)\"", code)) - {"simulator_parameters"}
    kinds = set(re.findall(r"\[simulator (\w+)", page))
    assert len(options) > 20
    missing = sorted(option for option in options if f"`{option}`" not in page)
    assert not missing, f"options missing in docs/reference/Simulation.md: {missing}"
    assert kinds >= set(re.findall(r'^    "(\w+)": _read_', code, re.M)), "a kind of section is missing"


def test_every_section_the_program_has_is_documented() -> None:
    text = read_page(PAGE)
    named = set(re.findall(r"\[(\w+)[\] ]|`\[?([a-z_]+)\]?`|sensor_type: (\w+)", text))
    named = {name for names in named for name in names}
    missing = [
        path.stem
        for path in sorted((HOST / "extras").glob("*.py"))
        if re.search(r"^def load_config", path.read_text(encoding="utf-8"), re.M)
        and path.stem not in named
        and path.stem not in {*ELSEWHERE, *INTERNAL}
        and not _is_internal(path)
    ]
    assert not missing, f"sections missing in {PAGE}: {missing}"


def _is_internal(path: Path) -> bool:
    """Loaded by other modules only, says its load_config."""
    text = path.read_text(encoding="utf-8")
    return bool(re.search(r"def load_config\(.*\).*:\n    \"\"\"Loaded (by|with) ", text))


def test_every_documented_option_stands_in_the_code() -> None:
    """Those with a value are tried by loading the block; here are the others."""
    texts = string_constants()
    plain = {text.lower() for text in texts if "*" not in text}
    patterns = [
        re.compile(re.escape(text.lower()).replace(r"\*", r"\w+") + "$")
        for text in texts
        if "*" in text and re.fullmatch(r"[\w*]*[a-z]{3}[\w*]*", text, re.I)
    ]
    unknown = [
        f"[{block.section or block.heading}] {option}"
        for block in config_blocks(PAGE)
        for option in (name.lower() for name, value in block.optional.items() if not value)
        if option not in plain
        and not any(pattern.match(option) for pattern in patterns)
        and not option.startswith(COMPOSED)
    ]
    assert not unknown, f"{PAGE} has options the program does not know: {unknown}"


def _kind(section: str) -> str:
    """What makes two sections the same thing: the first word; steppers with a number are those without."""
    return section.split(maxsplit=1)[0] if section else ""


def _is_named(option: str, named: set[str]) -> bool:
    """Numbered options (temperature3) and those with a name of the user's (variable_x) are named by one of them."""
    if option in named:
        return True
    if option.startswith(("variable_", "param_", "aliases")):
        return any(name.startswith(option.split("_", maxsplit=1)[0]) for name in named)
    return option.rstrip("0123456789") + "1" in named


def _same(text: str, value: Any) -> bool:
    """Whether a default in the page is the program's; lists and texts by their words."""
    try:
        return abs(float(text) - float(value)) <= 1e-9 * abs(float(value))
    except (TypeError, ValueError):
        pass
    if isinstance(value, bool):
        return text.strip().lower() in (("true", "yes", "1") if value else ("false", "no", "0"))
    if isinstance(value, tuple):
        value = ", ".join(str(item) for item in value)
    return text.strip() == str(value).strip() or isinstance(value, int)


def test_the_pages_own_reader_finds_what_is_there() -> None:
    """The checks above are worth nothing if the reader finds no blocks."""
    sections = {block.section for block in config_blocks(PAGE)}
    assert {"mcu", "printer", "extruder", "heater_bed", "fan", "gcode_macro HELLO"} <= sections
    assert {"a stepper", "a heater", "a fan"} <= set(groups())
    extruder = next(block for block in config_blocks(PAGE) if block.section == "extruder")
    assert {"nozzle_diameter", "heater"} <= extruder.options
    assert "rotation_distance" in {name for part in included(extruder, groups()) for name in part.options}
