"""The commands of the guides as they stand there: shell on a computer of the test's own, G-code in simulation."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from doc_rig import fenced
from moonraker_rig import SimulatedPrinter
from simulation.printer_data import PrinterData
from system.api.test_api_install import dictionary_of
from system.api.test_moonraker import finished_job, square
from system.conftest import CONFIG, ROOT, Simulate
from system.test_setup import NOTED, Computer

GUIDES = ("Installation.md", "Your_Printer.md", "Induction_Nozzle.md", "Daily_Use.md", "Tuning.md")
FIRST_HEAT = f"""
[include {CONFIG}]
[induction_heater nozzle]
sense_pin: PA0
estimator: uncalibrated
max_temp: 370
calibration_folder: {{folder}}
"""
# As someone has it for a RAMPS board.
AXES = "".join(
    f"[stepper_{axis}]\nstep_pin: {step}\ndir_pin: {way}\nenable_pin: !{enable}\nmicrosteps: 16\n"
    f"rotation_distance: {turn}\nendstop_pin: ^{end}\nposition_endstop: 0\nposition_max: 200\n"
    for axis, step, way, enable, end, turn in (
        ("x", "PF0", "PF1", "PD7", "PE5", 40),
        ("y", "PF6", "PF7", "PF2", "PJ1", 40),
        ("z", "PL3", "PL1", "PK0", "PD3", 8),
    )
)
KLIPPER_CONFIG = f"""
[mcu]
serial: /dev/serial/by-id/usb-ramps
[printer]
kinematics: cartesian
max_velocity: 300
max_accel: 3000
max_z_velocity: 5
max_z_accel: 100
{AXES}
[extruder]
step_pin: PA4
dir_pin: PA6
enable_pin: !PA2
microsteps: 16
rotation_distance: 33.5
nozzle_diameter: 0.400
filament_diameter: 1.750
heater_pin: PB4
sensor_type: EPCOS 100K B57560G104F
sensor_pin: PK5
control: pid
pid_Kp: 22.2
pid_Ki: 1.08
pid_Kd: 114
min_temp: 0
max_temp: 250
[heater_bed]
heater_pin: PH5
sensor_type: EPCOS 100K B57560G104F
sensor_pin: PK6
control: watermark
min_temp: 0
max_temp: 130
[fan]
pin: PH6
[gcode_macro START_PRINT]
gcode:
    G28
    M104 S{{params.T|default(200)}}
"""


def blocks(page: str, language: str) -> list[str]:
    """Its fenced texts in a language, one a block, without their indentation."""
    return [
        "\n".join(line.strip() for line in lines)
        for _, _, found, lines in indented_fences(page)
        if found == language
    ]


def indented_fences(page: str) -> list[tuple[int, str, str, list[str]]]:
    """As `fenced`, within numbered lists, too."""
    text = (ROOT / "docs" / "guides" / page).read_text(encoding="utf-8")
    found, inside, language, lines = [], False, "", []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip().startswith("```"):
            if inside:
                found.append((number, "", language, lines))
            inside, language, lines = not inside, line.strip()[3:], []
        elif inside:
            lines.append(line)
    return found


def shell(script: str, folder: Path, path: str, **more: str) -> str:
    """What bash prints; the first command that fails ends it."""
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", script],
        cwd=folder, env={"PATH": path, "TMPDIR": "/tmp", "USER": "anna", **more},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_guide_of_the_owner_has_commands_that_are_run() -> None:
    for page in GUIDES:
        assert blocks(page, "sh") + blocks(page, "gcode"), page
    assert list(fenced("Installation.md")), "the reader of the other pages finds them, too"


def test_the_installation_on_a_bare_computer(tmp_path: Path) -> None:
    """apt, sudo, systemd, git and make are played; they note how they were called."""
    computer = Computer(tmp_path, uid=1000)
    for name in ("apt-get", "systemctl", "sudo", "git", "make", "gcc", "ip"):
        computer.program(name, NOTED)
    computer.with_environment()
    (computer.home / "ferrite").symlink_to(computer.checkout)
    script = "\n".join(blocks("Installation.md", "sh"))
    printed = shell(
        script, computer.home, str(computer.bin), HOME=str(computer.home), CALLS=str(computer.calls_file)
    )
    assert "started klipper moonraker front-end" in printed
    assert "removed the services klipper moonraker front-end" in printed
    assert computer.calls("make") == ["deb"]
    calls = computer.calls("sudo")
    assert any(call.endswith("systemctl enable --now klipper moonraker front-end") for call in calls)
    assert any(call.startswith("apt-get install ./out/ferrite_") for call in calls)
    assert (computer.home / "printer_data" / "config" / "printer.cfg").exists()
    version = (ROOT / "VERSION").read_text().strip()
    assert f"ferrite_{version}_all.deb" in script, "the package has the version's name"


def test_an_ordinary_printer_from_a_klipper_config(tmp_path: Path) -> None:
    (tmp_path / "printer.cfg").write_text(KLIPPER_CONFIG)
    (tmp_path / "part.gcode").write_text("START_PRINT T=190\nG1 X20 Y20 Z1 F3000\nG1 X30 E1 F1200\nM400\n")
    dictionary_of("atmega2560")
    shell("\n".join(blocks("Your_Printer.md", "sh")), ROOT, os.environ["PATH"], HOME=str(tmp_path))
    assert "queue_step" in (tmp_path / "part.txt").read_text()


def test_building_and_flashing_the_heater_board(tmp_path: Path) -> None:
    """Against a stand-in programmer; `make test-flash` has the real one."""
    dictionary_of("stm32f334")
    calls = tmp_path / "calls"
    (tmp_path / "openocd").write_text(NOTED.format(name="openocd"))
    (tmp_path / "openocd").chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    script = "\n".join(blocks("Induction_Nozzle.md", "sh"))
    assert "flash" in script
    shell(script, ROOT, path, HOME=str(tmp_path), CALLS=str(calls))
    assert "verify" in calls.read_text()


@pytest.mark.slow
def test_the_first_heat_of_an_unknown_nozzle(simulate: Simulate, tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"
    config.write_text(FIRST_HEAT.format(folder=tmp_path))
    log = tmp_path / "host.log"
    run = simulate(
        "\n".join(blocks("Induction_Nozzle.md", "gcode")) + "\n", config=config, more=["--log", str(log)]
    )
    assert run.status == 0, run.stderr
    assert run.summary["faults"] == []
    assert run.summary["heater"]["estimate_max_error_c"] < 3.0
    text = log.read_text()
    expect_rows_of_the_first_run(text)
    assert text.count("<- chosen") == 2


def expect_rows_of_the_first_run(log: str) -> None:
    """The page's table of the first run is what the run reports."""
    page = (ROOT / "docs" / "guides" / "Induction_Nozzle.md").read_text()
    for second in (1, 6, 16):
        (line, *_) = [line for line in log.splitlines() if f"calibration: heat for {second} s" in line]
        reference_c = float(line.rpartition("reference ")[2].split()[0])
        (row,) = [row for row in page.splitlines() if row.strip().startswith(f"| {second} s |")]
        assert float(row.split("|")[2].split()[0]) == pytest.approx(reference_c, abs=3.0)


@pytest.mark.parametrize("page", ["Daily_Use.md", "Tuning.md"])
def test_the_consoles_commands_of_a_day(simulate: Simulate, tmp_path: Path, page: str) -> None:
    data = PrinterData(tmp_path / "data", ROOT)
    data.prepare(CONFIG)
    for block in blocks(page, "gcode"):
        run = simulate(f"G28\n{block}\n", config=data.config)
        assert run.status == 0, f"{block}: {run.stderr}"


def test_the_upload_of_the_page_prints(tmp_path: Path) -> None:
    (tmp_path / "part.gcode").write_text(square(1))
    (command,) = blocks("Daily_Use.md", "sh")
    with SimulatedPrinter(tmp_path / "data", "--speed", "10") as printer:
        printer.wait_start()
        shell(command.replace("7125", str(printer.port)), tmp_path, os.environ["PATH"])
        job = printer.wait("the print", lambda: finished_job(printer, "part.gcode"), 60.0)
    assert job["status"] == "completed"
