"""The file VERSION is the one home of the version: host, firmware and package read it."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import util
from doc_rig import ROOT

VERSION = (ROOT / "VERSION").read_text(encoding="utf-8").strip()


def test_a_checkout_has_its_commit_behind_the_version() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)
    assert re.fullmatch(
        rf"{re.escape(VERSION)}-[0-9a-f]{{7,}}(-dirty)?", util.get_software_version(str(ROOT))
    )


def test_without_a_checkout_the_version_stands_alone(tmp_path: Path) -> None:
    (tmp_path / "VERSION").write_text("1.2.3\n")
    assert util.get_software_version(str(tmp_path)) == "1.2.3"


def test_the_firmware_is_built_with_the_hosts_version() -> None:
    command = ["make", "-s", "-f", "src/build.mk", "--eval", "show: ; @echo '$(FERRITE_VERSION)'", "show"]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert made.stdout.strip() == util.get_software_version(str(ROOT))


def test_the_package_takes_its_version_from_the_file_and_brings_it_along() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"file": "VERSION"}
    assert "VERSION" in project["tool"]["setuptools"]["package-data"]["ferrite"]


def test_the_changes_of_this_version_are_listed() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"(?m)^## (\S+)", changelog)[0] == VERSION
