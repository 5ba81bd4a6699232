"""A probe put together of helpers; which of several switches counts is chosen by a command."""

from . import probe


class Router:
    """The endstop of the tool in use."""

    def __init__(self, printer):
        self.printer, self.active, self.switches = printer, None, []

    def add(self, switch):
        self.switches.append(switch)
        self.active = self.active or switch

    def add_stepper(self, stepper):
        for switch in self.switches:
            switch.add_stepper(stepper)

    def __getattr__(self, name):
        return getattr(self.active, name)

    def get_position_endstop(self):
        return 0.0


class ToolTap:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.router = Router(self.printer)
        self.params = probe.ProbeParameterHelper(config)
        self.homing = probe.HomingViaProbeHelper(config, self.router, self.params)
        self.session = probe.ProbeSessionHelper(config, self.params, self.homing.start_probe_session)
        for name in config.getlist("switches"):
            section = config.getsection(name)
            self.router.add(probe.ProbeEndstopWrapper(section))
            self.offsets = probe.ProbeOffsetsHelper(section)
        self.commands = probe.ProbeCommandHelper(config, self, self.router.query_endstop)
        self.printer.add_object("probe", self)

    def get_offsets(self, gcmd=None):
        return self.offsets.get_offsets()

    def get_probe_params(self, gcmd=None):
        return self.params.get_probe_params(gcmd)

    def start_probe_session(self, gcmd):
        return self.session.start_probe_session(gcmd)

    def get_status(self, eventtime):
        return self.commands.get_status(eventtime)


def load_config(config):
    return ToolTap(config)
