"""Third-party modules with a probe of their own, or that work on probed points: what they import and call is there."""

from __future__ import annotations

from pathlib import Path

from plugins.test_plugins import ROOT, run_host

OWN_PROBE = '''
from . import probe


class Tap:
    """A probe that is the nozzle itself."""

    def __init__(self, config):
        self.printer = config.get_printer()
        self.position_endstop = config.getfloat("z_offset")
        endstop = self.printer.lookup_object("pins").setup_pin("endstop", config.get("pin"))
        self.get_mcu, self.add_stepper, self.get_steppers = endstop.get_mcu, endstop.add_stepper, endstop.get_steppers
        self.home_start, self.home_wait = endstop.home_start, endstop.home_wait
        self.query_endstop = endstop.query_endstop
        self.calls = []
        self.printer.register_event_handler("klippy:mcu_identify", self.identify)

    def identify(self):
        for stepper in self.printer.lookup_object("toolhead").get_kinematics().get_steppers():
            if stepper.is_active_axis("z"):
                self.add_stepper(stepper)

    def get_position_endstop(self):
        return self.position_endstop

    def multi_probe_begin(self):
        self.calls.append("begin")

    def multi_probe_end(self):
        self.calls.append("end")
        self.printer.lookup_object("gcode").respond_info("tap: " + " ".join(self.calls))
        self.calls = []

    def probe_prepare(self, hmove):
        self.calls.append("prepare")

    def probe_finish(self, hmove):
        self.calls.append("finish")

    def probing_move(self, pos, speed):
        return self.printer.lookup_object("homing").probing_move(self, pos, speed)


def load_config(config):
    tap = Tap(config)
    config.get_printer().add_object("probe", probe.PrinterProbe(config, tap))
    return tap
'''
POINTS = """
from . import manual_probe, probe


class Corners:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.helper = probe.ProbePointsHelper(config, self.done)
        self.helper.minimum_points(3)
        self.rounds = 0
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("CORNERS", self.cmd_CORNERS)
        gcode.register_command("PAPER", self.cmd_PAPER)

    def cmd_CORNERS(self, gcmd):
        self.helper.start_probe(gcmd)

    def done(self, offsets, positions):
        self.rounds += 1
        text = " ".join("%.1f,%.1f,%.2f" % tuple(p) for p in positions)
        self.printer.lookup_object("gcode").respond_info("corners %d %s offset %.2f" % (self.rounds, text, offsets[2]))
        return "retry" if self.rounds == 1 else None

    def cmd_PAPER(self, gcmd):
        manual_probe.verify_no_manual_probe(self.printer)
        manual_probe.ManualProbeHelper(self.printer, gcmd, lambda pos: gcmd.respond_info("paper %.2f" % pos[2]))


def load_config(config):
    return Corners(config)
"""
CONFIG = """
[plugins]
path: {folder}
[tap]
pin: PG15
z_offset: -0.1
[stepper_z]
endstop_pin: probe:z_virtual_endstop
position_min: -2
[corners]
points:
  10, 10
  100, 10
  50, 90
"""
SCRIPT = """
G28
PROBE
CORNERS
PAPER
TESTZ Z=-1
ACCEPT
"""


def test_plugins_with_a_probe_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "tap.py").write_text(OWN_PROBE)
    (folder / "corners.py").write_text(POINTS)
    machine = (ROOT / "config" / "sim-induction.cfg").read_text()
    machine = machine.replace("endstop_pin: PC4\nposition_endstop: 0\nposition_min: 0\n", "")
    status, log = run_host(tmp_path, ROOT / "klippy", machine + CONFIG.format(folder=folder), SCRIPT)
    assert status == 0, log[-3000:]
    # homing approaches twice, a probe once, three points once each
    assert "tap: begin prepare finish prepare finish end" in log
    assert "tap: begin prepare finish end" in log
    assert "tap: begin prepare finish prepare finish prepare finish end" in log
    assert "Result is z=-2.000000" in log
    assert "corners 2 10.0,10.0,-2.00 100.0,10.0,-2.00 50.0,90.0,-2.00 offset -0.10" in log
    assert "paper 4.00" in log
    assert "Traceback" not in log
