"""A temperature sensor as third parties write them: [sine_sensor] makes sensor_type SINE known."""

import math


class SineSensor:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name().split()[-1]
        self.mean = config.getfloat("sine_mean", 40.0)
        self.swing = config.getfloat("sine_swing", 5.0, minval=0.0)
        self.callback = None
        self.min_temp = self.max_temp = 0.0
        self.printer.add_object("sine_sensor " + self.name, self)
        self.timer = self.reactor.register_timer(self._sample)
        self.printer.register_event_handler("klippy:connect", self._connect)

    def _connect(self):
        self.reactor.update_timer(self.timer, self.reactor.NOW)

    def setup_minmax(self, min_temp, max_temp):
        self.min_temp, self.max_temp = min_temp, max_temp

    def setup_callback(self, callback):
        self.callback = callback

    def get_report_time_delta(self):
        return 0.5

    def _sample(self, eventtime):
        temp = self.mean + self.swing * math.sin(eventtime)
        if temp > self.max_temp:
            self.printer.invoke_shutdown(f"SINE temperature {temp:0.1f} above maximum")
        mcu = self.printer.lookup_object("mcu")
        self.callback(mcu.estimated_print_time(self.reactor.monotonic()), temp)
        return eventtime + self.get_report_time_delta()


def load_config(config):
    config.get_printer().load_object(config, "heaters").add_sensor_factory("SINE", SineSensor)
