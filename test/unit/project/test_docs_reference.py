"""docs/reference/G-Codes.md and docs/reference/Status_Reference.md against the program, and the links of all pages."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import compatibility
from doc_rig import HOST, PAGES, ROOT, Loaded, load, read_page
from unit.project.test_docs_config import config_of, documents

# Commands that a user's own sections bring: macros, and the extruders after the first.
OF_THE_USER = re.compile(r"HELLO$|T\d+$|T\d")
# Objects whose fields are named by the user.
FREE_FIELDS = {"gcode_macro", "display_template"}
# Files of a printer, not of this repository.
OF_THE_DATA_FOLDER = {"config/printer.cfg", "config/frontend.cfg"}


@pytest.fixture(scope="module")
def printers(tmp_path_factory: pytest.TempPathFactory) -> list[Loaded]:
    """A printer for every config block of the reference."""
    return [
        load(tmp_path_factory.mktemp("doc"), config_of(blocks, everything=True)) for blocks in documents()
    ]


# ---- G-codes ---------------------------------------------------------------------------------------------------


def documented_commands() -> set[str]:
    """Names in backticks at the start of an item, before its colon, and further ones in capitals within."""
    text = read_page("G-Codes.md")
    items = [line for line in text.splitlines() if line.startswith("* ")]
    return {name for item in items for name in re.findall(r"`([A-Z][A-Z0-9_.]+)`", item)}


def test_every_command_of_a_printer_is_documented(printers: list[Loaded]) -> None:
    known = documented_commands()
    commands = {name for printer in printers for name in printer.commands}
    missing = sorted(name for name in commands - known if not OF_THE_USER.match(name))
    assert not missing, f"commands missing in docs/reference/G-Codes.md: {missing}"


def test_every_command_in_the_code_is_documented() -> None:
    """Also those of sections and states that no block of the reference makes."""
    known = documented_commands()
    missing = [
        f"{name} ({path.relative_to(HOST)})"
        for path in sorted(HOST.rglob("*.py"))
        for name in _commands(ast.parse(path.read_text(encoding="utf-8")))
        if name not in known
    ]
    assert not missing, f"commands missing in docs/reference/G-Codes.md: {missing}"


def _commands(tree: ast.Module) -> list[str]:
    """Methods cmd_NAME, and names given to register_command."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and re.match(r"cmd_[A-Z]", node.name):
            names.append(node.name.removeprefix("cmd_"))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            first = node.args[0] if node.args else None
            if node.func.attr in ("register_command", "register_mux_command") and isinstance(
                first, ast.Constant
            ):
                names.append(str(first.value))
    # a method cannot have the dot of M104.1 in its name
    return [re.sub(r"^([GM]\d+)_(\d)", r"\1.\2", name) for name in names if name != "default"]


def test_every_documented_command_exists(printers: list[Loaded]) -> None:
    commands = {name for printer in printers for name in printer.commands}
    code = "\n".join(path.read_text(encoding="utf-8") for path in HOST.rglob("*.py"))
    unknown = [
        name
        for name in sorted(documented_commands() - commands)
        if f'"{name}"' not in code and f"cmd_{name}" not in code and not OF_THE_USER.match(name)
    ]
    assert not unknown, f"docs/reference/G-Codes.md has commands the program does not know: {unknown}"


def test_every_parameter_of_a_command_is_documented() -> None:
    """On the commands' page or on that of their subject."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    words = set(re.findall(r"[A-Z][A-Z0-9_]+", text))
    asked = re.compile(r"gcmd\.get\w*\(\s*\"([A-Z][A-Z0-9_]+)\"")
    missing = {
        f"{name} ({path.relative_to(HOST)})"
        for path in HOST.rglob("*.py")
        for name in asked.findall(path.read_text(encoding="utf-8"))
        if name not in words
    }
    assert not missing, f"parameters of commands missing in docs/: {sorted(missing)}"


# ---- status ----------------------------------------------------------------------------------------------------


def documented_fields() -> dict[str, set[str]]:
    """Object → fields."""
    found: dict[str, set[str]] = {}
    name = ""
    for line in read_page("Status_Reference.md").splitlines():
        if line.startswith("### "):
            name = line[4:].strip()
            found[name] = set()
        elif line.startswith("* ") and name:
            found[name] |= set(re.findall(r"`([A-Za-z_0-9]+)`", line))
    return found


def status_of(printers: list[Loaded]) -> dict[str, set[str]]:
    """Kind of object → fields of all those there are."""
    found: dict[str, set[str]] = {}
    for printer in printers:
        for name, status in printer.status.items():
            found.setdefault(name.split()[0], set()).update(status)
    return found


def test_every_status_field_is_documented(printers: list[Loaded]) -> None:
    known = documented_fields()
    missing = [
        f"{kind}.{name}"
        for kind, fields in sorted(status_of(printers).items())
        for name in sorted(fields - known.get(kind, set()))
        if kind not in FREE_FIELDS
    ]
    assert not missing, f"fields missing in docs/reference/Status_Reference.md: {missing}"


def test_every_object_with_a_status_is_documented() -> None:
    """Also those of sections that no block of the reference makes."""
    known = documented_fields()
    missing = [
        path.stem
        for path in sorted((HOST / "extras").glob("*.py"))
        if re.search(r"^def load_config", path.read_text(encoding="utf-8"), re.M)
        and "def get_status" in path.read_text(encoding="utf-8")
        and path.stem not in known
        and path.stem not in ("simulator", "statistics")
    ]
    assert not missing, f"objects missing in docs/reference/Status_Reference.md: {missing}"


def test_every_documented_field_exists(printers: list[Loaded]) -> None:
    status = status_of(printers)
    unknown = [
        f"{kind}.{name}"
        for kind, fields in documented_fields().items()
        for name in sorted(fields)
        if kind not in FREE_FIELDS and name not in _inner(status.get(kind, set()), printers, kind)
    ]
    assert not unknown, f"docs/reference/Status_Reference.md has fields the program does not know: {unknown}"


def _inner(fields: set[str], printers: list[Loaded], kind: str) -> set[str]:
    """Fields, and the keys of those that are tables or lists of tables (their meaning is given in the same line)."""
    found = set(fields) | {"help", "type", "message", "stepper_x", "max_power_w"}
    for printer in printers:
        for name, status in printer.status.items():
            if name.split()[0] == kind:
                found |= {key for value in status.values() if isinstance(value, dict) for key in value}
    return found


def test_the_compatibility_page_is_that_of_the_program() -> None:
    assert compatibility.PAGE.read_text(encoding="utf-8") == compatibility.page(), (
        "run scripts/check/compatibility.py"
    )


# ---- links -----------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """Headings as links name them: lower case, blanks to dashes, punctuation gone."""
    text = re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))
    headings = re.findall(r"(?m)^#+ (.+)$", text)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(target)
    assert not broken, f"{page.name}: {broken}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_a_page_names_are_there(page: Path) -> None:
    """`config/x.cfg`, `scripts/y.py`, `test/...` in backticks or commands."""
    text = page.read_text(encoding="utf-8")
    names = re.findall(
        r"(?<![\w/~.-])((?:config|scripts|docs|klippy|src|test)/[\w./-]*\w\.(?:py|md|cfg|sh|csv|c|h|json|png))\b",
        text,
    )
    real = {name for name in names if not re.search(r"/[A-Z]+/", name)}  # src/PORT/... stands for many
    missing = sorted({name for name in real if not (ROOT / name).exists()} - OF_THE_DATA_FOLDER)
    assert not missing, f"{page.name} names files that are not there: {missing}"


# ---- sources ---------------------------------------------------------------------------------------------------


def test_every_source_that_is_cited_is_listed_and_every_listed_one_is_cited() -> None:
    """By its key: a name and a year, as Oskolkov 2021."""
    listed = set(re.findall(r"(?m)^### (\w+ \d{4})$", read_page("References.md")))
    assert len(listed) > 10
    texts = [page for page in PAGES if page.name != "References.md"]
    texts += [p for room in ("klippy", "src", "scripts") for p in (ROOT / room).rglob("*.[pch]*")]
    text = " ".join(p.read_text(encoding="utf-8") for p in texts if p.suffix in (".md", ".py", ".c", ".h"))
    names = "|".join(sorted({key.split()[0] for key in listed}))
    cited = {" ".join(key.split()) for key in re.findall(rf"\b(?:{names})\s+\d{{4}}\b", text)}
    assert cited - listed == set()
    assert listed - cited == set()


def test_the_compatibility_page_names_what_is_missing() -> None:
    options, fields = compatibility.options_here(), compatibility.fields_here()
    assert compatibility.by_owner({"fan": ["pin", "wings"], "kite": ["string"]}, options)[2:] == [
        "| `fan` | 1 of 2 | `wings` |",
        "| `kite` | 0 of 1 | `string` |",
    ]
    assert (
        compatibility.by_owner({"toolhead": ["position", "wings"]}, fields)[2]
        == "| `toolhead` | 1 of 2 | `wings` |"
    )
    assert "tachometer_ppr" in options["heater_fan"] and "spi_bus" in options["tmc2130"]  # by "options of"
