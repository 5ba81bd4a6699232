"""Programs of a few lines on the emulated STM32F334; tiny.h has start-up and registers."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from chip_rig import Chip
from simulation import builds

HERE = Path(__file__).resolve().parent
ARM = [
    "arm-none-eabi-gcc",
    "-std=gnu11",
    "-mcpu=cortex-m4",
    "-mthumb",
    "-mfloat-abi=hard",
    "-mfpu=fpv4-sp-d16",
]


class Tiny(Chip):
    """A few lines of C: `program` is the body of program(), `before` what stands outside of it."""

    def __init__(self, folder: Path, program: str, before: str = "", **options: Any) -> None:
        source, image = folder / "tiny.c", folder / "tiny.elf"
        source.write_text(f'#include "tiny.h"\n{before}\nvoid program(void)\n{{\n{program}\n}}\n')
        flags = ["-O2", "-nostartfiles", "-nostdlib", f"-I{HERE}", "-T", str(HERE / "tiny.ld")]
        subprocess.run([*ARM, *flags, str(source), "-o", str(image), "-lgcc"], check=True)
        super().__init__(make_emulator(), image, **options)

    def result(self) -> int:
        """result[0] of the program."""
        return self.chip.peek("=result")


def make_emulator() -> builds.Build:
    """The emulator of the STM32F334, without an image."""
    build = builds.BUILDS["stm32f334"]
    builds.make([build.library], "The emulator")
    return build
