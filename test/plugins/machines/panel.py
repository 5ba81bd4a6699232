"""Puts macros of a file of its own into the config, fills in options, and looks for another host."""

import importlib.util
import os

from klippy import APP_NAME


class Panel:
    def __init__(self, config):
        self.printer = config.get_printer()
        assert importlib.util.find_spec("extras.danger_options") is None
        configfile = self.printer.lookup_object("configfile")
        path = os.path.join(os.path.dirname(os.path.realpath(__file__)), "panel.cfg")
        for macro in configfile.read_config(path).get_prefix_sections("gcode_macro "):
            name = macro.get_name()
            macro.fileconfig.set(name, "description", "Of the panel")
            if not config.fileconfig.has_section(name.lower()):
                config.fileconfig.add_section(name.lower())
            for option in macro.fileconfig.options(name):
                config.fileconfig.set(name.lower(), option, macro.fileconfig.get(name, option))
                config.access_tracking[(name.lower(), option.lower())] = 1
            self.printer.load_object(config, name.lower())
        for axis in "yz":
            if not config.fileconfig.has_option("stepper_" + axis, "step_pulse_duration"):
                shared = config.fileconfig.get("stepper_x", "step_pulse_duration")
                config.fileconfig.set("stepper_" + axis, "step_pulse_duration", shared)
        self.printer.lookup_object("gcode").register_command("PANEL", self.cmd_PANEL)

    def cmd_PANEL(self, gcmd):
        motors = self.printer.lookup_object("toolhead").get_kinematics().get_steppers()
        pulses = [f"{motor.get_pulse_duration()[0]:.6f}" for motor in motors]
        gcmd.respond_info(f"panel of {APP_NAME} {pulses}")
        toolhead = self.printer.lookup_object("toolhead")
        accel = toolhead.set_max_velocities(None, None, None, None)[1]
        toolhead.set_max_velocities(None, 1500.0, 4.0, None)
        status = toolhead.get_status(0.0)
        toolhead.cmd_M204(
            self.printer.lookup_object("gcode").create_gcode_command("M204", "M204", {"S": accel})
        )
        numbers = accel, status["max_accel"], toolhead.max_accel, status["square_corner_velocity"]
        gcmd.respond_info("accel {:.0f} {:.0f} {:.0f} corner {:.0f}".format(*numbers))


def load_config(config):
    return Panel(config)
