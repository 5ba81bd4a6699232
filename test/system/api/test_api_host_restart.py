"""The host restarts while the machine goes on: one host after the other on a simulated printer, in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import greenlet
import pytest

from paced_host import PacedHost
from printer import Printer
from reactor import Reactor

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ROOT / "config" / "sim-induction.cfg"


class Machine(PacedHost):
    """The simulated printer. `host` is one run of a host on it."""

    def __init__(self, folder: Path) -> None:
        start_args: dict[str, Any] = {
            "config_file": str(CONFIG),
            "config_overrides": [("virtual_sdcard", "path", str(folder))],
            "apiserver": None,
            "gcode_fd": None,
            "software_version": "test",
            "cpu_info": "test",
        }
        super().__init__(start_args, speed=1.0, seed=1)

    def host(self, script: str, start_reason: str) -> tuple[str, str]:
        """Run a script once the printer is ready; (how the host ended, its last message or the script's error)."""
        self._start_args["start_reason"] = start_reason
        reactor = Reactor(self._inner)
        printer = self._printer = Printer(reactor, self._start_args)
        said = ""

        def drive(eventtime: float) -> None:
            nonlocal said
            try:
                while printer.get_state_message()[1] == "startup":
                    reactor.pause(reactor.monotonic() + 0.05)
                said = printer.get_state_message()[0]
                if printer.get_state_message()[1] == "ready":
                    printer.lookup_object("gcode").run_script(script)
            except greenlet.GreenletExit:
                return
            except printer.command_error as e:
                said = str(e)
            printer.request_exit("exit")

        reactor.register_callback(drive)
        result = printer.run()
        reactor.finalize()
        return result, said

    def place(self, axis: str) -> float:
        """Where an axis really is, mm."""
        assert self._machine is not None
        return float(self._world.axis(self._machine.axes[axis])["position_mm"])

    @property
    def uptime_s(self) -> float:
        return self._world.now - self._world.start_s


READY = "Printer is ready"


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_homing_after_a_restart_of_the_host_finds_the_same_place(machine: Machine) -> None:
    """The MCU keeps its configuration and goes on counting steps from where the session before left it."""
    first = machine.host("G28\nG1 X80 Y70 Z10 F6000\nM400", "startup")
    assert first == ("exit", READY)
    for x in (30.0, 55.0):
        again = machine.host(f"G28\nG1 X{x} Y40 Z4 F6000\nM400", "restart")
        assert again == ("exit", READY)
        # a homed position is good to the switch's sampling and a step: 0.0125 mm for x and y, 0.0025 mm for z
        assert machine.place("x") == pytest.approx(x, abs=0.03)
        assert machine.place("y") == pytest.approx(40.0, abs=0.03)
        assert machine.place("z") == pytest.approx(4.0, abs=0.01)


def test_a_session_lives_through_the_overflow_of_the_mcus_clock(machine: Machine) -> None:
    """32 bits at 72 MHz are 59.65 s: homing, moving and heating right across it."""
    machine.host("G28", "startup")
    wait = f"G4 P{1000.0 * (53.0 - machine.uptime_s):.0f}\n"
    script = wait + "M104 S150\n" + "G28\nG1 X50 Y50 Z5 F6000\n" * 3 + "M109 S200\nG28 X\nG1 X20 F6000\nM400"
    assert machine.host(script, "restart") == ("exit", READY)
    assert machine.uptime_s > 64.0
    assert machine.place("x") == pytest.approx(20.0, abs=0.03)


@pytest.mark.parametrize("script", ["G28\nM104 S150\nG1 X80 F6000", "M112"], ids=["moving", "shut down"])
def test_a_new_host_gets_going_on_what_a_killed_one_left(machine: Machine, script: str) -> None:
    machine.host(script, "startup")
    assert machine.host("", "startup")[0] == "firmware_restart", "it resets the MCU by itself"
    assert machine.host("G28 X\nG1 X20 F6000\nM400", "firmware_restart") == ("exit", READY)
    assert machine.place("x") == pytest.approx(20.0, abs=0.03)
