"""The firmware under sanitizers, under a fuzzer, and its dictionary builder under mistaken declarations."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_seeds import seed_inputs

from mcu_harness import ROOT, SIM_DIR, make

FUZZER = ROOT / "out" / "fuzz" / "fuzz_command"
SESSIONS = ["test_mcu_config.py", "test_mcu_outputs.py", "test_mcu_motion.py"]


def test_whole_sessions_run_clean_under_address_and_undefined_behaviour_sanitizers() -> None:
    make("sim-mcu-sanitized")
    runtime = subprocess.run(
        ["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True
    )
    environment = os.environ | {
        "FERRITE_MCU_LIBRARY": str(SIM_DIR / "libferrite_mcu_sanitized.so"),
        "LD_PRELOAD": runtime.stdout.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter's own
    }
    skip = "not booting_again and not whole_move_queue and not holds_what_it_promises"  # slow, or read raw memory
    # -s: a sanitizer's report goes to stderr
    options = ["-x", "-s", "-p", "no:cacheprovider", "-k", skip]
    command = [sys.executable, "-m", "pytest", *options]
    files = [str(ROOT / "test" / "c" / name) for name in SESSIONS]
    run = subprocess.run(
        [*command, *files], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]


def test_receiver_survives_five_seconds_of_fuzzing(tmp_path: Path) -> None:
    make("fuzz-build")
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for number, data in enumerate(seed_inputs()):
        (corpus / f"seed{number}").write_bytes(data)
    command = [
        FUZZER,
        "-max_len=512",
        "-max_total_time=5",
        "-seed=1",
        f"-artifact_prefix={tmp_path}/",
        corpus,
    ]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-4000:]


# ---------------------------------------------------------------- the dictionary builder

PREAMBLE = """
#include "command.h"
void h(const struct command_args *args);
void h2(const struct command_args *args);
DECL_COMMAND(h, "identify offset=%u count=%c");
DECL_RESPONSE(r, "identify_response offset=%u data=%.*s");
"""


def build(tmp_path: Path, text: str) -> subprocess.CompletedProcess[str]:
    source = tmp_path / "unit.c"
    source.write_text(PREAMBLE + text)
    script = ROOT / "scripts" / "build" / "build_dictionary.py"
    command = [sys.executable, script, "--out", tmp_path, "--cc", f"gcc -I{ROOT}/src", source]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            'DECL_COMMAND(h, "a x=%u");\nDECL_COMMAND(h2, "a y=%u");',
            "unit.c:8: command 'a' is declared already at",
        ),
        (
            'DECL_COMMAND(h, "a x=%d");',
            "parameter 'x=%d' of 'a' has an unknown type (known: %c %hu %hi %u %i",
        ),
        ('DECL_COMMAND(h, "a x");', "parameter 'x' of 'a' is not of the form name=%type"),
        ('DECL_COMMAND(h, "a x=%u x=%u");', "'a' has two parameters called 'x'"),
        ('DECL_COMMAND(h, "A-b x=%u");', "does not begin with a message name"),
        ('DECL_COMMAND(h, "a x=%*s y=%*s");', "more than 12 numbers or than one byte string"),
        ('DECL_COMMAND_FLAGS(h, HF_OFTEN, "a x=%u");', "unknown command flag 'HF_OFTEN'"),
        ('DECL_RESPONSE(q, "a x=%u");\nDECL_RESPONSE(q2, "a");', "response 'a' is declared already"),
        ('DECL_CONSTANT("C", 1);\nDECL_CONSTANT("C", 2);', "constant 'C' is declared already"),
        ('int v;\nDECL_CONSTANT("C", v);', "'v' is not a compile-time integer constant"),
        ('DECL_CONSTANT("C", 1 +);', "'1 +' is not an integer expression"),
        ('DECL_ENUMERATION("e", "x", 1);\nDECL_ENUMERATION("e", "x", 2);', "'x' is declared already"),
        ('DECL_ENUMERATION_RANGE("pin", "PA", 0, 8);', "must end in digits, not 'PA'"),
        ("#include <no_such_file.h>", "could not be preprocessed"),
    ],
)
def test_mistaken_declarations_are_named_with_their_place(tmp_path: Path, text: str, complaint: str) -> None:
    run = build(tmp_path, text)
    assert run.returncode == 1
    assert complaint in run.stderr and "unit.c" in run.stderr and "Traceback" not in run.stderr


def test_constants_may_be_expressions_macros_and_enumerators(tmp_path: Path) -> None:
    text = """
    #define BASE 0x10u
    enum { HALF = 32 };
    DECL_CONSTANT("A", (BASE << 4) / 3 - 1);
    DECL_CONSTANT("B", HALF * sizeof(uint32_t));
    DECL_CONSTANT("C", -HALF);
    DECL_CONSTANT_STR("D", "one " "two");
    """
    run = build(tmp_path, text)
    assert run.returncode == 0, run.stderr
    config = json.loads((tmp_path / "ferrite.dict").read_text())["config"]
    assert config == {"A": 84, "B": 128, "C": -32, "D": "one two"}


def test_message_numbers_stay_in_one_byte_as_long_as_they_can(tmp_path: Path) -> None:
    lines = [f'DECL_COMMAND(h, "c{i} x=%u");' for i in range(60)]
    lines += [f'DECL_RESPONSE(s{i}, "s{i}");' for i in range(80)]
    assert build(tmp_path, "\n".join(lines)).returncode == 0
    plain = json.loads((tmp_path / "ferrite.dict").read_text())
    commands, responses = plain["commands"], plain["responses"]
    assert sorted(commands.values()) == list(range(1, 62))
    expected = {0, *range(62, 96), *range(-32, 0), *range(96, 96 + 80 - 34 - 32)}
    assert set(responses.values()) == expected and len(responses) == 81
