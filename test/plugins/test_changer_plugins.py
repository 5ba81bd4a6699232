"""Names that tool changers, racks of filament, tuners and calibrators of Z look up on objects of ours."""

from __future__ import annotations

from pathlib import Path

import pytest

from plugins.test_machine_plugins import drop_into_extras
from plugins.test_plugins import ROOT, run_host

CHANGER = """
class Changer:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.gcode = self.printer.lookup_object("gcode")
        self.gcode_move = self.printer.load_object(config, "gcode_move")
        self.template = self.printer.load_object(config, "gcode_macro").load_template(config, "change_gcode")
        self.servo = self.printer.load_object(config, "servo lock")
        self.gcode.register_command("T4", lambda gcmd: self.select(self.gcode._get_extended_params(gcmd)), desc="tool")
        self.gcode.register_command("CHANGE", self.cmd_CHANGE, desc="Change the tool")
        self.printer.register_event_handler("klippy:connect", self.connect)
        self.printer.register_event_handler("klippy:ready", self.ready)
        self.after_ready = False

    def connect(self):
        self.kept = self.printer.lookup_object("save_variables").allVariables
        self.kept["at_connect"] = [1, 2]

    def ready(self):
        self.printer.get_reactor().register_callback(lambda eventtime: setattr(self, "after_ready", True))

    def select(self, gcmd):
        gcmd.respond_info("selected %s: %s" % (gcmd.get_command(), gcmd.get_command_parameters()))

    def cmd_CHANGE(self, gcmd):
        assert self.after_ready, "put off at klippy:ready, and not run before the G-code"
        toolhead = self.printer.lookup_object("toolhead")
        self.gcode.run_script_from_command("SAVE_GCODE_STATE NAME=PAUSE_STATE")
        self.gcode_move.cmd_G1(self.gcode.create_gcode_command("G0", "G0", {"X": 12.5, "Z": 6}))
        self.gcode_move.saved_states["PAUSE_STATE"]["last_position"] = [20.0, 21.0, 6.0, 0.0]
        self.gcode.run_script_from_command("RESTORE_GCODE_STATE NAME=PAUSE_STATE MOVE=1")
        self.template.run_gcode_from_command(
            {**self.template.create_template_context(), "tool": {"params": {"hook": 2}}, "dropoff_tool": None})
        fan = self.printer.lookup_object("fan_generic part")
        self.gcode.run_script_from_command("SET_FAN_SPEED FAN='%s' SPEED=0.5" % fan.fan_name)
        home = self.printer.lookup_object("safe_z_home")
        self.gcode_move.base_position[0] += 1.5
        self.gcode_move.absolute_coord = False
        self.gcode.run_script_from_command("G1 Y2")
        gcmd.respond_info("gcode at %s, z homed at %.0f %.0f" % (
            tuple(self.gcode_move.get_status()["gcode_position"][:3]), home.home_x_pos, home.home_y_pos))
        time = toolhead.get_last_move_time()
        self.servo._set_pwm(time, self.servo._get_pwm_from_angle(self.servo.max_angle / 2))
        middle = self.servo.get_status(0)["value"]
        self.servo._set_pwm(time + 1, self.servo._get_pwm_from_pulse_width(0.002))
        self.gcode.run_script_from_command("SAVE_VARIABLE VARIABLE=tool VALUE=4")
        key, handlers = self.gcode.mux_commands["SET_FAN_SPEED"]
        heater = toolhead.get_extruder().get_heater()
        gcmd.respond_info("changed at %s servo %.3f %.3f kept %s by %s %s knows %s %s extrudes at %.0f set %.0f" % (
            toolhead.get_position()[:3], middle, self.servo.get_status(0)["value"], self.kept, key, sorted(handlers),
            "T4" in self.gcode.ready_gcode_handlers, self.gcode.gcode_help["CHANGE"], heater.min_extrude_temp,
            heater.target_temp))


def load_config(config):
    return Changer(config)
"""
TUNER = """
class Tuner:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.mesh = self.printer.load_object(config, "bed_mesh")
        self.printer.lookup_object("gcode").register_command("LOOK", self.cmd_LOOK)

    def cmd_LOOK(self, gcmd):
        driver = self.printer.lookup_object("tmc2209 stepper_x")
        helper = driver.get_status.__self__
        fields = helper.fields.all_fields["CHOPCONF"]
        values = {n: helper.fields.get_field(n, helper.fields.registers["CHOPCONF"], "CHOPCONF") for n in fields}
        assert "CHOPCONF" in helper.read_registers and helper.read_translate is None
        config = self.printer.lookup_object("configfile")
        bmc = self.mesh.bmc
        before = bmc.probe_mgr.zero_ref_pos
        bmc.zero_ref_pos = (30, 40)
        gcmd.respond_info("tbl %d of mask %x, %s, mesh %s %s: %s then %s, %d points" % (
            values["tbl"], fields["tbl"], config.status_raw_config["printer"]["kinematics"],
            bmc.mesh_config["min_x"], bmc.mesh_config["x_count"], before, self.mesh.options.zero_reference,
            len(bmc.probe_mgr.get_base_points())))
        try:
            raise config.error("not so")
        except self.printer.config_error as e:
            gcmd.respond_info("known error: %s" % (e,))


def load_config(config):
    return Tuner(config)
"""
CONFIG = """
[include {root}/config/example-cartesian.cfg]
[respond]
[save_variables]
filename: {folder}/kept.cfg
[servo lock]
pin: PE0
[fan_generic part]
pin: PE1
[changer]
change_gcode: SET_FAN_SPEED FAN=part SPEED={{tool.params.hook / 4 if dropoff_tool is none else 0}}
[tmc2209 stepper_x]
uart_pin: PF0
run_current: 0.8
sense_resistor: 0.110
driver_TBL: 1
[looker]
[safe_z_home]
home_xy_position: 60, 70
[bed_mesh]
mesh_min: 10, 20
mesh_max: 100, 100
probe_count: 4, 3
zero_reference_position: 50, 50
"""
SCRIPT = """
G28
G1 X50 Y50 Z5 F6000
CHANGE
T4 LANE=2 HOW="with care"
LOOK
"""


@pytest.mark.parametrize("dropped", [False, True], ids=["folder", "extras"])
def test_plugins_that_change_tools_and_look_into_drivers(tmp_path: Path, dropped: bool) -> None:
    klippy = drop_into_extras(tmp_path) if dropped else ROOT / "klippy"
    modules = klippy / "extras" if dropped else tmp_path / "plugins"
    modules.mkdir(exist_ok=True)
    (modules / "changer.py").write_text(CHANGER)
    (modules / "looker.py").write_text(TUNER)
    folder = "" if dropped else f"[plugins]\npath: {modules}\n"
    status, log = run_host(tmp_path, klippy, folder + CONFIG.format(root=ROOT, folder=tmp_path), SCRIPT)
    assert status == 0, log[-3000:]
    assert "Traceback" not in log
    # the pulse of half the angle is 1.5 ms, the longest 2 ms, of 20 ms
    assert "gcode at (18.5, 23.0, 6.0), z homed at 60 70" in log
    assert "changed at [20.0, 23.0, 6.0] servo 0.075 0.100" in log
    assert "kept {'at_connect': [1, 2], 'tool': 4} by FAN ['part'] knows True Change the tool" in log
    assert "extrudes at 170 set 0" in log
    assert "selected T4: {'LANE': '2', 'HOW': 'with care'}" in log
    assert "tbl 1 of mask 18000, cartesian, mesh 10.0 4: (50.0, 50.0) then (30.0, 40.0), 12 points" in log
    assert "known error: not so" in log
    # what a plugin keeps is in the file, too
    assert (tmp_path / "kept.cfg").read_text() == "[Variables]\nat_connect = [1, 2]\ntool = 4\n"
