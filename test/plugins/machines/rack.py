"""A filament rack: a toolhead of the plugin's own with two motors, which can follow or drive the extruder."""

import chelper
import kinematics.extruder
import toolhead
from extras.homing import Homing, HomingMove
from stepper import LookupMultiRail


class RackHead(toolhead.ToolHead):
    def __init__(self, config):
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.all_mcus = [m for _name, m in self.printer.lookup_objects(module="mcu")]
        self.mcu = self.all_mcus[0]
        self.lookahead = toolhead.LookAheadQueue(self)
        self.lookahead.set_flush_time(toolhead.BUFFER_TIME_HIGH)
        self.commanded_pos = [0.0, 0.0, 0.0, 0.0]
        self.max_velocity, self.max_accel = 200.0, 1000.0
        self.min_cruise_ratio, self.square_corner_velocity = 0.5, 5.0
        self.requested_accel_to_decel = 500.0
        self.junction_deviation = self.max_accel_to_decel = 0.0
        self._calc_junction_deviation()
        self.can_pause = not self.mcu.is_fileoutput()
        self.print_time = 0.0
        self.print_stall = 0
        self.flush_timer = self.reactor.register_timer(self._flush_handler)
        self.kin_flush_delay = toolhead.SDS_CHECK_TIME
        ffi, lib = chelper.get_ffi()
        self.trapq = ffi.gc(lib.trapq_alloc(), lib.trapq_free)
        self.trapq_append = lib.trapq_append
        self.trapq_finalize_moves = lib.trapq_finalize_moves
        self.step_generators = []
        self.extruder = kinematics.extruder.DummyExtruder(self.printer)
        self.kin = RackKinematics(self, config)
        self.printer.register_event_handler("klippy:shutdown", self._handle_shutdown)

    def set_position(self, newpos, homing_axes=()):
        super().set_position([*newpos, *[0.0] * (4 - len(newpos))], homing_axes)


class RackKinematics:
    def __init__(self, head, config):
        self.rails = [
            LookupMultiRail(config.getsection(name)) for name in ("stepper_selector", "stepper_drive")
        ]
        for rail, axis in zip(self.rails, "xy", strict=True):
            rail.setup_itersolve("cartesian_stepper_alloc", axis.encode())
            for motor in rail.get_steppers():
                motor.set_trapq(head.get_trapq())
                head.register_step_generator(motor.generate_steps)
        self.limits = [(1.0, -1.0)] * 2

    def get_steppers(self):
        return [motor for rail in self.rails for motor in rail.get_steppers()]

    def calc_position(self, stepper_positions):
        return [stepper_positions[rail.get_name()] for rail in self.rails]

    def set_position(self, newpos, homing_axes):
        for number, rail in enumerate(self.rails):
            rail.set_position(newpos)
            if number in homing_axes:
                self.limits[number] = rail.get_range()

    def check_move(self, move):
        low, high = self.limits[0]
        if move.axes_d[0] and not low <= move.end_pos[0] <= high:
            raise move.move_error("Must home the rack first" if low > high else "Move out of range")
        move.limit_speed(100.0, 800.0)

    def get_status(self, eventtime):
        return {
            "homed_axes": "".join(a for a, (low, high) in zip("xy", self.limits, strict=True) if low <= high)
        }

    def home(self, state):
        for axis in state.get_axes():
            rail = self.rails[axis]
            info = rail.get_homing_info()
            start, home = [None] * 4, [None] * 4
            home[axis] = info.position_endstop
            start[axis] = info.position_endstop + 1.5 * (rail.get_range()[1] - info.position_endstop)
            state.home_rails([rail], start, home)


class RackHoming(Homing):
    def __init__(self, printer, head):
        super().__init__(printer)
        self.toolhead = head

    def home_rails(self, rails, forcepos, movepos):
        axes = [axis for axis in range(3) if forcepos[axis] is not None]
        self.toolhead.set_position(self._fill_coord(forcepos), homing_axes=axes)
        endstops = [endstop for rail in rails for endstop in rail.get_endstops()]
        move = HomingMove(self.printer, endstops, self.toolhead)
        move.homing_move(self._fill_coord(movepos), rails[0].get_homing_info().speed)
        self.trigger_mcu_pos = {sp.stepper_name: sp.trig_pos for sp in move.stepper_positions}


class Rack:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.head = RackHead(config)
        self.gcode = self.printer.lookup_object("gcode")
        for name in ("RACK_HOME", "RACK_MOVE", "RACK_SYNC", "RACK_UNSYNC"):
            self.gcode.register_command(name, getattr(self, "cmd_" + name))

    def cmd_RACK_HOME(self, gcmd):
        state = RackHoming(self.printer, self.head)
        state.set_axes([0])
        self.head.get_kinematics().home(state)
        self._report(gcmd, f"homed {sorted(state.trigger_mcu_pos)}")

    def cmd_RACK_MOVE(self, gcmd):
        place = self.head.get_position()
        place[0] = gcmd.get_float("SELECTOR", place[0])
        place[1] = gcmd.get_float("DRIVE", place[1])
        self.head.move(place, gcmd.get_float("SPEED", 50.0))
        self.head.wait_moves()
        self._report(gcmd, "moved")

    def _report(self, gcmd, text):
        self.head.flush_step_generation()
        motors = [*self.head.get_kinematics().get_steppers(), self._extruder_motor()]
        places = " ".join(f"{motor.get_commanded_position():.2f}" for motor in motors)
        busy = self.head.check_busy(self.printer.get_reactor().monotonic())
        gcmd.respond_info(f"rack {text}: {places} idle {busy[2]}")

    def _extruder_motor(self):
        return self.printer.lookup_object("toolhead").get_extruder().extruder_stepper.stepper

    def cmd_RACK_SYNC(self, gcmd):
        """The rack's drive turns the extruder, too."""
        main = self.printer.lookup_object("toolhead")
        main.flush_step_generation()
        self.head.flush_step_generation()
        ffi, lib = chelper.get_ffi()
        motor = self._extruder_motor()
        solver = ffi.gc(lib.cartesian_stepper_alloc(b"y"), lib.free)
        self.before = (
            motor.set_stepper_kinematics(solver),
            motor.get_trapq(),
            motor.get_rotation_distance()[0],
        )
        motor.set_trapq(self.head.get_trapq())
        motor.set_position((0.0, self.head.get_position()[1], 0.0))
        main.step_generators.remove(motor.generate_steps)
        self.head.register_step_generator(motor.generate_steps)

    def cmd_RACK_UNSYNC(self, gcmd):
        main = self.printer.lookup_object("toolhead")
        self.head.flush_step_generation()
        motor = self._extruder_motor()
        solver, queue, distance = self.before
        motor.set_trapq(queue)
        motor.set_stepper_kinematics(solver)
        motor.set_rotation_distance(distance)
        motor.set_position([main.get_position()[3], 0.0, 0.0])
        self.head.step_generators.remove(motor.generate_steps)
        main.register_step_generator(motor.generate_steps)


def load_config(config):
    return Rack(config)
