"""The builds of the firmware a simulated MCU can run.

    simulator     the port on virtual hardware: the firmware's code, no chip            libferrite_mcu.so
    stm32f334     the image for the chip, on an emulator of it (docs/reference/Emulation.md)  libferrite_stm32f334.so
    atmega2560    the same for the Mega                                                 libferrite_atmega2560.so

Each is a library with the interface src/simulator/sim_mcu.h; the last two load an image. What a host needs to know of a
build (clock, pin numbers) is in its dictionary, as for a real MCU.
"""

from __future__ import annotations

import fcntl
import json
import re
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
OUT = ROOT / "out"


class WorldError(Exception):
    """The simulated world cannot be built or made; the text is for people."""


@dataclass(frozen=True, slots=True)
class Build:
    """One build. `image`: what its emulator loads; without one the library is the firmware."""

    name: str
    library: Path
    dictionary: Path
    image: Path | None = None

    @property
    def emulated(self) -> bool:
        """Runs on an emulator, whose serial line has a speed of its own."""
        return self.image is not None

    @property
    def clock_hz(self) -> float:
        """Nominal rate of its clock."""
        return float(_read_dictionary(self)["config"]["CLOCK_FREQ"])

    @property
    def baud(self) -> float:
        """Speed of its serial line, bit/s."""
        return float(_read_dictionary(self)["config"]["SERIAL_BAUD"])

    def pin(self, name: str) -> int | None:
        """Number of a pin by its name in the dictionary; None if there is none."""
        return _pins(self).get(name)


def _emulated(name: str) -> Build:
    folder = OUT / name
    return Build(
        name, OUT / "emulator" / f"libferrite_{name}.so", folder / "ferrite.dict", folder / "ferrite.elf"
    )


SIMULATOR = Build("simulator", OUT / "simulator" / "libferrite_mcu.so", OUT / "simulator" / "ferrite.dict")
BUILDS = {build.name: build for build in (SIMULATOR, _emulated("stm32f334"), _emulated("atmega2560"))}


@lru_cache(maxsize=8)
def _read_dictionary(build: Build) -> dict[str, Any]:
    dictionary: dict[str, Any] = json.loads(build.dictionary.read_text())
    return dictionary


@lru_cache(maxsize=8)
def _pins(build: Build) -> dict[str, int]:
    """Name → number. A range [first, count] counts its name's last digits up."""
    pins: dict[str, int] = {}
    for name, value in _read_dictionary(build)["enumerations"]["pin"].items():
        if isinstance(value, int):
            pins[name] = value
            continue
        first, count = value
        match = re.fullmatch(r"(.*?)(\d+)", name)
        assert match is not None, f"pin range {name} has no number"
        for i in range(count):
            pins[f"{match[1]}{int(match[2]) + i}"] = first + i
    return pins


def make(targets: Iterable[Path], what: str, advice: str = "") -> None:
    """Bring files of out/ up to date. `advice`: what helps if that fails, in brackets. Raises WorldError."""
    names = [str(path.relative_to(ROOT)) for path in targets]
    OUT.mkdir(parents=True, exist_ok=True)
    with open(OUT / ".simulation-lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # test workers start together
        try:
            done = subprocess.run(
                ["make", "-s", "--no-print-directory", *names],
                cwd=ROOT,
                capture_output=True,
                text=True,
                check=False,
            )
        except FileNotFoundError:
            if all((ROOT / name).exists() for name in names):
                return
            raise WorldError(
                f"{what} has to be built once, and make is not installed (apt-get install make gcc)."
            ) from None
    if done.returncode:
        raise WorldError(f"{what} does not build{advice}:\n" + (done.stderr.strip() or done.stdout.strip()))


def use_image(name: str, folder: Path) -> None:
    """From now on a build's image and dictionary are those of `folder`, made with options of its own."""
    image, dictionary = folder / "ferrite.elf", folder / "ferrite.dict"
    for path in (image, dictionary):
        if not path.is_file():
            raise WorldError(
                f"There is no {path}: make PORT={name} OUT=SOMEWHERE puts it into SOMEWHERE/{name}."
            )
    BUILDS[name] = replace(BUILDS[name], image=image.resolve(), dictionary=dictionary)
    make_build.cache_clear()


@lru_cache(maxsize=8)
def make_build(name: str) -> Build:
    """A build by name, made. Raises WorldError."""
    build = BUILDS.get(name)
    if build is None:
        raise WorldError(f"There is no build '{name}' of the firmware; there are {', '.join(BUILDS)}.")
    targets = [path for path in (build.image, build.library) if path is not None and path.is_relative_to(OUT)]
    advice = " (`make setup-test` brings the compilers and emulators it needs)" if build.emulated else ""
    make(targets, f"The firmware's build '{name}'", advice)
    return build
