"""How soon a command from elsewhere acts on a print: what is planned already is carried out before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from test_motion_print import play, rounds  # noqa: F401 (a fixture)

DELAY_MAX_S = 1.0
TIMES = 5


def to_and_fro(count: int, mm: float) -> list[str]:
    """Lines of `mm` at 80 mm/s, with a corner after each."""
    lines = [f"G1 X{100 + mm * (n % 2):.2f} Y{50 + 0.1 * n:.2f} E0.01" for n in range(count)]
    return ["M83", "G1 F4800", *lines]


# Speed, how much of a line comes on top of the second, lines.
FILES = {
    "round": (40.0, 0.0, rounds(3000)),
    "lines of 0.13 s": (80.0, 0.13, to_and_fro(400, 8.0)),
    "short lines": (80.0, 0.0, to_and_fro(1200, 1.0)),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("command", ["M220 S50", "SET_GCODE_OFFSET Z_ADJUST=0.05 MOVE=1", "PAUSE"])
def test_a_command_acts_within_a_second(play: Callable[..., Any], name: str, command: str) -> None:  # noqa: F811
    delays: list[float] = []
    moves: list[Any] = []
    speed, more_s, lines = FILES[name]
    acts: dict[str, Callable[[Any], bool]] = {
        "M220 S50": lambda move: move.max_cruise_v2 < (0.75 * speed) ** 2,
        "SET_GCODE_OFFSET Z_ADJUST=0.05 MOVE=1": lambda move: move.axes_d[2] > 0.0,
    }

    def beside(host: Any, lookup: Any) -> None:
        toolhead, gcode, clock = lookup("toolhead"), lookup("gcode"), host.reactor
        toolhead.register_move_listener(moves.extend)
        for number in range(TIMES):
            clock.pause(clock.monotonic() + 3.0 + 0.07 * number)
            begin = toolhead.mcu.estimated_print_time(clock.monotonic())
            del moves[:]
            gcode.run_script(command)
            if command == "PAUSE":
                toolhead.wait_moves()
                last = moves[-1]
                delays.append(last.print_time + last.accel_t + last.cruise_t + last.decel_t - begin)
                gcode.run_script("RESUME")
            else:
                clock.pause(clock.monotonic() + 2.0 * DELAY_MAX_S)
                delays.append(next(m.print_time for m in moves if acts[command](m)) - begin)
                gcode.run_script("M220 S100")

    play(lines, beside)
    assert max(delays) < DELAY_MAX_S + more_s
