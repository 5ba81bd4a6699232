"""A sensor's filtered signal as the end of a homing move (src/trigger_analog.h)."""

from __future__ import annotations

from typing import Any

from link.mcu_homing import TriggerDispatch, Trsync

from .filters import McuFilter

ERROR_REASON = 16  # reasons from here on are errors: of the trigger, then of the sensor
MONITOR_SAMPLES = 3  # without one for so many periods the head stops
SENSOR_ERROR = "SENSOR_SPECIFIC"
ERRORS = {
    "RAW_RANGE": "the reading is beyond its safe range",
    "OVERFLOW": "the filter has overflowed",
    "MONITOR": "no data from the sensor in time: check its wiring and grounding",
}
SENSOR_ERRORS = {
    "SENSOR_ERROR_CRC": "damaged data: check its wiring and grounding",
    "SENSOR_ERROR_RESET": "that it has been reset: check its power",
}
TRIGGER = "trigger_analog_set_trigger oid=%c trigger_analog_type=%c trigger_value=%i"
RAW_RANGE = "trigger_analog_set_raw_range oid=%c raw_min=%i raw_max=%i"
HOME = (
    "trigger_analog_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u monitor_ticks=%u"
    " monitor_max=%u"
)


class AnalogEndstop:
    """As an endstop (klippy/link/mcu_homing.py). `attach` are the words of the sensor's command that joins them."""

    def __init__(self, mcu: Any, max_sections: int, sensor_errors: str = "") -> None:
        self._mcu = mcu
        self.oid = mcu.create_oid()
        self.filter = McuFilter(mcu, max_sections)
        self._dispatch = TriggerDispatch(mcu)
        self._sensor_errors = sensor_errors  # an enumeration of the board
        self.period_s = 0.0  # of the sensor's samples
        self.last_trigger_time = 0.0
        self._commands: dict[str, Any] = {}
        self._query: Any = None
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Any:
        return self._mcu

    def add_stepper(self, stepper: Any) -> None:
        self._dispatch.add_stepper(stepper)

    def get_steppers(self) -> list[Any]:
        return self._dispatch.get_steppers()

    def _build_config(self) -> None:
        mcu, queue = self._mcu, self._dispatch.get_command_queue()
        self.filter.build(queue)
        mcu.add_config_cmd(f"config_trigger_analog oid={self.oid} sos_filter_oid={self.filter.oid}")
        mcu.add_config_cmd(
            f"trigger_analog_home oid={self.oid} trsync_oid=0 trigger_reason=0 error_reason=0 clock=0 monitor_ticks=0"
            " monitor_max=0",
            on_restart=True,
        )
        self._commands = {
            "trigger": mcu.lookup_command(TRIGGER, cq=queue),
            "range": mcu.lookup_command(RAW_RANGE, cq=queue),
            "home": mcu.lookup_command(HOME, cq=queue),
        }
        self._query = mcu.lookup_query_command(
            "trigger_analog_query_state oid=%c",
            "trigger_analog_state oid=%c homing=%c homing_clock=%u",
            oid=self.oid,
            cq=queue,
        )

    def set_trigger(self, kind: str, value: int, raw_range: tuple[int, int]) -> None:
        """For the next homing move; `kind`: abs_ge, gt or diff_peak_gt."""
        self._commands["trigger"].send([self.oid, kind, value])
        self._commands["range"].send([self.oid, *raw_range])

    def home_start(
        self,
        print_time: float,
        sample_time: float,
        sample_count: int,
        rest_time: float,
        triggered: bool = True,
    ) -> Any:
        """Watch from print_time on. The sensor's own rhythm counts, not the looks of a switch."""
        self._mcu.require_connected()
        clock = self._mcu.print_time_to_clock(print_time)
        completion = self._dispatch.start(print_time)
        monitor_ticks = self._mcu.seconds_to_clock(self.period_s)
        reasons = [Trsync.REASON_ENDSTOP_HIT, ERROR_REASON]
        data = [self.oid, self._dispatch.get_oid(), *reasons, clock, monitor_ticks, MONITOR_SAMPLES]
        self._commands["home"].send(data, reqclock=clock)
        return completion

    def home_wait(self, home_end_time: float) -> float:
        """Wait for the trigger; returns its print time, 0 if the move ended without one."""
        self._dispatch.wait_end(home_end_time)
        self._commands["home"].send([self.oid, 0, 0, 0, 0, 0, 0])
        reason = self._dispatch.stop()
        if self._mcu.is_fileoutput():
            return home_end_time
        error = self._mcu.get_printer().command_error
        if reason == Trsync.REASON_COMMS_TIMEOUT:
            raise error("Communication timeout during homing")
        if reason >= ERROR_REASON:
            raise error(f"The probe has stopped the move: {self._describe(reason - ERROR_REASON)}")
        if reason != Trsync.REASON_ENDSTOP_HIT:
            return 0.0
        clock = self._mcu.clock32_to_clock64(self._query.send([self.oid])["homing_clock"])
        self.last_trigger_time = self._mcu.clock_to_print_time(clock)
        return self.last_trigger_time

    def _describe(self, code: int) -> str:
        known = self._mcu.get_enumerations()
        names = {number: name for name, number in known.get("trigger_analog_error:", {}).items()}
        first = min((number for number, name in names.items() if name == SENSOR_ERROR), default=len(names))
        if code < first:
            return ERRORS.get(names.get(code, ""), f"error {code}")
        of_sensor = {number: name for name, number in known.get(self._sensor_errors, {}).items()}
        name = of_sensor.get(code - first, f"error {code - first}")
        return f"the sensor reports {SENSOR_ERRORS.get(name, name)}"

    def query_endstop(self, print_time: float) -> int:
        """A sensor that is compared only while homing is open else."""
        return 0
