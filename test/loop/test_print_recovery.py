"""[print_recovery] on the simulated machine: where it would resume, at many instants, and one print resumed."""

from __future__ import annotations

import harness

import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from extras.print_recovery import PrintRecovery
from extras.recovery.journal import Journal
from extras.recovery.path import Refusal
from simulation.runner import PRINTED, SHUT_DOWN, RunOptions, Simulation

AXES = {"x": "stepper_x", "y": "stepper_y", "z": "stepper_z", "extruder": "extruder"}
FULL_STEP_MM = {"x": 40.0 / 200, "y": 40.0 / 200, "z": 8.0 / 200, "extruder": 7.6 / 200}
INTERVAL_S = 0.5


@dataclass(slots=True)
class Instant:
    """What a crash at this moment would leave: the journal, the motors' steps; and where the axes are."""

    record: dict[str, Any]
    steps: dict[str, int]
    place: dict[str, float]


class Watched(Simulation):
    """Looks at journal and machine at given times."""

    def __init__(self, options: RunOptions, journal: Path, at_s: list[float]) -> None:
        super().__init__(options)
        self.journal, self.at_s = journal, sorted(at_s)
        self.instants: list[Instant] = []
        self.outcome: Any = None

    def axis(self, name: str) -> dict[str, Any]:
        assert self.machine is not None
        return self.world.axis(self.machine.axes[name])

    def _before_advance(self, now: float) -> None:
        super()._before_advance(now)
        while self.at_s and now - self.world.start_s >= self.at_s[0]:
            self.at_s.pop(0)
            axes = {name: self.axis(name) for name in AXES}
            steps = {AXES[n]: int(a["steps_forward"] - a["steps_backward"]) for n, a in axes.items()}
            place = {name: a["position_mm"] for name, a in axes.items()}
            self.instants.append(Instant(Journal(str(self.journal)).read(), steps, place))


def options(
    part: Path, journal: Path, faults: tuple[str, ...] = (), more: tuple[tuple[str, str, str], ...] = ()
) -> RunOptions:
    """A print of `part` with [print_recovery]."""
    values = {"filename": str(journal), "interval": str(INTERVAL_S), "z_stays": "True"}
    overrides = tuple(("print_recovery", name, value) for name, value in values.items())
    return RunOptions(harness.SAMPLE_CONFIG, part, overrides=overrides + more, faults=faults)


FILAMENT_STEP_MM = FULL_STEP_MM["extruder"]


PART = Path(__file__).resolve().parents[1] / "data" / "recovery.gcode"


class Restarted(Watched):
    """`script` runs instead of a print."""

    def __init__(self, options: RunOptions, journal: Path, at_s: list[float], script: str = "") -> None:
        super().__init__(options, journal, at_s)
        self.script = script
        self.offer: dict[str, Any] = {}

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


def run(
    folder: Path,
    at_s: list[float],
    script: str = "",
    faults: tuple[str, ...] = (),
    more: tuple[tuple[str, str, str], ...] = (),
) -> Restarted:
    part, journal = folder / "part.gcode", folder / "recovery"
    if not part.exists():
        part.write_text(PART.read_text())
    simulation = Restarted(options(part, journal, faults, more), journal, at_s, script)
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


@pytest.mark.parametrize(
    ("faults", "state", "reason"),
    [
        ("host_kill@13.137", "offered", ""),
        ("host_kill@15.911", "offered", ""),
        ("mcu_reset@16", "refused", "with drivers_stay_on: True in [print_recovery] homing measures"),
        ("mcu_reset@16 host_kill@16", "refused", "a board was reset or lost its power"),
    ],
)
def test_a_host_started_again_offers_the_place_of_the_boards_counts_or_refuses(
    tmp_path: Path, faults: str, state: str, reason: str
) -> None:
    again = (("simulator", "start_again", "True"), ("simulator", "fault", faults))
    found = run(tmp_path, [], more=again).outcome.summary["recovery"]
    assert found["state"] == state
    assert reason in found["reason"]
    assert found["off_steps"] < 1.0
    assert 0.0 < found["bytes_per_minute"] < 200_000


STAY_ON = (("print_recovery", "drivers_stay_on", "True"),)


@pytest.mark.parametrize("at_s", [13.2, 16.0, 17.77, 19.9])
def test_after_a_reset_that_the_host_saw_homing_measures_where_the_head_stood(
    tmp_path: Path, at_s: float
) -> None:
    again = (("simulator", "start_again", "True"), ("simulator", "fault", f"mcu_reset@{at_s}"))
    found = run(tmp_path, [], more=STAY_ON + again).outcome.summary["recovery"]
    assert (found["state"], found["reason"]) == ("offered", "")
    assert found["off_steps"] < 1.0


def test_recover_print_after_a_reset_homes_and_prints_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PrintRecovery, "_config_sum", lambda self: 0)  # the config says where the axes stand
    first = run(tmp_path, [], faults=("mcu_reset@16",), more=STAY_ON)
    assert first.outcome.status == SHUT_DOWN
    stands = tuple(
        (f"simulator axis {name}", "start_position", str(first.axis(name)["position_mm"])) for name in "xyz"
    )
    second = run(tmp_path, [], script="RECOVER_PRINT", more=STAY_ON + stands)
    assert second.outcome.status == PRINTED, second.outcome.reason
    assert second.offer["state"] == "home_first"
    total = first.axis("extruder")["position_mm"] + second.axis("extruder")["position_mm"]
    assert abs(total - filament_mm((tmp_path / "part.gcode").read_bytes())) < FILAMENT_STEP_MM
    end = (tmp_path / "part.gcode").read_text().split("G1 X")[-1].split()
    assert second.axis("x")["position_mm"] == pytest.approx(float(end[0]), abs=0.05)


def test_motors_that_moved_before_another_start_make_it_refuse(tmp_path: Path) -> None:
    first = run(tmp_path, [], faults=("mcu_reset@16",), more=STAY_ON)
    assert "span_s" in Journal(str(first.journal)).read()
    moved = run(tmp_path, [], script="G28 X", more=STAY_ON)
    assert moved.offer["state"] == "home_first"
    third = run(tmp_path, [], script="M117", more=STAY_ON)
    assert third.offer["state"] == "refused" and "motors have moved since" in third.offer["reason"]


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
