"""scripts/plan_temperature.py: what it writes, and what it says about wrong input."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

from path_rig import CONFIG, LINES

ROOT = Path(__file__).resolve().parents[3]


def tool(
    tmp_path: Path, *options: str, config: str = CONFIG, gcode: str = LINES
) -> subprocess.CompletedProcess[str]:
    (tmp_path / "printer.cfg").write_text(config)
    (tmp_path / "part.gcode").write_text(gcode)
    command = [ROOT / "scripts" / "plan_temperature.py", tmp_path / "part.gcode", *options]
    if "--config" not in options:
        command += ["--config", tmp_path / "printer.cfg"]
    return subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, check=False)


def test_the_tool_writes_a_page_figures_and_a_file_with_commands(tmp_path: Path) -> None:
    page, figures, planned = tmp_path / "plan.html", tmp_path / "plan.json", tmp_path / "planned.gcode"
    done = tool(
        tmp_path,
        "--report",
        str(page),
        "--json",
        str(figures),
        "--emit",
        str(planned),
        "--heater",
        "induction",
    )
    assert done.returncode == 0, done.stderr
    assert "welded" in done.stdout
    found = json.loads(figures.read_text())
    assert found["moves"] == 4 and found["length_mm"] == pytest.approx(160.0)
    text = page.read_text()
    assert "@" + "DATA@" not in text and '"ways"' in text and "http" not in text
    emitted = planned.read_text().split("\n")
    plain = [line for line in emitted if not line.endswith(";planned")]
    assert plain == LINES.split("\n")  # nothing else is changed
    targets = [int(line.split()[1][1:]) for line in emitted if line.endswith(";planned")]
    assert targets and all(170 <= t <= 300 for t in targets)


@pytest.mark.parametrize("heater", ["induction", "slow"])
def test_what_is_written_keeps_away_from_max_temp(tmp_path: Path, heater: str) -> None:
    """At which the printer shuts down."""
    config = CONFIG.replace("300", "245").replace(
        "features:\n  external perimeter: 235", "interface_temp: 230"
    )
    planned = tmp_path / "planned.gcode"
    lines = (
        LINES.replace("M104.1 S230\n", "").replace("S240", "S225").replace("E2.0", "E0.2")
    )  # slow enough for either heater
    done = tool(
        tmp_path, "--emit", str(planned), "--heater", heater, "--step", "0.5", config=config, gcode=lines
    )
    assert done.returncode == 0, done.stderr
    targets = [
        int(line.split()[1][1:]) for line in planned.read_text().split("\n") if line.endswith(";planned")
    ]
    assert targets and max(targets) <= 240, targets


@pytest.mark.parametrize(
    ("options", "config", "gcode", "words"),
    [
        (["--set", "material=WOOD"], CONFIG, LINES, "material"),
        (["--set", "material"], CONFIG, LINES, "OPTION=VALUE"),
        (["--set", "smoth_time=1"], CONFIG, LINES, "did you mean smooth_time"),
        (["--set", "nosuch=1"], CONFIG, LINES, "no such option"),
        (["--step", "nan"], CONFIG, LINES, "0.1 to 50"),
        (["--step", "-3"], CONFIG, LINES, "0.1 to 50"),
        ([], CONFIG.replace("235", "warm"), LINES, "'warm' is not a number"),
        ([], CONFIG, "G28\nM104 S200\n", "no line of it extrudes"),
        (
            [],
            CONFIG,
            LINES + "M220 S90\nM106 S1\nM104.1 S200\nSET_SEGMENT_TEMPERATURE TEMP=hot\n",
            "line 23: 'SET_SEGMENT",
        ),
        ([], CONFIG, LINES + "G1 X1000000 E5\n", "line 20: 'G1 X1000000 E5': there is no printer so large"),
        (
            ["--emit", "out"],
            CONFIG + "[extruder1]\n",
            LINES + "T1\nG1 X5 E2\n",
            "line 20: this tool has a nozzle",
        ),
        (
            [],
            CONFIG.replace("300", "190"),
            LINES,
            "'M104 S240': Requested temperature (240.0) out of range (0.0:190.0)",
        ),
        (["--config", "/nonexistent.cfg"], CONFIG, LINES, "/nonexistent.cfg"),
        ([], CONFIG.replace("max_accel: 3000", "max_accel: -1"), LINES, "max_accel"),
    ],
)
def test_wrong_input_is_reported_in_a_line(
    tmp_path: Path, options: list[str], config: str, gcode: str, words: str
) -> None:
    done = tool(tmp_path, *options, config=config, gcode=gcode)
    assert done.returncode == 2
    assert words in done.stderr and "Traceback" not in done.stderr


def shown_heights(page: Path) -> list[float]:
    found = re.search(r'"heights": (\[[^\]]*\])', page.read_text())
    assert found is not None
    return list(json.loads(found[1]))


@pytest.mark.parametrize("marked", [True, False])
def test_a_vase_is_shown_in_layers_although_its_path_rises_all_the_time(tmp_path: Path, marked: bool) -> None:
    """Six turns of 48 moves, 0.2 mm each: by the slicer's marks a layer a turn, without them steps of 0.04 mm."""
    lines = ["M83", "M104 S240", "G1 Z0.2 F3000"]
    for number in range(6 * 48):
        if marked and number % 48 == 0:
            lines.append(";LAYER_CHANGE")
        angle = 2.0 * math.pi * number / 48
        lines.append(
            f"G1 X{50 + 20 * math.cos(angle):.3f} Y{50 + 20 * math.sin(angle):.3f} Z{0.2 + number / 240:.4f} E0.1"
        )
    done = tool(tmp_path, "--report", str(tmp_path / "page.html"), gcode="\n".join(lines))
    assert done.returncode == 0, done.stderr
    heights = shown_heights(tmp_path / "page.html")
    steps = [b - a for a, b in itertools.pairwise(heights)]
    assert len(heights) == (6 if marked else 29)  # 288 moves of 1/240 mm, ten to a step
    assert steps == pytest.approx([0.2 if marked else 0.0417] * len(steps), abs=0.01)


def test_a_file_may_be_planned_in_place(tmp_path: Path) -> None:
    """--emit to the file that is read: the same as to another one; a failure leaves what was there."""
    other, part = tmp_path / "other.gcode", tmp_path / "part.gcode"
    assert tool(tmp_path, "--heater", "induction", "--emit", str(other)).returncode == 0
    done = tool(tmp_path, "--heater", "induction", "--emit", str(part))
    assert done.returncode == 0, done.stderr
    assert part.read_bytes() == other.read_bytes() != b""
    assert part.stat().st_mode == other.stat().st_mode
    done = tool(tmp_path, "--emit", str(part), gcode="G28\n")
    assert done.returncode == 2 and part.read_text() == "G28\n"
    assert {path.name for path in tmp_path.iterdir()} == {"printer.cfg", "part.gcode", "other.gcode"}
