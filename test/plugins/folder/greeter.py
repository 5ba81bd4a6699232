"""A macro-like extra: [greeter NAME] runs a template of its own some times over."""


class Greeter:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.name = config.get_name().split()[1]
        self.gcode = self.printer.lookup_object("gcode")
        gcode_macro = self.printer.load_object(config, "gcode_macro")
        self.template = gcode_macro.load_template(config, "gcode")
        self.delay = config.getfloat("delay", 0.0, minval=0.0)
        self.greeted = 0
        self.gcode.register_mux_command(
            "GREET", "GREETER", self.name, self.cmd_GREET, desc=self.cmd_GREET_help
        )

    cmd_GREET_help = "Run the greeting of a greeter"

    def cmd_GREET(self, gcmd):
        times = gcmd.get_int("TIMES", 1, minval=1, maxval=10)
        who = gcmd.get("WHO", "nobody")
        if who == "nobody":
            raise gcmd.error("GREET needs somebody")
        toolhead = self.printer.lookup_object("toolhead")
        for _ in range(times):
            context = self.template.create_template_context()
            context["who"] = who
            self.template.run_gcode_from_command(context)
            toolhead.dwell(self.delay)
            self.greeted += 1

    def get_status(self, eventtime):
        return {"greeted": self.greeted}


def load_config_prefix(config):
    return Greeter(config)
