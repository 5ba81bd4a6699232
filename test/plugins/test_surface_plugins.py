"""Names that tuning, scanning and mesh plugins use: a driver's fields, sessions of a probe, a mesh of their own."""

from __future__ import annotations

from pathlib import Path

from plugins.test_plugins import ROOT, run_host

TUNER = """
from . import tmc


class Tuner:
    def __init__(self, config):
        self.printer = config.get_printer()
        data = self.printer.lookup_object("configfile").read_config(config.get("database"))
        self.motors = [s.get_name() for s in data.get_prefix_sections("motor ")]
        self.ohm = data.getsection(self.motors[0]).getfloat("resistance")
        self.printer.lookup_object("gcode").register_command("TUNE", self.cmd_TUNE)

    def cmd_TUNE(self, gcmd):
        driver = self.printer.lookup_object("tmc2209 stepper_x")
        fields = driver.fields
        assert fields.lookup_register("no_such_field", None) is None
        register = fields.lookup_register("tbl", None)
        value = fields.set_field("tbl", 1)
        driver.mcu_tmc.set_register(register, value, None)
        step = tmc.TMCtstepHelper(driver.mcu_tmc, 50.0, pstepper=driver.stepper)
        run, hold, wanted, largest = driver.current_helper.get_current()
        driver.current_helper.set_current(0.5, 0.4)
        gcmd.respond_info("tuned %s %s tbl %d tstep %d run %.2f of %.2f, %s %.1f ohm" % (
            register, hex(value), fields.get_field("tbl"), step, run, largest, self.motors[0], self.ohm))


def load_config(config):
    return Tuner(config)
"""
SCANNER = """
from . import bed_mesh, manual_probe


class Session:
    def __init__(self, printer):
        self.printer, self.results = printer, []

    def run_probe(self, gcmd):
        x, y = self.printer.lookup_object("toolhead").get_position()[:2]
        self.results.append(manual_probe.ProbeResult(x + 5, y, x / 1000, x, y, 2 + x / 1000))

    def pull_probed_results(self):
        results, self.results = self.results, []
        return results

    def end_probe_session(self):
        self.printer.lookup_object("gcode").respond_info("session over")


class Scanner:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.printer.add_object("probe", self)
        self.printer.lookup_object("gcode").register_command("OWN_MESH", self.cmd_OWN_MESH)

    def get_probe_params(self, gcmd=None):
        return {"lift_speed": 5.0}

    def get_offsets(self, gcmd=None):
        return 5.0, 0.0, 2.0

    def start_probe_session(self, gcmd):
        return Session(self.printer)

    def cmd_OWN_MESH(self, gcmd):
        mesh = bed_mesh.ZMesh({"min_x": 0.0, "max_x": 100.0, "min_y": 0.0, "max_y": 100.0, "x_count": 3, "y_count": 3,
                               "mesh_x_pps": 0, "mesh_y_pps": 0, "algo": "bicubic", "tension": 0.2}, "scan")
        try:
            mesh.build_mesh([[0.0, 0.1]])
        except bed_mesh.BedMeshError as e:
            gcmd.respond_info("refused: %s" % (e,))
        mesh.build_mesh([[0.0, 0.1, 0.2]] * 3)
        meshes = self.printer.lookup_object("bed_mesh")
        meshes.set_mesh(mesh)
        meshes.save_profile("scan")
        status = meshes.get_status(0.0)
        gcmd.respond_info("mesh %s %.3f %s" % (
            status["profile_name"], mesh.calc_z(25.0, 50.0), sorted(status["profiles"])))


def load_config(config):
    return Scanner(config)
"""
CONFIG = """
[include {root}/config/example-cartesian.cfg]
[plugins]
path: {folder}
[tuner]
database: {folder}/motors.txt
[scanner]
[tmc2209 stepper_x]
uart_pin: PF0
run_current: 0.8
sense_resistor: 0.110
[bed_mesh]
mesh_min: 5, 0
mesh_max: 105, 100
probe_count: 3
"""


def test_plugins_with_drivers_meshes_and_sessions(tmp_path: Path) -> None:
    folder = tmp_path / "plugins"
    folder.mkdir()
    (folder / "tuner.py").write_text(TUNER)
    (folder / "scanner.py").write_text(SCANNER)
    (folder / "motors.txt").write_text("[motor a]\nresistance: 1.5\n")
    config = CONFIG.format(root=ROOT, folder=folder)
    status, log = run_host(tmp_path, ROOT / "klippy", config, "G28\nTUNE\nBED_MESH_CALIBRATE\nOWN_MESH\n")
    assert status == 0, log[-3000:]
    # 12 MHz, 1/256 of a full step of 40 mm / 200 steps, 50 mm/s
    assert "tbl 1 tstep 188 run 0.80 of " in log and "motor a 1.5 ohm" in log
    assert "session over" in log and "Mesh Bed Leveling Complete" in log
    assert "refused: the mesh is not 3 rows of 3 heights" in log
    assert "mesh scan 0.050 ['default', 'scan']" in log
    assert "Traceback" not in log
