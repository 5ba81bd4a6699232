"""scripts/setup.sh and install.sh on machines that lack something, or where another program holds the locks of apt.

Each runs in a copy of the checkout's scripts with a PATH of the test's own: apt-get, sudo and systemctl are played.
"""

from __future__ import annotations

import configparser
import hashlib
import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

import build_deb

ROOT = Path(__file__).resolve().parents[2]

TOOLS = (
    "bash",
    "cat",
    "cp",
    "cut",
    "dirname",
    "env",
    "flock",
    "grep",
    "ln",
    "mkdir",
    "mktemp",
    "readlink",
    "rm",
    "sed",
    "sha256sum",
    "uname",
)
ID = "#!/bin/sh\ncase $1 in -u) echo {uid} ;; -un) echo anna ;; -nG) echo dialout ;; esac\n"
# Both note how they were called. apt-get fails with $APT_SAYS as often as $APT_FAILS says.
APT_GET = """#!/bin/sh
echo "apt-get $*" >>"$CALLS"
tries=$(grep -c '^apt-get' "$CALLS")
if [ "$tries" -le "${APT_FAILS:-0}" ]; then echo "$APT_SAYS" >&2; exit 100; fi
"""
NOTED = '#!/bin/sh\necho "{name} $*" >>"$CALLS"\n'

LISTS_LOCK = (
    "E: Could not get lock /var/lib/apt/lists/lock. It is held by process 4711 (apt-get)\n"
    "E: Unable to lock directory /var/lib/apt/lists/"
)
OLD_DPKG_LOCK = "E: Could not get lock /var/lib/dpkg/lock - open (11: Resource temporarily unavailable)"
NO_RIGHT = "E: Could not open lock file /var/lib/dpkg/lock-frontend - open (13: Permission denied)"


class Computer:
    """A checkout's scripts, and the programs that a computer has."""

    def __init__(self, folder: Path, uid: int) -> None:
        self.checkout, self.bin, self.home = folder / "checkout", folder / "bin", folder / "home"
        self.calls_file = folder / "calls"
        for made in (self.checkout / "scripts", self.bin, self.home):
            made.mkdir(parents=True)
        for name in ("setup.sh", "install.sh"):
            shutil.copy(ROOT / "scripts" / name, self.checkout / "scripts")
        for path in (*ROOT.glob("requirements*.txt"), ROOT / "config"):
            (shutil.copytree if path.is_dir() else shutil.copy)(path, self.checkout / path.name)
        for name in TOOLS:
            found = shutil.which(name)
            assert found is not None, name
            (self.bin / name).symlink_to(found)
        self.program("id", ID.format(uid=uid))
        self.calls_file.touch()

    def program(self, name: str, text: str = NOTED) -> None:
        """A program on PATH; without a text one that only notes its call."""
        path = self.bin / name
        path.write_text(text.format(name=name) if text == NOTED else text)
        path.chmod(0o755)

    def with_environment(self) -> None:
        """A finished .venv, whose Python notes its calls, and Moonraker's."""
        python = self.checkout / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(NOTED.format(name="python"))
        python.chmod(0o755)
        moonraker = self.checkout / ".moonraker"
        (moonraker / "bin").mkdir(parents=True)
        shutil.copy(python, moonraker / "bin" / "moonraker")
        pinned = (self.checkout / "requirements-moonraker.txt").read_bytes()
        (moonraker / ".ferrite").write_text(hashlib.sha256(pinned).hexdigest())

    def run(self, script: str, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
        clean = {
            "PATH": str(self.bin),
            "HOME": str(self.home),
            "CALLS": str(self.calls_file),
            "TMPDIR": "/tmp",
        }
        return subprocess.run(
            [self.checkout / "scripts" / script, *options], env=clean | environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip

    def calls(self, name: str) -> list[str]:
        """Arguments of the calls of a program, one text each."""
        lines = self.calls_file.read_text().splitlines()
        return [line.removeprefix(name).strip() for line in lines if line.split()[:1] == [name]]


@pytest.fixture
def root_computer(tmp_path: Path) -> Computer:
    """Of root's, without a compiler, with an apt-get and a sleep that takes no time."""
    computer = Computer(tmp_path, uid=0)
    computer.program("apt-get", APT_GET)
    computer.program("sleep")
    computer.with_environment()
    return computer


@pytest.mark.parametrize("says", [LISTS_LOCK, OLD_DPKG_LOCK])
def test_setup_waits_for_another_apt_and_says_so(root_computer: Computer, says: str) -> None:
    done = root_computer.run("setup.sh", "demo", APT_FAILS="20", APT_SAYS=says)
    assert done.returncode == 0, done.stderr
    waits = [line for line in done.stdout.splitlines() if "waiting for another program" in line]
    # 20 tries, 2 s apart: noted at 0 and 30 s, with apt's own word for the lock
    assert all(text in line for text, line in zip(("0 of at most 300 s", "30 of at"), waits, strict=True))
    assert all(says.splitlines()[0].removeprefix("E: ") in line for line in waits)
    assert sum(map(int, root_computer.calls("sleep"))) == 40
    assert root_computer.calls("apt-get")[-2] == "update"
    assert root_computer.calls("apt-get")[-1].startswith("install -y --no-install-recommends gcc")
    assert any("pip install" in call for call in root_computer.calls("python")), "the set-up goes on"


def test_setup_gives_up_after_five_minutes(root_computer: Computer) -> None:
    done = root_computer.run("setup.sh", "demo", APT_FAILS="1000", APT_SAYS=LISTS_LOCK)
    assert done.returncode == 1
    assert sum(map(int, root_computer.calls("sleep"))) == 300
    assert done.stderr.count("\n") == 1
    assert "held apt's lock for 300 s (Could not get lock /var/lib/apt/lists/lock" in done.stderr
    assert set(root_computer.calls("apt-get")) == {"update"}
    assert root_computer.calls("python") == []


def test_the_five_minutes_are_for_all_locks_together(root_computer: Computer) -> None:
    """The second half is spent on the lock that apt-get install meets."""
    busy_from = '[ "$1" = install ] && tries=0\n'
    root_computer.program("apt-get", APT_GET.replace("if [", busy_from + "if [", 1))
    done = root_computer.run("setup.sh", "demo", APT_FAILS="75", APT_SAYS=OLD_DPKG_LOCK)
    assert done.returncode == 1
    assert sum(map(int, root_computer.calls("sleep"))) == 300
    assert root_computer.calls("apt-get").count("update") == 76


@pytest.mark.parametrize("says", ["E: Temporary failure resolving 'deb.debian.org'", NO_RIGHT])
def test_what_waiting_does_not_cure_is_not_waited_for(root_computer: Computer, says: str) -> None:
    done = root_computer.run("setup.sh", "demo", APT_FAILS="1000", APT_SAYS=says)
    assert done.returncode == 1
    assert root_computer.calls("sleep") == []
    assert says in done.stderr, "apt's own words"
    assert "could not install them" in done.stderr


def packages_of(computer: Computer, level: str) -> set[str]:
    """What a level wants apt to install."""
    assert computer.run("setup.sh", level, APT_FAILS="1000", APT_SAYS="E: no network").returncode == 1
    command, *words = computer.calls("apt-get")[-1].split()
    assert command == "install"
    return {word for word in words if not word.startswith("-")}


def test_only_the_levels_of_browser_and_flash_ask_for_their_programs(root_computer: Computer) -> None:
    test, browser, flash = (packages_of(root_computer, level) for level in ("test", "browser", "flash"))
    assert "clang" in test and not {"chromium", "avrdude", "openocd"} & test
    assert "chromium" in browser and not {"avrdude", "gcc-avr"} & browser
    assert {"avrdude", "openocd"} <= flash and "chromium" not in flash


def test_studies_have_a_list_of_their_own_that_serves_the_demo_too(root_computer: Computer) -> None:
    def installed() -> list[str]:
        calls = [call for call in root_computer.calls("python") if "pip install" in call and " -r " in call]
        return [call.split(" -r ")[-1] for call in calls]

    for level, lists in (
        ("demo", ["sim", "data"]),
        ("study", ["sim", "data", "study", "data"]),
        ("demo", ["sim", "data", "study", "data"]),
    ):
        assert root_computer.run("setup.sh", level).returncode == 0
        assert installed() == [f"requirements-{name}.txt" for name in lists]


# ---------------------------------------------------------------- install.sh


@pytest.fixture
def anna(tmp_path: Path) -> Computer:
    """A user's computer with apt, systemd and sudo, and without a compiler."""
    computer = Computer(tmp_path, uid=1000)
    computer.program("apt-get", APT_GET)
    for name in ("systemctl", "sudo"):
        computer.program(name)
    return computer


def refused(computer: Computer, *options: str) -> str:
    """What install.sh says, in one line; and it has changed nothing."""
    done = computer.run("install.sh", *options)
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    assert list(computer.home.iterdir()) == []
    assert not (computer.checkout / ".venv").exists()
    return done.stderr


@pytest.fixture
def anna_with_all(anna: Computer) -> Computer:
    """What is needed is there; a front end has been unpacked."""
    for name in ("gcc", "ip", "loginctl"):
        anna.program(name)
    anna.with_environment()
    (anna.home / "mainsail").mkdir()
    (anna.home / "mainsail" / "index.html").touch()
    return anna


def test_install_where_sudo_refuses_says_what_to_do(anna: Computer) -> None:
    anna.program("sudo", "#!/bin/sh\necho 'sudo: a password is required' >&2\nexit 1\n")
    errors = refused(anna)
    assert "sudo gives anna no rights here" in errors
    assert "--no-start writes the files and says what root is to do" in errors


@pytest.mark.parametrize("program", ["systemctl", "sudo"])
@pytest.mark.parametrize("options", [(), ("--no-packages",), ("--uninstall",)])
def test_install_without_systemd_or_sudo_says_so(
    anna: Computer, program: str, options: tuple[str, ...]
) -> None:
    (anna.bin / program).unlink()
    errors = refused(anna, *options)
    assert f"no {program}" in errors
    assert "--no-start" in errors


def test_install_where_systemd_is_there_but_does_not_run_says_so(anna: Computer) -> None:
    anna.program("systemctl", "#!/bin/sh\necho offline\nexit 1\n")
    errors = refused(anna)
    assert "systemd does not run here" in errors and "--no-start writes the files" in errors


def test_install_without_a_compiler_and_without_the_right_to_install_one_names_it(anna: Computer) -> None:
    anna.program("sudo", '#!/bin/sh\n[ "$2" = true ]\n')
    anna.program("apt-get", "#!/bin/sh\nexit 1\n")
    done = anna.run("install.sh", "--front-end", "none")
    assert done.returncode == 1
    assert "could not install them; run: sudo apt-get install gcc" in done.stderr
    assert not (anna.home / "printer_data").exists()


def test_install_sets_up_host_moonraker_and_front_end_as_services(anna_with_all: Computer) -> None:
    anna = anna_with_all
    done = anna.run("install.sh")
    assert done.returncode == 0, done.stderr
    data, made = anna.home / "printer_data", anna.home / "printer_data" / "systemd"
    services = ["front-end.service", "klipper.service", "moonraker.service"]
    assert sorted(path.name for path in made.iterdir()) == services
    host = (made / "klipper.service").read_text()
    assert f'"{anna.checkout}/klippy/klippy.py" "{data}/config/printer.cfg"' in host
    assert "User=anna\n" in host and "LimitRTPRIO=1\nLimitMEMLOCK=infinity\n" in host
    front_end = (made / "front-end.service").read_text()
    assert f'"{anna.home}/mainsail" --port 80 --moonraker 7125' in front_end
    assert "AmbientCapabilities=CAP_NET_BIND_SERVICE" in front_end
    calls = [call.removeprefix("-n ") for call in anna.calls("sudo")]
    copied = " ".join(str(made / name) for name in services)
    assert calls[-3:] == [
        f"cp {copied} /etc/systemd/system/",
        "systemctl daemon-reload",
        "systemctl enable --now klipper moonraker front-end",
    ]
    assert any("-r requirements.txt" in call for call in anna.calls("python"))
    assert (anna.home / "klipper" / "klippy").resolve() == anna.checkout / "klippy"
    assert (anna.home / "klippy-env" / "bin" / "python").resolve().parent == anna.checkout / ".venv" / "bin"
    conf = (data / "config" / "moonraker.conf").read_text()
    for text in (
        f"klippy_uds_address: {data}/comms/klippy.sock",
        "*://my.mainsail.xyz",
        "*://app.fluidd.xyz",
        "[update_manager mainsail]\ntype: web",
    ):
        assert text in conf
    assert os.access(data / "config" / "printer.cfg", os.R_OK)


def test_systemd_takes_the_units_of_the_installer_and_of_the_package(
    anna_with_all: Computer, tmp_path: Path
) -> None:
    anna_with_all.program("id", ID.format(uid=1000).replace("anna", "root"))  # a user of this computer
    assert anna_with_all.run("install.sh").returncode == 0
    units = sorted((anna_with_all.home / "printer_data" / "systemd").iterdir())
    start = tmp_path / "start"
    start.touch(mode=0o755)
    units.append(tmp_path / "ferrite@root.service")
    units[-1].write_text(build_deb.UNIT.replace("/usr/lib/ferrite/start", str(start)))
    known = {
        "Unit": {"description", "documentation", "after", "wants"},
        "Service": {"user", "execstart", "restart", "restartsec", "limitrtprio", "limitmemlock", "ambientcapabilities"},
        "Install": {"wantedby"},
    }  # fmt: skip
    for unit in units:
        parser = configparser.ConfigParser(interpolation=None)
        parser.read_string(unit.read_text())
        assert set(parser.sections()) == set(known), unit.name
        for section, options in known.items():
            assert set(parser[section]) <= options, unit.name
        program = shlex.split(parser["Service"]["ExecStart"])[0]
        assert os.access(program, os.X_OK), f"{unit.name}: {program}"
    if shutil.which("systemd-analyze"):
        command = ["systemd-analyze", "verify", *map(str, units)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr


def test_install_asks_for_the_group_of_serial_ports(anna_with_all: Computer) -> None:
    anna_with_all.program("id", ID.format(uid=1000).replace("dialout", "users"))
    assert anna_with_all.run("install.sh").returncode == 0
    assert any("usermod -a -G dialout anna" in call for call in anna_with_all.calls("sudo"))


def test_install_without_a_network_goes_on_with_a_plain_dashboard(anna_with_all: Computer) -> None:
    python = anna_with_all.checkout / ".venv" / "bin" / "python"
    python.write_text(python.read_text() + "case $1 in */fetch_pages.py) exit 1 ;; esac\n")
    done = anna_with_all.run("install.sh", "--front-end", "fluidd")
    assert done.returncode == 0, done.stderr
    assert (
        "unpack https://github.com/fluidd-core/fluidd/releases/latest/download/fluidd.zip into" in done.stdout
    )
    assert "http://app.fluidd.xyz" in done.stdout
    unit = anna_with_all.home / "printer_data" / "systemd" / "front-end.service"
    assert f'"{anna_with_all.checkout}/klippy/webhooks/dashboard" --port 80' in unit.read_text()


def test_install_keeps_what_is_there_and_uninstall_removes_what_it_made(anna_with_all: Computer) -> None:
    anna = anna_with_all
    (anna.home / "klipper").mkdir()
    assert "is there already and stays" in anna.run("install.sh").stdout
    config = anna.home / "printer_data" / "config"
    for name in ("printer.cfg", "moonraker.conf"):
        (config / name).write_text("mine")
    assert anna.run("install.sh").returncode == 0
    done = anna.run("install.sh", "--uninstall")
    assert done.returncode == 0, done.stderr
    assert {(config / name).read_text() for name in ("printer.cfg", "moonraker.conf")} == {"mine"}
    assert (anna.home / "klipper").is_dir() and not (anna.home / "klippy-env").is_symlink()
    assert any(call.endswith("disable --now front-end") for call in anna.calls("sudo"))


def test_install_says_which_service_did_not_start(anna_with_all: Computer) -> None:
    anna_with_all.program("sudo", '#!/bin/sh\ncase "$*" in *"enable --now"*) exit 1 ;; esac\n')
    done = anna_with_all.run("install.sh")
    assert done.returncode == 1
    assert (
        done.stderr == "install: a service did not start; see: systemctl status klipper moonraker front-end\n"
    )


# ---------------------------------------------------------------- .ci/run


@pytest.mark.parametrize("failing", ["none", "test-browser", "test-flash", "test"])
def test_continuous_integration_runs_everything_and_the_main_tests_last(tmp_path: Path, failing: str) -> None:
    computer = Computer(tmp_path, uid=0)
    computer.program("make", NOTED.format(name="make") + f'[ "$1" != {failing} ]\n')
    (computer.checkout / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", computer.checkout / ".ci")
    done = computer.run("../.ci/run")
    assert computer.calls("make") == ["test-browser", "test-flash", "test"]
    assert done.returncode == (0 if failing == "none" else 1)
