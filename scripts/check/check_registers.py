#!/usr/bin/env python3
"""Compare the hand-written register header of the STM32F334 with the vendor's SVD file.

Usage: check_registers.py [--svd FILE] [--header FILE]

Every address, bit and field of src/stm32f334/regs.h must be where the SVD file has it, under the same name or one of
the names below. The SVD file (PyPI cmsis-svd 0.4, fetched by scripts/setup.sh test) is known to be wrong or odd in
places: DISAGREEMENTS lists what differs on purpose and why. An entry of that list that does not differ is an error.
"""

from __future__ import annotations

import argparse
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# Block of the header → peripheral of the SVD file, and where the block begins in it.
BLOCKS = {
    "RCC": ("RCC", 0),
    "FLASH": ("Flash", 0),
    "PWR": ("PWR", 0),
    "SYSCFG": ("SYSCFG", 0),
    "CRC": ("CRC", 0),
    "IWDG": ("IWDG", 0),
    "GPIO": ("GPIOA", 0),
    "TIM": ("TIM2", 0),
    "DMA1": ("DMA1", 0),
    "DMA": ("DMA1", 8),  # channel 1
    "USART": ("USART2", 0),
    "HRTIM_MASTER": ("HRTIM_Master", 0),
    "HRTIM_TIM": ("HRTIM_TIMA", 0),
    "HRTIM": ("HRTIM_Common", 0),
    "ADC": ("ADC1_2", 0),
    "ADC12": ("ADC1_2", 0x300),
    "SPI": ("SPI1", 0),
    "I2C": ("I2C1", 0),
}
# Registers of a block that the peripheral above does not have: look in this one.
ELSEWHERE = {"TIM_BDTR": "TIM15"}
# Blocks of the processor: the SVD file has them only in part (PM0214).
CORE = {"NVIC", "SCB"}
# Base addresses that the SVD file gives another name, or as part of another block.
BASES = {
    "ADC1": ("ADC1_2", 0),
    "ADC2": ("ADC1_2", 0x100),
    "ADC12_COMMON": ("ADC1_2", 0x300),
    "FLASH": ("Flash", 0),
    "HRTIM_MASTER": ("HRTIM_Master", 0),
    "HRTIM_COMMON": ("HRTIM_Common", 0),
}
# Register in the header → in the SVD file, where the names differ.
REGISTERS = {
    "TIM_CCMR1": "CCMR1_Output",
    "TIM_CCMR2": "CCMR2_Output",
    "DMA_CCR": "CCR1",
    "DMA_CNDTR": "CNDTR1",
    "DMA_CPAR": "CPAR1",
    "DMA_CMAR": "CMAR1",
    "HRTIM_TIM_CR": "TIMACR",
    "HRTIM_TIM_CNT": "CNTAR",
    "HRTIM_TIM_PER": "PERAR",
    "HRTIM_TIM_REP": "REPAR",
    "HRTIM_TIM_CMP1": "CMP1AR",
    "HRTIM_TIM_CMP2": "CMP2AR",
    "HRTIM_TIM_CMP4": "CMP4AR",
    "HRTIM_TIM_DT": "DTAR",
    "HRTIM_TIM_SET1": "SETA1R",
    "HRTIM_TIM_RST1": "RSTA1R",
    "HRTIM_TIM_OUT": "OUTAR",
    "HRTIM_TIM_FLT": "FLTAR",
    "HRTIM_ODISR": "DISR",
    "SPI_DR8": "DR",
}
# Field in the header → in the SVD file.
FIELDS = {
    "RCC_CR_HSEBYP": "HSEBYP",
    "HRTIM_TIM_CR_CK_PSC": "CK_PSCx",
    "HRTIM_TIM_DT_DTR": "DTRx",
    "HRTIM_TIM_DT_DTRSLK": "DTRSLKx",
    "HRTIM_TIM_DT_DTRLK": "DTRLKx",
    "HRTIM_TIM_DT_DTF": "DTFx",
    "HRTIM_TIM_DT_DTFSLK": "DTFSLKx",
    "HRTIM_TIM_DT_DTFLK": "DTFLKx",
    "DMA1_ISR_TCIF": "TCIF1",
    "DMA1_ISR_HTIF": "HTIF1",
    "DMA1_ISR_TEIF": "TEIF1",
}
# Interrupt in the header → in the SVD file.
INTERRUPTS = {
    "DMA1_CHANNEL1": "DMA1_CH1",
    "DMA1_CHANNEL7": "DMA1_CH7",
    "USART2": "USART2_EXTI26",
}

DISAGREEMENTS = {
    "SYSCFG_CFGR2_LOCKUP_LOCK": "the SVD file has LOCUP_LOCK; RM0364: LOCKUP_LOCK, bit 0",
    "ADC_CR_ADVREGEN": "the SVD file has one bit and beside it DEEPPWD, which this chip lacks; RM0364 has two bits",
    "HRTIM_IER_SYSFLTIE": "the SVD file calls it SYSFLTE; RM0364 has SYSFLTIE, bit 5",
    "IRQ_HRTIM1_FLT": "the SVD file has no interrupts of HRTIM; RM0364 has position 73",
}


@dataclass(frozen=True, slots=True)
class Field:
    first: int
    bits: int

    def __str__(self) -> str:
        return f"bit {self.first}" if self.bits == 1 else f"bits {self.first} to {self.first + self.bits - 1}"


@dataclass(slots=True)
class Register:
    offset: int
    fields: dict[str, Field] = field(default_factory=dict)


@dataclass(slots=True)
class Peripheral:
    base: int
    registers: dict[str, Register] = field(default_factory=dict)


@dataclass(slots=True)
class Chip:
    """An SVD file, as far as it is needed."""

    peripherals: dict[str, Peripheral] = field(default_factory=dict)
    interrupts: dict[str, int] = field(default_factory=dict)


def number(node: ET.Element, name: str) -> int:
    return int(node.findtext(name, "0"), 0)


def read_registers(node: ET.Element) -> dict[str, Register]:
    registers: dict[str, Register] = {}
    for one in node.iterfind("registers/register"):
        fields = {
            item.findtext("name", ""): Field(number(item, "bitOffset"), number(item, "bitWidth"))
            for item in one.iterfind("fields/field")
        }
        registers[one.findtext("name", "")] = Register(number(one, "addressOffset"), fields)
    return registers


def read_svd(path: Path) -> Chip:
    """Peripherals with their registers; a derived one has those of its origin."""
    chip = Chip()
    nodes = {
        node.findtext("name", ""): node
        for node in ET.parse(path).getroot().iterfind("peripherals/peripheral")
    }
    for name, node in nodes.items():
        origin = nodes[node.get("derivedFrom", name)]
        chip.peripherals[name] = Peripheral(number(node, "baseAddress"), read_registers(origin))
        for interrupt in node.iterfind("interrupt"):
            chip.interrupts[interrupt.findtext("name", "")] = number(interrupt, "value")
    return chip


@dataclass(frozen=True, slots=True)
class Define:
    """One line of the header. kind: base, register, field, irq."""

    kind: str
    name: str
    block: str  # of a register: its block's prefix
    value: int  # address, offset, first bit or position
    bits: int = 0


LINES = (
    ("base", re.compile(r"#define (?P<name>\w+)_BASE (?P<value>0x[0-9a-f]+)u$")),
    ("register", re.compile(r"#define (?P<name>\w+)(\(\w+\))? R8?\((?P<block>\w+), (?P<value>0x[0-9a-f]+)")),
    ("flags", re.compile(r"#define (?P<name>\w+)\(n\) BIT\(4 \* \(n\) - (?P<value>\d+)\)$")),
    ("bit", re.compile(r"#define (?P<name>\w+) BIT\((?P<value>\d+)\)$")),
    ("field", re.compile(r"#define (?P<name>\w+)\(v\) FIELD\(v, (?P<value>\d+), (?P<bits>\d+)\)$")),
    ("irq", re.compile(r"\s+IRQ_(?P<name>\w+) = (?P<value>\d+),$")),
)


def read_header(text: str) -> Iterator[Define]:
    for line in text.splitlines():
        for kind, pattern in LINES:
            match = pattern.match(line)
            if not match:
                continue
            groups = match.groupdict()
            value = int(groups["value"], 0)
            if kind == "flags":  # of channel n; of channel 1 here
                yield Define("field", groups["name"], "", 4 - value, 1)
            elif kind == "bit":
                yield Define("field", groups["name"], "", value, 1)
            else:
                yield Define(
                    kind, groups["name"], groups.get("block") or "", value, int(groups.get("bits") or 0)
                )
            break


def block_of(name: str) -> str:
    """The longest block name that begins a register's name."""
    known = [block for block in (*BLOCKS, *CORE) if name.startswith(block + "_")]
    return max(known, key=len, default="")


class Comparison:
    """What does not agree, by the header's name."""

    def __init__(self, chip: Chip) -> None:
        self.chip = chip
        self.objections: dict[str, str] = {}
        self.compared = 0
        self.place: dict[str, Register] = {}  # header's registers found in the SVD file
        self.core: set[str] = set()

    def base(self, define: Define) -> None:
        peripheral, offset = BASES.get(define.name, (define.name, 0))
        if define.name in CORE:
            return
        if peripheral not in self.chip.peripherals:
            self.objections[define.name] = f"there is no peripheral {peripheral} in the SVD file"
        elif self.chip.peripherals[peripheral].base + offset != define.value:
            there = self.chip.peripherals[peripheral].base + offset
            self.objections[define.name] = f"begins at {there:#x} in the SVD file, at {define.value:#x} here"

    def register(self, define: Define) -> None:
        block = block_of(define.name)
        if block in CORE:
            self.core.add(define.name)
            return
        if not block:
            self.objections[define.name] = "belongs to no block that this script knows"
            return
        peripheral, begin = BLOCKS[block]
        peripheral = ELSEWHERE.get(define.name, peripheral)
        name = REGISTERS.get(define.name, define.name[len(block) + 1 :])
        found = self.chip.peripherals[peripheral].registers.get(name)
        if found is None:
            self.objections[define.name] = f"there is no {peripheral}.{name} in the SVD file"
        elif found.offset != define.value + begin:
            self.objections[define.name] = (
                f"lies at {found.offset:#x} in the SVD file, at {define.value:#x} here"
            )
        else:
            self.place[define.name] = found

    def field(self, define: Define) -> None:
        owners = [name for name in (*self.place, *self.core) if define.name.startswith(name + "_")]
        owner = max(owners, key=len, default="")
        if owner in self.core:
            return
        if not owner:
            self.objections[define.name] = "belongs to no register that was found"
            return
        name = FIELDS.get(define.name, define.name[len(owner) + 1 :])
        found = self.place[owner].fields.get(name)
        here = Field(define.value, define.bits)
        if found is None:
            self.objections[define.name] = f"there is no field {name} in the SVD file"
        elif found != here:
            self.objections[define.name] = f"is {found} in the SVD file, {here} here"

    def irq(self, define: Define) -> None:
        there = self.chip.interrupts.get(INTERRUPTS.get(define.name, define.name))
        if define.name != "COUNT" and there != define.value:
            self.objections["IRQ_" + define.name] = f"is {there} in the SVD file, {define.value} here"

    def compare(self, define: Define) -> None:
        self.compared += 1
        {"base": self.base, "register": self.register, "field": self.field, "irq": self.irq}[define.kind](
            define
        )


def unexplained(objections: dict[str, str]) -> list[str]:
    """Objections that DISAGREEMENTS does not have, and entries of it that are none."""
    lines = [f"{name} {text}" for name, text in objections.items() if name not in DISAGREEMENTS]
    return lines + [
        f"{name} is listed as a known disagreement, and agrees"
        for name in DISAGREEMENTS
        if name not in objections
    ]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--svd", type=Path, default=ROOT / "out" / "registers" / "STM32F334x.svd")
    parser.add_argument("--header", type=Path, default=ROOT / "src" / "stm32f334" / "regs.h")
    options = parser.parse_args(argv)
    if not options.svd.exists():
        print(
            f"check_registers: {options.svd} is not there; scripts/setup.sh test fetches it", file=sys.stderr
        )
        return 1
    comparison = Comparison(read_svd(options.svd))
    for define in read_header(options.header.read_text()):
        comparison.compare(define)
    wrong = unexplained(comparison.objections)
    for line in wrong:
        print(f"check_registers: {line}", file=sys.stderr)
    if not wrong:
        print(f"registers: {comparison.compared} compared, {len(DISAGREEMENTS)} known disagreements")
    return int(bool(wrong) or comparison.compared < 100)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
