"""[print_recovery] on the simulated machine: where it would resume, at many instants, and one print resumed."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import bench_recovery
from bench_recovery import FULL_STEP_MM
from extras.recovery.journal import Journal
from extras.recovery.path import Refusal
from reactor import Reactor
from simulation.runner import PRINTED, SHUT_DOWN, RunOptions

FILAMENT_STEP_MM = FULL_STEP_MM["extruder"]


def spiral(turns: int = 6) -> str:
    """A print whose path never passes a place twice: 8-sided rings that grow, retractions between them."""
    lines = ["M104 S250", "G28", "G90", "M83", "G1 X90 Y90 Z0.3 F6000", "M109 S250", "M106 S128"]
    for number in range(8 * turns):
        radius, angle = 4.0 + number * 0.3, number * math.pi / 4
        x, y = 90 + radius * math.cos(angle), 90 + radius * math.sin(angle)
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E{radius * 0.03:.5f} F{1800 + 60 * number}")
        if number % 8 == 7:
            lines += ["G1 E-0.8 F1800", f"G1 X{x:.3f} Y{y + 0.5:.3f} Z{0.3 + number / 160:.3f}", "G1 E0.8"]
    return "\n".join([*lines, "M400", "M104 S0", ""])


class Restarted(bench_recovery.Watched):
    """Can start the host again; `script` runs instead of a print."""

    def __init__(self, options: RunOptions, journal: Path, at_s: list[float], script: str = "") -> None:
        super().__init__(options, journal, at_s)
        self.script = script
        self.offer: dict[str, Any] = {}

    def start_again(self) -> None:
        """Start the host anew on the machine as it is, also after an MCU reset, until it is ready."""
        self.world.lib.world_stall_host(self.world.pointer, self.world.now)
        self._heater = self._bed = None
        reason = "startup"
        for _ in range(3):
            self.reactor = Reactor(self.time)
            self.printer = self._new_printer()
            self.printer.start_args["start_reason"] = reason
            self.reactor.register_callback(self._wait)
            reason = self.printer.run()
            if reason == "exit":
                return

    def _wait(self, eventtime: float) -> None:
        # a board that shuts itself down while the host starts is reset: the host ends by itself then
        while (
            self.printer.get_state_message()[1] not in ("ready", "error")
            and self.world.now < eventtime + 20.0
        ):
            self.reactor.pause(self.reactor.monotonic() + 0.1)
        self.printer.request_exit("exit")

    def _print(self) -> None:
        if not self.script:
            super()._print()
            return
        self.offer = self.printer.lookup_object("print_recovery").get_status(0.0)
        self.printer.lookup_object("gcode").run_script(self.script)
        sdcard = self.printer.lookup_object("virtual_sdcard")
        while self._pause():
            if not sdcard.is_active():
                self._finish_print(sdcard.get_status(0.0))
                return


def run(folder: Path, at_s: list[float], script: str = "", faults: tuple[str, ...] = ()) -> Restarted:
    part, journal = folder / "part.gcode", folder / "recovery"
    if not part.exists():
        part.write_text(spiral())
    simulation = Restarted(bench_recovery.options(part, journal, *faults), journal, at_s, script)
    simulation.outcome = simulation.run()
    return simulation


def assert_there(point: Sequence[float], place: dict[str, float]) -> None:
    """The point is within one full step of the machine's place, axis by axis."""
    for name, limit_mm in FULL_STEP_MM.items():
        assert abs(point[list(place).index(name)] - place[name]) < limit_mm, (name, point, place)


def filament_mm(text: bytes) -> float:
    """The sum of E of a file with relative extrusion."""
    return sum(float(word[1:]) for word in text.decode().split() if word[0] == "E")


def test_at_20_instants_it_finds_line_and_point_within_a_full_step(tmp_path: Path) -> None:
    chance = random.Random(21)
    result = run(tmp_path, [chance.uniform(12.0, 20.5) for _ in range(20)])
    assert result.outcome.status == PRINTED, result.outcome.reason
    recovery, part = result.printer.lookup_object("print_recovery"), (tmp_path / "part.gcode").read_bytes()
    assert len(result.instants) == 20
    for instant in result.instants:
        place = recovery.find({**instant.record, "steps": instant.steps})
        assert_there(place.point, instant.place)
        # the lines themselves: filament before and after the one that was interrupted
        through = part[: place.segment.offset]
        before, after = filament_mm(through[: through.rindex(b"\n", 0, -1)]), filament_mm(through)
        low, high = min(before, after) - FILAMENT_STEP_MM, max(before, after) + FILAMENT_STEP_MM
        assert low < instant.place["extruder"] < high
    assert 0.0 < recovery.get_status(0.0)["bytes_per_minute"] < 200_000


def test_after_a_shutdown_the_next_start_offers_and_prints_the_rest(tmp_path: Path) -> None:
    first = run(tmp_path, [], faults=("coil_open@16",))
    assert first.outcome.status == SHUT_DOWN
    assert "steps" in Journal(str(first.journal)).read()
    second = run(tmp_path, [], script="RECOVER_PRINT")
    assert second.outcome.status == PRINTED, second.outcome.reason
    assert second.offer["state"] == "offered"
    assert second.offer["file"] == str((tmp_path / "part.gcode").resolve())
    total = first.axis("extruder")["position_mm"] + second.axis("extruder")["position_mm"]
    assert abs(total - filament_mm((tmp_path / "part.gcode").read_bytes())) < FILAMENT_STEP_MM
    assert not Journal(str(first.journal)).read()  # the print ended: nothing to offer at the next start


@pytest.mark.parametrize("at_s", [13.137, 15.911, 18.482])
def test_a_host_that_was_killed_finds_the_place_from_the_boards_own_counts(
    tmp_path: Path, at_s: float
) -> None:
    result = run(tmp_path, [], faults=(f"host_kill@{at_s}",))
    assert result.outcome.status == SHUT_DOWN
    assert "steps" not in Journal(str(result.journal)).read()
    result.start_again()
    assert result.printer.get_state_message()[1] == "ready"
    offer = result.printer.lookup_object("print_recovery").get_status(0.0)
    assert offer["state"] == "offered", offer["reason"]
    assert_there(offer["position"], {name: result.axis(name)["position_mm"] for name in FULL_STEP_MM})


def test_a_board_that_was_reset_is_a_refusal(tmp_path: Path) -> None:
    result = run(tmp_path, [], faults=("mcu_reset@16",))
    assert result.outcome.status == SHUT_DOWN
    result.start_again()
    offer = result.printer.lookup_object("print_recovery").get_status(0.0)
    assert offer["state"] == "refused"
    assert "a board was reset or lost its power" in offer["reason"]


def test_another_print_discards_the_offer_before_it_moves(tmp_path: Path) -> None:
    first = run(tmp_path, [], faults=("coil_open@16",))
    assert "steps" in Journal(str(first.journal)).read()
    second = run(tmp_path, [2.0])
    assert second.instants[0].record == {}


def test_it_refuses_with_the_reason(tmp_path: Path) -> None:
    result = run(tmp_path, [16.0])
    recovery, instant = result.printer.lookup_object("print_recovery"), result.instants[0]
    record, part = {**instant.record, "steps": instant.steps}, tmp_path / "part.gcode"
    wrong: list[tuple[dict[str, Any], str]] = [
        (instant.record, "a board was reset or lost its power"),
        ({**record, "config": 1}, "the configuration has changed"),
        ({**record, "shifted": True}, "a bed mesh"),
        ({**record, "steps": {**instant.steps, "stepper_x": 0}}, "not on the path"),
    ]
    for changed, reason in wrong:
        with pytest.raises(Refusal, match=reason):
            recovery.find(changed)
    part.write_text(part.read_text() + "G1 X0\n")
    with pytest.raises(Refusal, match="has changed since"):
        recovery.find(record)
