"""The project's own checks find what they are there to find, and leave alone what is right."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import check_formats
import check_layers
import check_paths
import check_words


def put(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


# --- layers


@pytest.mark.parametrize(
    "files",
    [
        {"reactor.py": "import toolhead\n", "toolhead.py": ""},
        {"mcu.py": "def f():\n    from extras import heaters\n", "extras/heaters.py": ""},
        {"thermal/plan/set_points.py": "from reactor import Reactor\n", "reactor.py": ""},
        {"extras/fan.py": "from simulation.world import World\n", "simulation/world/__init__.py": ""},
        {"extras/a/b.py": "import klippy\n", "klippy.py": ""},
    ],
)
def test_an_import_from_a_higher_layer_is_found(files: dict[str, str], tmp_path: Path) -> None:
    offences = list(check_layers.check_python(put(tmp_path, files)))
    assert len(offences) == 1
    assert "higher layer" in offences[0].text


def test_imports_downward_and_sideways_are_fine(tmp_path: Path) -> None:
    files = {
        "toolhead.py": "import reactor, stepper\nfrom kinematics import cartesian\nimport math, numpy\n",
        "stepper.py": "",
        "reactor.py": "import select\n",
        "kinematics/cartesian.py": "import stepper\n",
        "extras/probe.py": "from . import manual_probe\nfrom .. import toolhead\nimport toolhead\n",
        "extras/manual_probe.py": "from thermal import records\n",
        "thermal/records.py": "from dataclasses import dataclass\n",
    }
    assert list(check_layers.check_python(put(tmp_path, files))) == []


def test_thermal_may_use_the_standard_library_only(tmp_path: Path) -> None:
    files = {
        "thermal/models/heat_loss.py": "import math\nimport numpy as np\n",
        "thermal/identification/fit_sensing.py": "import numpy as np\n",
    }
    (offence,) = check_layers.check_python(put(tmp_path, files))
    assert offence.path.name == "heat_loss.py"
    assert offence.line == 2


def test_what_runs_in_the_printer_may_not_need_an_offline_fit(tmp_path: Path) -> None:
    files = {
        "thermal/identification/fit_sensing.py": "import numpy\n",
        "thermal/models/heat_loss.py": "from thermal.identification import fit_sensing\n",
        "extras/calibrate.py": "import thermal.identification.fit_sensing\n",
        "thermal/control/pid.py": "from ..identification.fit_sensing import fit_line\n",
    }
    found = {o.path.name for o in check_layers.check_python(put(tmp_path, files))}
    assert found == {"heat_loss.py", "calibrate.py", "pid.py"}


def test_a_module_without_a_layer_is_found(tmp_path: Path) -> None:
    (offence,) = check_layers.check_python(put(tmp_path, {"newcomer.py": ""}))
    assert "in no layer" in offence.text


def test_pure_c_may_not_know_the_board_and_nobody_a_port(tmp_path: Path) -> None:
    files = {
        "guard.c": '#include <stdint.h>\n#include "guard.h"\n#include "sched.h"\n',
        "phase.h": '#include "board/bridge_pwm.h"\n',
        "stepper.c": '#include "board/gpio.h"\n#include "simulator/sim_mcu.h"\n',
        "simulator/sim_pins.c": '#include "simulator/sim_mcu.h"\n#include "sched.h"\n',
    }
    found = {(o.path.name, o.line) for o in check_layers.check_c(put(tmp_path, files))}
    assert found == {("guard.c", 3), ("phase.h", 1), ("stepper.c", 2)}


def test_a_folder_of_too_many_files_is_found_and_those_of_its_folders_do_not_count() -> None:
    names = [f"klippy/thermal/f{n}.py" for n in range(check_layers.FILES_MAX)]
    assert list(check_layers.check_folders([*names, "klippy/thermal/plan/one.py"])) == []
    (offence,) = check_layers.check_folders([*names, "klippy/thermal/one.py"])
    assert offence.path == Path("klippy/thermal")
    assert (
        list(check_layers.check_folders([name.replace("klippy/thermal", "src") for name in names * 2])) == []
    )


# --- message formats


@pytest.fixture
def dictionary(tmp_path: Path) -> check_formats.Dictionary:
    path = tmp_path / "ferrite.dict"
    commands = {"queue_step oid=%c interval=%u": 1, "config_adc oid=%c pin=%u": 2, "query_adc oid=%c": 3}
    path.write_text(json.dumps({"commands": commands, "responses": {"adc_state oid=%c value=%hu": 4}}))
    return check_formats.Dictionary(path)


def complaints(code: str, dictionary: check_formats.Dictionary, folder: Path) -> list[str]:
    (folder / "host").mkdir()
    (folder / "host" / "plugin.py").write_text(code)
    asks = check_formats.collect(folder / "host")
    return [text for ask in asks if (text := dictionary.complaint(ask)) is not None]


@pytest.mark.parametrize(
    "code",
    [
        'mcu.lookup_command("queue_step oid=%c interval=%u", cq=q)',
        'QUEUE = "queue_step oid=%c interval=%u"\nmcu.lookup_command(QUEUE)',
        'mcu.lookup_query_command("query_adc oid=%c", "adc_state oid=%c value=%hu", oid=1)',
        'mcu.register_response(self.on_state, "adc_state", self.oid)',
        'mcu.add_config_cmd("config_adc oid=%d pin=%s" % (oid, pin))',
        'mcu.add_config_cmd(f"config_adc oid={oid}" f" pin={pin}", is_init=True)',
        'mcu.try_lookup_command("not_everywhere oid=%c")',
        "def lookup_command(self, msgformat):\n    return self.parser.lookup_command(msgformat)",
        'start = f"queue_step oid={oid} interval={{i}}"\nmcu.add_config_cmd(start.format(i=3))',
        'for n, f in (("adc_state", a), ("adc_state", b)):\n    mcu.register_response(f, n)',
        'for f in ("queue_step oid=%c interval=%u", "query_adc oid=%c"):\n    mcu.lookup_command(f)',
    ],
)
def test_a_format_the_firmware_has_is_fine(
    code: str, dictionary: check_formats.Dictionary, tmp_path: Path
) -> None:
    assert complaints(code, dictionary, tmp_path) == []


@pytest.mark.parametrize(
    ("code", "complaint"),
    [
        (
            'mcu.lookup_command("queue_step oid=%c interval=%hu")',
            "the firmware has 'queue_step oid=%c interval=%u'",
        ),
        ('mcu.lookup_command("queue_jump oid=%c")', "no command 'queue_jump'"),
        ('mcu.try_lookup_command("query_adc oid=%u")', "asks for"),
        ('mcu.lookup_query_command("query_adc oid=%c", "adc_state oid=%c", oid=1)', "asks for"),
        ('mcu.register_response(cb, "adc_report", oid)', "no response 'adc_report'"),
        ('mcu.add_config_cmd("config_adc pin=%s oid=%d" % (pin, oid))', "does not fill in"),
        ('mcu.add_config_cmd(f"config_adc oid={oid}")', "does not fill in"),
        (
            'for n, f in (("adc_state", a), ("other", b)):\n    mcu.register_response(f, n)',
            "no response 'other'",
        ),
        ("mcu.lookup_command(self.formats[i])", "not a text that can be checked"),
        ('formats = [a, "query_adc oid=%c"]\nfor f in (a,):\n    mcu.lookup_command(f)', "not a text"),
    ],
)
def test_a_format_the_firmware_lacks_is_found(
    code: str, complaint: str, dictionary: check_formats.Dictionary, tmp_path: Path
) -> None:
    (found,) = complaints(code, dictionary, tmp_path)
    assert complaint in found


# --- private places


def places_in(text: str, folder: Path) -> int:
    path = folder / "file.txt"
    path.write_text(text)
    return len(list(check_paths.offences(path, check_paths.private_places())))


@pytest.mark.parametrize(("place", "owner"), [("home", "anna/"), ("Users", "anna/"), ("root", "")])
def test_a_home_directory_is_found(place: str, owner: str, tmp_path: Path) -> None:
    assert places_in(f"open('/{place}/{owner}printer.cfg')", tmp_path) == 1


def test_this_checkout_is_found(root: Path, tmp_path: Path) -> None:
    assert places_in(f"cd {root}/src\n", tmp_path) == 1


def test_shared_and_relative_places_are_fine(tmp_path: Path) -> None:
    text = (
        "/home/pi/printer_data /usr/bin/gcc /tmp/klippy.log out/root/x gcode/home/x ~/work/x /dev/ttyACM0\n"
    )
    assert places_in(text, tmp_path) == 0


def test_the_form_of_other_firmware_is_met_to_the_letter_only(tmp_path: Path) -> None:
    path = tmp_path / "built.dict"
    path.write_text(
        json.dumps({"commands": {"query_analog_in oid=%c clock=%u values=%u": 1}, "responses": {}})
    )
    built = check_formats.Dictionary(path)
    other = check_formats.ALSO_SPOKEN["query_analog_in"]
    asked = [other, other.replace("rest", "pause")]
    (met,) = complaints("\n".join(f"mcu.try_lookup_command({text!r})" for text in asked), built, tmp_path)
    assert "pause" in met


# --- words


def word_offences(text: str, folder: Path, name: str = "page.md") -> list[str]:
    path = folder / name
    path.write_text(text)
    return list(check_words.offences(path))


@pytest.mark.parametrize(
    "text",
    [
        "A calm nozzle.",
        "Found in source 001.",
        "The least drive.",
        "| a road laid | on a pile |\n",
        "## Who told whom",
    ],
)
def test_a_private_word_is_found(text: str, tmp_path: Path) -> None:
    assert word_offences(text, tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "At least 20 °C, by least squares.",
        "`induction_calm` and `control: practical` are names.",
        "See [the plan](calm.md).",
        "```\ncontrol: practical\n#practical_turn: 0.3\n```\n",
        "The layers of a lottery, the player's plot.",
    ],
)
def test_plain_english_and_names_of_the_program_are_fine(text: str, tmp_path: Path) -> None:
    assert word_offences(text, tmp_path) == []


@pytest.mark.parametrize(
    "code", ["told_s = 1", "class CalmNozzle: ...", "x = 1  # nobody heard", "int most_w;"]
)
def test_names_and_comments_of_code_are_words(code: str, tmp_path: Path) -> None:
    assert len(word_offences(code, tmp_path, "file.py")) == 1
    assert len(word_offences("x = 1", tmp_path, "the_wishes.py")) == 1


def test_a_documented_name_is_allowed_in_its_rooms_only(root: Path) -> None:
    line = ["fade_start = 1.0"]
    assert list(check_words.words(root / "klippy" / "extras" / "bed_mesh" / "config.py", line)) == []
    assert list(check_words.words(root / "klippy" / "toolhead.py", line))
    rooms = [room for _, rooms in check_words.DOCUMENTED for room in rooms.split()]
    rooms += [*check_words.ROOMS_CHECKED, *check_words.ROOMS_NOT_YET]
    assert [room for room in rooms if not (root / room).exists()] == []


def test_a_long_sentence_is_found_wherever_its_lines_end(tmp_path: Path) -> None:
    long = " ".join(["word"] * 13)
    (found,) = word_offences(f"# Title\n\nShort. So {long}\n{long}. Short.\n", tmp_path)
    assert "27 words" in found
    assert word_offences(f"So {long}. Also {long}.\n\n| {long} | {long} |\n", tmp_path) == []


# --- types


def test_less_than_a_tenth_of_the_arguments_in_extras_is_of_any_type(root: Path) -> None:
    """Roles (roles.py, ConfigWrapper, GCodeCommand) say what a section needs; Any says nothing."""
    arguments = [
        argument
        for path in (root / "klippy" / "extras").rglob("*.py")
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef)
        for argument in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
        if argument.arg not in ("self", "cls")
    ]
    untyped = [a for a in arguments if a.annotation is not None and ast.unparse(a.annotation) == "Any"]
    assert len(untyped) < 0.1 * len(arguments)
