"""A long random life of the induction unit's pure files under the address and undefined behaviour sanitizers, and
their promise to know no board: every compiler we have takes them alone."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from pure_harness import INDUCTION_SOURCES, SANITIZERS, SRC

HERE = Path(__file__).resolve().parent


def test_a_random_life_is_clean_under_the_sanitizers(tmp_path):
    program = tmp_path / "soak"
    sources = [str(SRC / name) for name in INDUCTION_SOURCES]
    flags = ["-std=c11", "-O1", "-g", "-Wall", "-Wextra", "-Werror", *SANITIZERS["address"], f"-I{SRC}"]
    subprocess.run(["gcc", *flags, str(HERE / "induction_soak.c"), *sources, "-o", str(program)], check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("compiler", ["gcc", "clang", "arm-none-eabi-gcc", "avr-gcc"])
@pytest.mark.parametrize("name", INDUCTION_SOURCES)
def test_pure_files_compile_alone_everywhere(compiler, name, tmp_path):
    command = [compiler, "-std=c11", "-Os", "-Wall", "-Wextra", "-Werror", "-c", str(SRC / name)]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "x.o")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", INDUCTION_SOURCES)
def test_pure_files_include_no_board_and_divide_nowhere(name):
    """Layer rule of the firmware; and a Cortex-M0 or AVR has no divider, an interrupt no time for one."""
    allowed = {
        "stddef.h",
        "stdint.h",
        "oversample_kernel.h",
        *(source[:-1] + "h" for source in INDUCTION_SOURCES),
    }
    text = (SRC / name).read_text()
    header = (SRC / name).with_suffix(".h").read_text()
    assert set(re.findall(r'#include [<"]([^>"]+)', text + header)) <= allowed
    code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert not re.search(r"[^/]/[^/]|%", code)
