"""No class at all, and a package: [plain_function] adds one command that reports an MCU's clock."""


def load_config(config):
    printer = config.get_printer()
    factor = config.getint("factor", 2)
    choice = config.getchoice("mode", {"add": 1, "sub": -1}, "add")
    gcode = printer.lookup_object("gcode")

    def cmd_PLAIN(gcmd):
        reactor = printer.get_reactor()
        mcu = printer.lookup_object("mcu")
        clock = mcu.print_time_to_clock(mcu.estimated_print_time(reactor.monotonic()))
        reactor.pause(reactor.monotonic() + 0.001)
        value = gcmd.get_float("VALUE") * factor * choice
        gcmd.respond_info(f"plain {value:.1f} clock {'ok' if clock >= 0 else '?'}")

    gcode.register_command("PLAIN", cmd_PLAIN)
