"""[load_cell_probe]: a load cell under the nozzle or the bed as the probe. LOAD_CELL_TEST_TAP."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .load_cells.cell import LoadCell
from .load_cells.probe import ForceProbe, ForceSwitch

TAPS, TAP_TIMEOUT_S = 3, 30.0


class LoadCellProbe:
    """Printer object 'load_cell_probe'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.cell = LoadCell(config)
        self.switch = ForceSwitch(config, self.cell)
        self.probe = ForceProbe(config, self.switch)
        self.printer.add_object("probe", self.probe)

    def register(self, is_default: bool) -> None:
        self.cell.register(is_default)
        self.printer.lookup_object("gcode").register_command(
            "LOAD_CELL_TEST_TAP", self.cmd_LOAD_CELL_TEST_TAP, desc="Tap the load cell probe to verify it"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            **self.cell.get_status(eventtime),
            **self.probe.get_status(eventtime),
            "endstop_tare_counts": self.switch.tare_counts,
            "last_trigger_time": self.switch.endstop.last_trigger_time,
        }

    def cmd_LOAD_CELL_TEST_TAP(self, gcmd: GCodeCommand) -> None:
        """LOAD_CELL_TEST_TAP [TAPS=3] [TIMEOUT=s]: as in probing, but the head stays; the user taps."""
        taps = gcmd.get_int("TAPS", TAPS, minval=1, maxval=10)
        timeout_s = gcmd.get_float("TIMEOUT", TAP_TIMEOUT_S, minval=1.0, maxval=120.0)
        self.switch.change_settings(gcmd)
        gcmd.respond_info(f"Tap the load cell {taps} times:")
        for number in range(1, taps + 1):
            if not self.switch.wait_for_tap(timeout_s):
                raise gcmd.error(f"No tap within {timeout_s:.0f} seconds")
            gcmd.respond_info(f"Tap #{number} detected")
        gcmd.respond_info("Test complete, all taps detected")


def load_config(config: ConfigWrapper) -> LoadCellProbe:
    probe = LoadCellProbe(config)
    probe.register(not config.has_section("load_cell"))
    return probe
