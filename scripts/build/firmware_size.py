#!/usr/bin/env python3
"""Flash, memory and stack of a firmware image against its budget and against the last release.

Usage: firmware_size.py --port stm32f334 --out out/stm32f334 [--keep]      (make PORT=stm32f334 size, KEEP=1)

The budget and the figures of the last release are in src/PORT/size.json; --keep writes today's figures there.
Sizes come from the ELF file's sections. The stack's depth ("measured") is the deepest of the tests' scenarios in
emulation, entered by hand and only repeated here; test_make_ports.py and the scenarios themselves watch its share.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHT_NOBITS, SHF_ALLOC = 8, 2
STACK_SHARE_MAX = 0.75  # of its space: the rest is for what the scenarios have not met


@dataclass(frozen=True, slots=True)
class Section:
    name: str
    kind: int
    flags: int
    address: int
    size: int


@dataclass(frozen=True, slots=True)
class Sizes:
    """Bytes. `static`: .data and .bss; `arena`: for objects and moves; `stack`: what is set aside for it."""

    flash: int
    static: int
    arena: int
    stack: int

    @property
    def ram(self) -> int:
        return self.static + self.arena + self.stack

    def rows(self) -> dict[str, int]:
        return asdict(self) | {"ram": self.ram}


def read_elf(elf: bytes) -> tuple[list[Section], dict[str, int]]:
    """Sections and symbols of a 32-bit little-endian ELF file."""
    if elf[:6] != b"\x7fELF\x01\x01":
        raise ValueError("this is no 32-bit little-endian ELF file")
    table = struct.unpack_from("<I", elf, 32)[0]
    size, count, names_at = struct.unpack_from("<3H", elf, 46)
    rows = [struct.unpack_from("<10I", elf, table + size * number) for number in range(count)]

    def text(at: int) -> str:
        return elf[at : elf.index(b"\0", at)].decode()

    names = rows[names_at][4]
    sections = [Section(text(names + row[0]), row[1], row[2], row[3], row[5]) for row in rows]
    symbols: dict[str, int] = {}
    for row in rows:
        if row[1] != 2:  # SHT_SYMTAB
            continue
        strings = rows[row[6]][4]
        for at in range(row[4], row[4] + row[5], 16):
            name, value = struct.unpack_from("<II", elf, at)
            symbols[text(strings + name)] = value
    return sections, symbols


def measure(path: Path, stack_bytes: int) -> Sizes:
    """The sizes of an image. `stack_bytes`: where no symbol says it."""
    sections, symbols = read_elf(path.read_bytes())
    loaded = [section for section in sections if section.flags & SHF_ALLOC]
    in_memory = [
        section
        for section in loaded
        if section.kind == SHT_NOBITS or section.name in (".data", ".bss", ".noinit")
    ]
    stored = [section for section in loaded if section.kind != SHT_NOBITS and section.name != ".eeprom"]
    if "stack_top" in symbols and "stack_limit" in symbols:
        stack_bytes = symbols["stack_top"] - symbols["stack_limit"]
    arena = symbols.get("arena_end", 0) - symbols.get("arena_start", 0)
    return Sizes(
        sum(section.size for section in stored),
        sum(section.size for section in in_memory),
        arena,
        stack_bytes,
    )


def report(port: str, sizes: Sizes, record: dict[str, dict[str, int]]) -> list[str]:
    """Lines for people; a line that begins with "over" for each budget that is broken."""
    budget, last = record["budget"], record["release"]
    lines = [f"{port}        bytes   budget   last release"]
    for name, value in sizes.rows().items():
        limit = f"{budget[name]:8}" if name in budget else "        "
        change = f"{last[name]:8} {value - last[name]:+d}" if name in last else ""
        lines.append(f"  {name:8} {value:9} {limit}   {change}")
    used = record.get("measured", {}).get("stack_used", 0)
    if used:
        lines.append(
            f"  stack used in emulation at most {used} of {sizes.stack} ({100 * used // sizes.stack} %)"
        )
    if used > STACK_SHARE_MAX * sizes.stack:
        lines.append(f"over budget: of {sizes.stack} bytes of stack more than three quarters are used")
    lines += [
        f"over budget: {name} is {value} bytes, {budget[name]} are allowed"
        for name, value in (("flash", sizes.flash), ("ram", sizes.ram))
        if value > budget[name]
    ]
    return lines


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--port", required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder with ferrite.elf")
    parser.add_argument("--keep", action="store_true", help="make today's figures those of the last release")
    options = parser.parse_args(argv)
    path = ROOT / "src" / options.port / "size.json"
    try:
        record: dict[str, dict[str, int]] = json.loads(path.read_text())
        sizes = measure(options.out / "ferrite.elf", record["budget"].get("stack", 0))
    except (OSError, ValueError) as error:
        print(f"firmware_size: {error}", file=sys.stderr)
        return 1
    lines = report(options.port, sizes, record)
    print("\n".join(lines))
    if options.keep:
        record["release"] = sizes.rows()
        path.write_text(json.dumps(record, indent=2) + "\n")
    return int(any(line.startswith("over") for line in lines))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
