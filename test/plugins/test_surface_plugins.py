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


EDDY = """
class Session:
    def __init__(self, probe):
        self.probe, self.marks = probe, []

    def run_probe(self, gcmd):
        place = self.probe.toolhead().get_position()
        self.probe.toolhead().register_lookahead_callback(lambda time: self.marks.append((time, place)))

    def pull_probed_results(self):
        self.probe.toolhead().get_last_move_time()
        times = [time for time, _place in self.marks]
        gaps = [after - before for before, after in zip(times, times[1:])]
        columns = [0.0, *(p[0] for _time, p in self.marks)]
        turns = sorted(set(round(x, 3) for x, _y in self.probe.ends if x not in columns))
        self.probe.printer.lookup_object("gcode").respond_info(
            "%d points, %.2f s apart at most, turns at %s" % (len(times), max(gaps, default=0), turns))
        return [[p[0], p[1], 2.0 + p[0] / 1000] for _time, p in self.marks[: self.probe.keep]]

    def end_probe_session(self):
        pass


class Eddy:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.printer.add_object("probe", self)
        self.printer.lookup_object("gcode").register_command("EDDY_KEEP", self.cmd_EDDY_KEEP)
        self.printer.register_event_handler("klippy:ready", self.ready)
        self.keep, self.ends = None, []

    def toolhead(self):
        return self.printer.lookup_object("toolhead")

    def ready(self):
        self.toolhead().register_move_listener(lambda moves: self.ends.extend(m.end_pos[:2] for m in moves))

    def cmd_EDDY_KEEP(self, gcmd):
        self.keep, self.ends = gcmd.get_int("COUNT"), []

    def get_status(self, eventtime):
        return {"name": "probe_eddy_current coil"}

    def get_probe_params(self, gcmd=None):
        return {"lift_speed": 5.0}

    def get_offsets(self, gcmd=None):
        return 0.0, 0.0, 2.0

    def start_probe_session(self, gcmd):
        return Session(self)


def load_config(config):
    return Eddy(config)
"""
EDDY_CONFIG = """
[include {root}/config/example-cartesian.cfg]
[plugins]
path: {folder}
[eddy_scan]
[bed_mesh]
mesh_min: 10, 10
mesh_max: 150, 100
probe_count: 4, 3
horizontal_move_z: 3
scan_overshoot: 8
speed: 100
"""


def test_a_bed_is_scanned_without_a_stop(tmp_path: Path) -> None:
    """At 100 mm/s, 47 mm between points; between rows the head goes 8 mm on and comes back."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "eddy_scan.py").write_text(EDDY)
    config = EDDY_CONFIG.format(root=ROOT, folder=tmp_path / "plugins")
    scan = "BED_MESH_CALIBRATE METHOD="
    script = f"G28\nEDDY_KEEP COUNT=12\n{scan}rapid_scan\nBED_MESH_MAP\n{scan}scan\n"
    status, log = run_host(tmp_path, ROOT / "klippy", config, script)
    assert status == 0, log[-3000:]
    assert "12 points, 0.67 s apart at most, turns at [2.0, 158.0]" in log
    assert log.count("Mesh Bed Leveling Complete") == 2
    assert "0.010000, 0.056667, 0.103333, 0.150000" in log
    status, log = run_host(tmp_path, ROOT / "klippy", config, script.replace("COUNT=12", "COUNT=11"))
    assert status != 0 and "The probe measured 11 of 12 points" in log


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
