"""[bed_screws]: BED_SCREWS_ADJUST brings the nozzle to each screw of the bed, to be turned until paper drags.

ACCEPT goes on to the next screw, ADJUSTED too, but says that the screw was turned: it ends when all have been accepted
in a row. Then the same at places for fine adjustment, if there are any.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

from .manual_probe import verify_no_manual_probe
from .screws_tilt_adjust import Screw, read_screws

COMMANDS = {
    "ACCEPT": "Accept bed screw position",
    "ADJUSTED": "Accept bed screw position after notable adjustment",
    "ABORT": "Abort bed screws tool",
}


@dataclass(frozen=True, slots=True)
class Travel:
    """mm, mm/s."""

    speed: float
    horizontal_move_z: float
    probe_height: float
    probe_speed: float


class BedScrews:
    """Printer object 'bed_screws'."""

    def __init__(self, printer: Printer, rounds: dict[str, list[Screw]], travel: Travel) -> None:
        self.printer = printer
        self.rounds = rounds  # state -> places; the first round comes first
        self.travel = travel
        self._gcode = printer.lookup_object("gcode")
        self._state: str | None = None
        self._current = self._accepted = 0

    def register(self) -> None:
        self._gcode.register_command(
            "BED_SCREWS_ADJUST", self.cmd_BED_SCREWS_ADJUST, desc="Tool to help adjust bed leveling screws"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        active = self._state is not None
        return {
            "is_active": active,
            "state": self._state,
            "current_screw": self._current if active else None,
            "accepted_screws": self._accepted if active else None,
        }

    def _lift(self) -> None:
        """Fast only on the way to the first screw."""
        toolhead, travel = self.printer.lookup_object("toolhead"), self.travel
        speed = travel.speed if self._state is None else travel.probe_speed
        toolhead.manual_move([None, None, travel.horizontal_move_z], speed)

    def _go_to(self, state: str, number: int) -> None:
        """Nozzle down at a screw, and ask."""
        toolhead, travel, screw = (
            self.printer.lookup_object("toolhead"),
            self.travel,
            self.rounds[state][number],
        )
        self._lift()
        toolhead.manual_move([screw.x, screw.y], travel.speed)
        toolhead.manual_move([None, None, travel.probe_height], travel.probe_speed)
        self._state, self._current = state, number
        self._gcode.respond_info(
            f"{screw.name}: {'fine ' if state == 'fine' else ''}adjust, then ACCEPT; ADJUSTED if it was turned by more "
            "than about 1/8 turn; ABORT"
        )

    def cmd_BED_SCREWS_ADJUST(self, gcmd: GCodeCommand) -> None:
        """Begin at the first screw."""
        verify_no_manual_probe(self.printer)
        toolhead = self.printer.lookup_object("toolhead")
        homed = toolhead.get_status(self.printer.get_reactor().monotonic())["homed_axes"]
        if not set("xyz") <= set(homed):
            raise gcmd.error("Must home before adjusting the screws: G28 first")
        self._accepted = 0
        self._go_to("adjust", 0)
        for name, text in COMMANDS.items():
            self._gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def cmd_ACCEPT(self, gcmd: GCodeCommand) -> None:
        """No turn was needed."""
        self._accepted += 1
        self._next()

    def cmd_ADJUSTED(self, gcmd: GCodeCommand) -> None:
        """It was turned: all have to be looked at again, after a fine round also those of the coarse one."""
        self._accepted = 0
        self._next()

    def cmd_ABORT(self, gcmd: GCodeCommand) -> None:
        """Give up."""
        self._end("Bed screws tool aborted")

    def _next(self) -> None:
        state = self._state or "adjust"
        screws = self.rounds[state]
        if self._accepted < len(screws):
            last = self._current + 1 == len(screws)
            self._go_to(*(("adjust", 0) if last else (state, self._current + 1)))
            return
        self._accepted = 0
        if state == "adjust" and "fine" in self.rounds:
            self._go_to("fine", 0)
            return
        self._lift()
        self._end("Bed screws tool completed successfully")

    def _end(self, text: str) -> None:
        self._state = None
        for name in COMMANDS:
            self._gcode.register_command(name, None)
        self._gcode.respond_info(text)


def load_config(config: ConfigWrapper) -> BedScrews:
    screws = read_screws(config, 3)
    fine = []
    for number, screw in enumerate(screws, 1):
        place = config.getfloatlist(f"screw{number}_fine_adjust", None, count=2)
        if place is not None:
            fine.append(Screw(place[0], place[1], screw.name))
    travel = Travel(
        config.getfloat("speed", 50.0, above=0.0),
        config.getfloat("horizontal_move_z", 5.0),
        config.getfloat("probe_height", 0.0),
        config.getfloat("probe_speed", 5.0, above=0.0),
    )
    adjust = BedScrews(config.get_printer(), {"adjust": screws, **({"fine": fine} if fine else {})}, travel)
    adjust.register()
    return adjust
