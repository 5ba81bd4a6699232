"""A file printed from the printer's own storage: the moves of batch mode, in time with the print."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_motion_fast import random_file, run  # noqa: F401 (a fixture)

import msgproto
from motion_rig import CLOCK_HZ, CONFIG, EXTRUDER, StepTrace, decode, dictionary
from sd_host import SDHost
from toolhead import BUFFER_FULL_S, LookAheadQueue

MACHINE = CONFIG + EXTRUDER + "pressure_advance: 0.04\n[fan]\npin: PE0\n"
STORAGE = "[virtual_sdcard]\npath: /\n[pause_resume]\n"
# more than the buffer: moves are planned when so much has come in, and settled moves may be more
MAX_AHEAD_S = BUFFER_FULL_S + 2.0 * LookAheadQueue.REVIEW_S


def rounds(count: int) -> list[str]:
    """Rounds of 0.5 mm a line, 80 lines a second."""
    angles = [number / 40.0 for number in range(count)]
    lines = [f"G1 X{100 + 20 * math.cos(a):.3f} Y{100 + 20 * math.sin(a):.3f} E0.02" for a in angles]
    return ["M83", "G1 F2400", *lines]


Body = Callable[[Any, Any], None]


def places(out: bytes) -> dict[int, list[int]]:
    """Place after each step, by stepper's number."""
    blocks = msgproto.BlockReader().feed(out)
    traces: dict[int, StepTrace] = {}
    for params in decode([block.content for block in blocks if block is not None]):
        if params["#name"] in ("queue_step", "set_next_step_dir", "reset_step_clock"):
            traces.setdefault(params["oid"], StepTrace()).feed(params)
    return {oid: trace.positions for oid, trace in traces.items()}


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Prints lines; `beside(host, lookup)` runs at the same time, from the first second on."""

    def go(lines: list[str], beside: Body | None = None, live: bool = True, ready: Body | None = None) -> Any:
        (tmp_path / "printer.cfg").write_text(MACHINE + STORAGE)
        (tmp_path / "part.gcode").write_text("\n".join(lines) + "\n")
        (tmp_path / "dict").write_bytes(dictionary(CLOCK_HZ))
        host = SDHost(
            argparse.Namespace(
                config=str(tmp_path / "printer.cfg"), gcode=str(tmp_path / "part.gcode"),
                out=str(tmp_path / "out"), dict=str(tmp_path / "dict"), live=live,
            )
        )  # fmt: skip
        lookup, failure = host.printer.lookup_object, []

        def guarded(eventtime: float) -> None:
            try:
                host.reactor.pause(host.reactor.monotonic() + 1.0)
                assert beside is not None
                beside(host, lookup)
            except BaseException as problem:
                failure.append(problem)
                host.printer.request_exit("exit")

        def begin() -> None:
            if ready is not None:
                ready(host, lookup)
            if beside is not None:
                host.reactor.register_callback(guarded)

        host.printer.register_event_handler("klippy:ready", begin)
        result = host.run()
        host.reactor.finalize()
        if failure:
            raise failure[0]
        assert result == "exit"
        return (tmp_path / "out").read_bytes()

    return go


@pytest.mark.parametrize("number", [2, 4])
def test_a_printed_file_gives_the_bytes_of_batch_mode(play, run, number: int) -> None:  # noqa: F811
    text = random_file(number, 400)
    assert play(text.splitlines(), live=False) == run("G28\n" + text, short=True, config=MACHINE).out


def test_pacing_changes_no_step(play) -> None:
    lines = rounds(300)
    assert places(play(lines)) == places(play(lines, live=False))


def test_no_more_than_the_buffer_is_planned_ahead(play) -> None:
    ahead: list[float] = []

    def watch(host: Any, lookup: Any) -> None:
        toolhead = lookup("toolhead")
        host.reactor.pause(host.reactor.monotonic() + 4.0)  # the way to the first place is one long move
        for _ in range(40):
            now = host.reactor.pause(host.reactor.monotonic() + 0.1)
            ahead.append(toolhead.print_time - toolhead.mcu.estimated_print_time(now))

    play(rounds(800), watch)
    assert min(ahead) > BUFFER_FULL_S - 0.2 and max(ahead) < MAX_AHEAD_S


def test_what_is_seen_while_a_print_waits_is_of_one_line(play) -> None:
    """Position in the file, of G-code and of the toolhead agree whenever somebody looks."""
    lines = ["M83", *(f"G1 X{20 + number * 0.025:.3f} F600" for number in range(4000))]
    ends = {0: 0}
    for line in lines:
        ends[len(ends)] = ends[len(ends) - 1] + len(line) + 1
    number_at = {end: number for number, end in ends.items()}
    seen: list[int] = []

    def watch(host: Any, lookup: Any) -> None:
        card, move, toolhead = lookup("virtual_sdcard"), lookup("gcode_move"), lookup("toolhead")
        for _ in range(20):
            host.reactor.pause(host.reactor.monotonic() + 0.05)
            done, under_way = number_at[card.file_position], number_at[card.get_file_position()]
            assert under_way == done + 1  # the line it waits with
            expected = float(lines[done].split()[1][1:])
            assert move.last_position[0] == toolhead.commanded_pos[0] == expected
            seen.append(done)

    play(lines, watch)
    assert seen == sorted(seen) and seen[-1] - seen[0] > 100


def test_a_pause_in_mid_print_goes_on_where_it_stopped(play) -> None:
    def pause(host: Any, lookup: Any) -> None:
        gcode, card, stats = lookup("gcode"), lookup("virtual_sdcard"), lookup("print_stats")
        gcode.run_script("PAUSE")
        host.reactor.pause(host.reactor.monotonic() + 1.0)
        assert stats.get_status(0.0)["state"] == "paused"
        position, place = card.file_position, lookup("toolhead").get_position()
        host.reactor.pause(host.reactor.monotonic() + 30.0)
        assert card.file_position == position and lookup("toolhead").get_position() == place
        gcode.run_script("RESUME")

    lines = rounds(400)
    assert places(play(lines, pause)) == places(play(lines))


def test_other_commands_come_between_the_moves_they_stand_between(play) -> None:
    marks: list[tuple[float, float]] = []

    def ready(host: Any, lookup: Any) -> None:
        toolhead = lookup("toolhead")
        lookup("gcode").register_command(
            "MARK", lambda gcmd: marks.append((toolhead.commanded_pos[0], gcmd.get_float("AT")))
        )

    lines = ["M83", "G1 F6000"]
    for number in range(300):
        lines.append(f"G1 X{20 + number * 0.25:.3f}")
        if number % 7 == 0:
            lines.append(f"MARK AT={20 + number * 0.25:.3f}")
    play(lines, ready=ready)
    assert len(marks) == 43 and all(place == wanted for place, wanted in marks)


def test_comments_are_listened_to_in_their_places(play) -> None:
    received: list[tuple[str, float]] = []

    def ready(host: Any, lookup: Any) -> None:
        toolhead = lookup("toolhead")
        lookup("gcode").register_comment_listener(
            lambda line: received.append((line, toolhead.commanded_pos[0]))
        )

    play(
        ["M83", "G1 X20 F6000", ";LAYER:1", "G1 X21", "  ; two", "G1 X22 ; not alone", "G1 X23"], ready=ready
    )
    assert [entry for entry in received if entry[0]] == [(";LAYER:1", 20.0), ("; two", 21.0)]


def test_a_script_stops_at_its_first_wrong_line(play) -> None:
    def script(host: Any, lookup: Any) -> None:
        gcode = lookup("gcode")
        with pytest.raises(gcode.error, match="Move out of range"):
            gcode.run_script("G1 X30 F6000\nG1 X31\nG1 X999\nG1 X32")
        assert lookup("toolhead").commanded_pos[0] == 31.0
        assert lookup("gcode_move").last_position[0] == 31.0

    play(["G4 P3000"], script)
