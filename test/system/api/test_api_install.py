"""install.sh, the example for a real build, and the API's page against the API."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from base_rig import Session
from doc_rig import read_page
from moonraker_rig import ROOT
from simulation import world as world_module

EXAMPLES = sorted((ROOT / "config").glob("example-induction-*.cfg"))  # the others: test_motion_kinematics


def install(home: Path, *options: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "XDG_CONFIG_HOME"}
    return subprocess.run(
        [str(ROOT / "scripts" / "install.sh"), "--no-packages", "--no-start", *options],
        env={**environment, "HOME": str(home)}, capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip


def test_install_without_starting_says_what_root_is_to_do(tmp_path: Path) -> None:
    done = install(tmp_path)
    assert done.returncode == 0, done.stderr
    data = tmp_path / "printer_data"
    assert f"as root: cp {data}/systemd/*.service /etc/systemd/system/" in done.stdout
    assert f'-a "{data}/comms/klippy.sock"' in (data / "systemd" / "klipper.service").read_text()
    assert {folder.name for folder in data.iterdir()} == {"config", "gcodes", "logs", "comms", "systemd"}
    config = data / "config" / "printer.cfg"
    assert f"path: {data}/gcodes" in config.read_text()
    assert (data / "config" / "macros-induction.cfg").exists(), "what it includes is there, too"
    config.write_text("mine")
    assert install(tmp_path).returncode == 0
    assert config.read_text() == "mine"
    assert install(tmp_path, "--uninstall").returncode == 0
    assert not (data / "systemd").exists()
    assert config.read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--data", str(ROOT / "out" / "x")], "must be outside"),
        (["--name", "../evil"], "may have letters"),
        (["--wrong"], "unknown option"),
        (["--port", "http"], "need numbers"),
        (["--front-end", "nowhere"], "there is no folder nowhere"),
        (["--front-end", str(ROOT)], "has no index.html"),
    ],
)
def test_install_refuses_what_would_not_work(tmp_path: Path, options: list[str], words: str) -> None:
    done = install(tmp_path, *options)
    assert done.returncode == 1
    assert words in done.stderr
    assert not (tmp_path / "printer_data").exists()


# Every macro of the examples, in the order of a day.
DAY = """
G28
G1 X10 Y10 F3000
LOAD_FILAMENT TEMP=200 LENGTH=50
START_PRINT BED=50 NOZZLE=200
G1 X50 E1
NOZZLE_STATE
PAUSE
RESUME
M600
RESUME
PAUSE
CANCEL_PRINT
UNLOAD_FILAMENT TEMP=200 LENGTH=50
END_PRINT
"""


def dictionary_of(port: str) -> Path:
    """Data dictionary of a port's firmware, built from src/."""
    with (ROOT / "out" / ".simulation-lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        subprocess.run(["make", "-s", f"firmware-{port}"], cwd=ROOT, check=True, capture_output=True)
    return ROOT / "out" / port / "ferrite.dict"


@pytest.mark.parametrize("config", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_for_a_real_build_loads_and_prints(tmp_path: Path, config: Path) -> None:
    """In batch mode with the boards' own dictionaries: they know the pins.

    For the STM32F103 of one of them there is no port; the simulator's has the pins of a large STM32.
    """
    world_module.build()
    main = dictionary_of("atmega2560") if "ramps" in config.stem else world_module.MCU_DICTIONARY
    script = tmp_path / "in.gcode"
    script.write_text(DAY)
    done = subprocess.run(
        [sys.executable, ROOT / "klippy" / "klippy.py", config, "-i", script, "-o", tmp_path / "out",
         "-d", main, "-d", f"heater={dictionary_of('stm32f334')}"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out").stat().st_size > 1000
    assert (tmp_path / "out-heater").stat().st_size > 100


def test_every_endpoint_is_in_the_manual(tmp_path: Path) -> None:
    page = read_page("API.md")

    def body(session: Session) -> None:
        webhooks = session.printer.lookup_object("webhooks")
        for path in webhooks._endpoints:
            first, _, last = path.partition("/")
            known = f"`{path}`" in page or (f"`{first}/" in page and last in page)
            assert known, f"docs/reference/API.md says nothing of {path}"

    Session(tmp_path, "[pause_resume]\n").run(body)
