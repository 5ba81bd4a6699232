"""scripts/check_config.py: every problem of a config at once, without a board."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from bus_rig import all_boards_dictionary

ROOT = Path(__file__).resolve().parents[3]
GOOD = (ROOT / "config/example-cartesian.cfg").read_text()


def check(folder: Path, config: str, *options: str) -> tuple[int, str]:
    (folder / "printer.cfg").write_text(config)
    done = subprocess.run(
        [sys.executable, ROOT / "scripts/check_config.py", folder / "printer.cfg", *options],
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.stderr
    return done.returncode, done.stdout


def test_a_good_config_would_start(tmp_path: Path) -> None:
    status, text = check(tmp_path, GOOD)
    assert status == 0 and text.endswith("printer.cfg: the printer would start\n")


def test_problems_of_all_sections_and_unknown_names_are_distinguished(tmp_path: Path) -> None:
    """An invented section, a typo, and a wrong value."""
    wrong = "[pause_resumee]\n[respond]\ndefault_tpe: echo\n[idle_timeout]\ntimeout: -1\n[warp_drive]\n"
    status, text = check(tmp_path, GOOD + wrong)
    assert status == 1
    for part in (
        "Section 'pause_resumee' is not a valid config section",
        "Did you mean 'pause_resume'?",
        "Did you mean 'default_type'?",
        "Option 'timeout' in section 'idle_timeout'",
        "Section 'warp_drive' is not a valid config section",
        "the printer would not start",
    ):
        assert part in text


def test_with_a_dictionary_pins_are_checked(tmp_path: Path) -> None:
    (tmp_path / "board.dict").write_bytes(all_boards_dictionary())
    config = GOOD + "[output_pin light]\npin: PZ99\n"
    assert check(tmp_path, config)[0] == 0
    status, text = check(tmp_path, config, "-d", str(tmp_path / "board.dict"))
    assert status == 1 and "PZ99" in text
