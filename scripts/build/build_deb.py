#!/usr/bin/env python3
"""Makes the Debian package of the host from the tree (`make deb`): out/ferrite_VERSION_all.deb.

It holds host, firmware sources and configs in /usr/lib/ferrite, programs in /usr/bin and the service ferrite@USER. The
C helper is built when the package is installed, for whatever processor that is.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HOME = Path("usr/lib/ferrite")
FOLDERS = ("klippy", "config", "scripts", "src", "docs", "Makefile", "VERSION", "LICENSE", "README.md")
LEFT_OUT = ("scripts/bench/", "scripts/check/")
PROGRAMS = {
    "ferrite-klippy": "klippy/klippy.py",
    "ferrite-console": "scripts/console.py",
    "ferrite-check-config": "scripts/check_config.py",
    "ferrite-why": "scripts/why.py",
}
DEPENDS = (
    "python3 (>= 3.11)", "python3-cffi", "python3-greenlet", "python3-jinja2", "python3-serial",
    "python3-prometheus-client", "python3-numpy", "python3-scipy", "gcc", "libc6-dev",
)  # fmt: skip
CONTROL = """\
Package: ferrite
Version: {version}
Architecture: all
Maintainer: The developers of Ferrite <ferrite@localhost>
Depends: {depends}
Recommends: python3-prompt-toolkit
Section: misc
Priority: optional
Description: Klipper-compatible host of 3D printers with an induction-heated nozzle
 Host software and firmware sources. Start it for a user with
 systemctl enable --now ferrite@USER
"""
# dpkg sets DPKG_ROOT where it installs into another root without entering it.
POSTINST = """\
#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
cd "$DPKG_ROOT/usr/lib/ferrite"
python3 -c 'import sys; sys.path.insert(0, "klippy"); import chelper; chelper.get_ffi()'
if [ -z "$DPKG_ROOT" ] && [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
"""
PRERM = """\
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -z "$DPKG_ROOT" ] && [ -d /run/systemd/system ]; then systemctl stop 'ferrite@*'; fi
rm -rf "$DPKG_ROOT/usr/lib/ferrite/out"
find "$DPKG_ROOT/usr/lib/ferrite" -name __pycache__ -type d -prune -exec rm -rf {} +
"""
# What the service runs as the user.
START = """\
#!/bin/sh
set -e
data=$HOME/printer_data
examples=/usr/lib/ferrite/config
mkdir -p "$data/config" "$data/gcodes" "$data/logs" "$data/comms"
if [ ! -e "$data/config/printer.cfg" ]; then
  sed "s|^path: .*gcodes.*|path: $data/gcodes|" "$examples/example-induction-f334.cfg" >"$data/config/printer.cfg"
  cp -n "$examples"/macros-induction.cfg "$data/config/"
fi
cd "$data"
exec ferrite-klippy config/printer.cfg -l logs/klippy.log -a comms/klippy.sock -I comms/klippy.serial
"""
UNIT = """\
[Unit]
Description=Ferrite, 3D printer host of %i
After=network.target

[Service]
User=%i
ExecStart=/usr/lib/ferrite/start
Restart=always
RestartSec=5
LimitRTPRIO=1
LimitMEMLOCK=infinity

[Install]
WantedBy=multi-user.target
"""


def write(path: Path, text: str, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)


def fill(tree: Path, version: str) -> None:
    """All files of the package."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *FOLDERS]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        if not name.startswith(LEFT_OUT) and (ROOT / name).is_file():
            target = tree / HOME / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target)
    for program, source in PROGRAMS.items():
        start = f'#!/bin/sh\nexec python3 "$(dirname "$0")/../lib/ferrite/{source}" "$@"\n'
        write(tree / "usr" / "bin" / program, start, 0o755)
    write(tree / "usr/lib/systemd/system/ferrite@.service", UNIT)
    write(tree / HOME / "start", START, 0o755)
    write(tree / "DEBIAN/control", CONTROL.format(version=version, depends=", ".join(DEPENDS)))
    write(tree / "DEBIAN/postinst", POSTINST, 0o755)
    write(tree / "DEBIAN/prerm", PRERM, 0o755)


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Make the Debian package.")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder of the package")
    options = parser.parse_args(argv)
    if shutil.which("dpkg-deb") is None:
        print("build_deb: there is no dpkg-deb here; Debian's package dpkg has it", file=sys.stderr)
        return 2
    version = (ROOT / "VERSION").read_text(encoding="utf-8").strip()
    options.out.mkdir(parents=True, exist_ok=True)
    package = options.out / f"ferrite_{version}_all.deb"
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "ferrite"
        tree.mkdir(mode=0o755)
        fill(tree, version)
        subprocess.run(
            ["dpkg-deb", "--root-owner-group", "--build", str(tree), str(package)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    print(package)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
