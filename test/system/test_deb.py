"""The Debian package, installed into a bare root."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deb")
    done = run(sys.executable, str(ROOT / "scripts" / "build" / "build_deb.py"), "--out", str(folder))
    return Path(done.stdout.strip())


def run(*command: str) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_the_package_installs_into_a_bare_root_runs_there_and_leaves_nothing(
    package: Path, tmp_path: Path
) -> None:
    root, database = tmp_path / "root", tmp_path / "root" / "var/lib/dpkg"
    for name in ("info", "updates", "triggers"):
        (database / name).mkdir(parents=True)
    for name in ("status", "available"):
        (database / name).touch()
    # Its dependencies are this computer's: no network. Scripts of the package run without entering the root.
    dpkg = ["dpkg", f"--root={root}", "--force-depends", "--force-script-chrootless", "--force-not-root"]
    run(*dpkg, "--install", str(package))
    assert "Status: install ok installed" in (database / "status").read_text()
    programs, lib = root / "usr/bin", root / "usr/lib/ferrite"
    assert list((lib / "out" / "chelper").glob("*.so")), "the helper was built"
    assert "usage: klippy.py" in run(str(programs / "ferrite-klippy"), "--help").stdout
    checked = run(str(programs / "ferrite-check-config"), str(lib / "config/example-induction-f334.cfg"))
    assert "example-induction-f334.cfg" in checked.stdout
    unit = (root / "usr/lib/systemd/system/ferrite@.service").read_text()
    assert "ExecStart=/usr/lib/ferrite/start" in unit and os.access(lib / "start", os.X_OK)
    run(*dpkg, "--remove", "ferrite")
    assert not lib.exists() and not list(programs.iterdir() if programs.exists() else ())


def test_the_package_needs_what_the_host_imports(package: Path) -> None:
    depends = run("dpkg-deb", "--field", str(package), "Depends").stdout
    wanted = (ROOT / "requirements.txt").read_text().lower()
    for name in ("cffi", "greenlet", "jinja2", "numpy", "scipy", "prometheus_client"):
        assert name in wanted and f"python3-{name.replace('_', '-')}" in depends
    assert "python3-serial" in depends and "gcc" in depends
