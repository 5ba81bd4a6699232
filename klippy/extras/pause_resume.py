"""[pause_resume]: PAUSE, RESUME, CLEAR_PAUSE and CANCEL_PRINT."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class PauseResume:
    """The object `pause_resume`."""

    def __init__(self, printer: Printer, recover_velocity_mm_s: float) -> None:
        self.printer = printer
        self.gcode = printer.lookup_object("gcode")
        self.recover_velocity_mm_s = recover_velocity_mm_s
        self.is_paused = False
        self._sd_paused = False
        self._command_sent = False

    def register(self) -> None:
        """Make commands and endpoints known."""
        for name in ("PAUSE", "RESUME", "CLEAR_PAUSE", "CANCEL_PRINT"):
            self.gcode.register_command(
                name, getattr(self, f"cmd_{name}"), desc=getattr(self, f"cmd_{name}_help")
            )
        webhooks = self.printer.lookup_object("webhooks")
        for endpoint, script in (("pause", "PAUSE"), ("resume", "RESUME"), ("cancel", "CANCEL_PRINT")):
            webhooks.register_endpoint(
                f"pause_resume/{endpoint}", lambda request, script=script: self.gcode.run_script(script)
            )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Whether the print is paused."""
        return {"is_paused": self.is_paused}

    def _sd(self) -> Any:
        return self.printer.lookup_object("virtual_sdcard", None)

    def is_sd_active(self) -> bool:
        """Whether a file is being printed."""
        sd = self._sd()
        return sd is not None and bool(sd.is_active())

    def send_pause_command(self) -> None:
        """Stop the source of commands (file or host program), without moving anything."""
        if self._command_sent:
            return
        if self.is_sd_active():
            self._sd_paused = True
            self._sd().do_pause()
        else:
            self._sd_paused = False
            self.gcode.respond_info("action:paused")
        self._command_sent = True

    def send_resume_command(self) -> None:
        """Let the source of commands go on."""
        if self._sd_paused:
            self._sd().do_resume()
            self._sd_paused = False
        else:
            self.gcode.respond_info("action:resumed")
        self._command_sent = False

    cmd_PAUSE_help = "Pauses the current print"

    def cmd_PAUSE(self, gcmd: GCodeCommand) -> None:
        """Pause and remember the position."""
        if self.is_paused:
            gcmd.respond_info("Print already paused")
            return
        self.send_pause_command()
        self.gcode.waits.hold()
        self.gcode.run_script_from_command("SAVE_GCODE_STATE NAME=PAUSE_STATE")
        self.is_paused = True

    cmd_RESUME_help = "Resumes the print from a pause"

    def cmd_RESUME(self, gcmd: GCodeCommand) -> None:
        """Return to the position and go on."""
        if not self.is_paused:
            gcmd.respond_info("Print is not paused, resume aborted")
            return
        velocity_mm_s = gcmd.get_float("VELOCITY", self.recover_velocity_mm_s, above=0.0)
        self.gcode.run_script_from_command(
            f"RESTORE_GCODE_STATE NAME=PAUSE_STATE MOVE=1 MOVE_SPEED={velocity_mm_s:.4f}"
        )
        self.send_resume_command()
        self.is_paused = False
        self.gcode.waits.thaw()

    cmd_CLEAR_PAUSE_help = "Clears the current paused state without resuming the print"

    def cmd_CLEAR_PAUSE(self, gcmd: GCodeCommand) -> None:
        """Forget the pause."""
        self.is_paused = self._command_sent = False
        self.gcode.waits.end("CLEAR_PAUSE")

    cmd_CANCEL_PRINT_help = "Cancel the current print"

    def cmd_CANCEL_PRINT(self, gcmd: GCodeCommand) -> None:
        """Give up the print."""
        sd = self._sd()
        if sd is not None and sd.has_print():
            sd.do_cancel()
        else:
            gcmd.respond_info("action:cancel")
        self.gcode.waits.end("CANCEL_PRINT")
        self.is_paused = self._command_sent = self._sd_paused = False


def load_config(config: ConfigWrapper) -> PauseResume:
    """Section [pause_resume]."""
    pause_resume = PauseResume(config.get_printer(), config.getfloat("recover_velocity", 50.0, above=0.0))
    pause_resume.register()
    return pause_resume
