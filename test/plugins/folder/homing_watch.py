"""Hooks homing events and moves a little afterwards: [homing_watch]."""


class HomingWatch:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.lift = config.getfloat("lift", 2.0, above=0.0)
        self.begun = []
        self.ended = []
        self.moves = 0
        self.printer.register_event_handler("homing:home_rails_begin", self.handle_begin)
        self.printer.register_event_handler("homing:home_rails_end", self.handle_end)
        self.printer.register_event_handler("homing:homing_move_begin", self.handle_move)
        gcode = self.printer.lookup_object("gcode")
        self.prev_G28 = None
        self.printer.register_event_handler("klippy:connect", self.handle_connect)
        gcode.register_command("HOMING_WATCH", self.cmd_HOMING_WATCH, desc="Report what was homed")

    def handle_connect(self):
        gcode = self.printer.lookup_object("gcode")
        self.prev_G28 = gcode.register_command("G28", None)
        gcode.register_command("G28.1", self.prev_G28)
        gcode.register_command("G28", self.cmd_G28)

    def handle_begin(self, homing_state, rails):
        self.begun.append([rail.get_steppers()[0].get_name() for rail in rails])

    def handle_end(self, homing_state, rails):
        self.ended.extend(homing_state.get_axes())

    def handle_move(self, hmove):
        self.moves += 1

    def cmd_G28(self, gcmd):
        self.prev_G28(gcmd)
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.wait_moves()
        toolhead.manual_move([None, None, self.lift], 5.0)
        kin_status = toolhead.get_kinematics().get_status(toolhead.get_last_move_time())
        gcmd.respond_info(f"homed now: {kin_status['homed_axes']}")

    def cmd_HOMING_WATCH(self, gcmd):
        pos = self.printer.lookup_object("toolhead").get_position()
        gcmd.respond_info(
            f"rails {self.begun} axes {sorted(set(self.ended))} moves {self.moves} z {pos[2]:.3f}"
        )


def load_config(config):
    return HomingWatch(config)
