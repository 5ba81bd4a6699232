"""Programs as the documentation calls them: a newcomer copies the line into a shell with no environment activated."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from doc_rig import PAGES, ROOT

COMMAND = re.compile(r'^(?:    |S=")?((?:scripts|klippy)/[\w./]+)', re.MULTILINE)
BLOCK = re.compile(r"^```\w*\n(.*?)^```|((?:^    .*\n)+)", re.MULTILINE | re.DOTALL)


def called() -> list[str]:
    """Files that a line of a block of commands begins with."""
    blocks = [match[0] for text in PAGES for match in BLOCK.finditer(text.read_text(encoding="utf-8"))]
    return sorted({name for block in blocks for name in COMMAND.findall(block) if (ROOT / name).is_file()})


def programs() -> list[str]:
    """What can be started as it is, whether a block calls it, a sentence or the Makefile."""
    files = [*(ROOT / "scripts").glob("*.py"), *(ROOT / "scripts" / "bench").glob("*.py")]
    found = {path.relative_to(ROOT).as_posix() for path in files if os.access(path, os.X_OK)}
    return sorted(found | {name for name in called() if name.endswith(".py")})


def test_the_documentation_calls_some_programs() -> None:
    assert {"scripts/simulate.py", "scripts/plan_temperature.py", "scripts/emulate.py"} <= set(called())


@pytest.mark.parametrize("name", called())
def test_a_program_of_the_documentation_can_be_started_as_it_is_written(name: str) -> None:
    assert os.access(ROOT / name, os.X_OK)


@pytest.mark.skipif(not (ROOT / ".venv" / "bin" / "python").exists(), reason="packages are elsewhere")
@pytest.mark.parametrize("name", programs())
def test_a_program_finds_its_packages_without_an_activated_environment(name: str, tmp_path: Path) -> None:
    base = Path(sys.base_prefix) / "bin" / f"python{sys.version_info.major}.{sys.version_info.minor}"
    bare = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "PYTHONPATH")}
    done = subprocess.run(
        [base, ROOT / name, "--help"], env=bare, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "usage" in done.stdout.lower(), done.stderr
