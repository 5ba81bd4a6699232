"""A rail beside the kinematics, with motion queues from `motion_queuing`; also an axis of G1."""

import stepper
from extras import force_move


class Shuttle:
    def __init__(self, config):
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.rail = stepper.LookupMultiRail(config)
        self.queuing = self.printer.load_object(config, "motion_queuing")
        self.trapq = self.queuing.allocate_trapq()
        self.append = self.queuing.lookup_trapq_append()
        self.rail.setup_itersolve("cartesian_stepper_alloc", b"x")
        self.rail.set_trapq(self.trapq)
        self.queuing.register_flush_callback(self.flushed)
        self.flushes = 0
        self.time = self.place = 0.0
        gcode = self.printer.lookup_object("gcode")
        gcode.register_mux_command("SHUTTLE", "RAIL", self.name.split()[1], self.cmd_SHUTTLE)

    def flushed(self, flush_time, step_gen_time):
        self.flushes += 1

    def get_name(self):
        return self.name

    def cmd_SHUTTLE(self, gcmd):
        letter = gcmd.get("GCODE_AXIS", None)
        toolhead = self.printer.lookup_object("toolhead")
        if letter:
            self.letter = letter
            toolhead.add_extra_axis(self, self.place)
        elif letter is not None:
            toolhead.remove_extra_axis(self)
        elif gcmd.get_int("HOME", 0):
            info = self.rail.get_homing_info()
            self.set_position([info.position_endstop + 1.5 * self.rail.get_range()[1]])
            homing = self.printer.lookup_object("homing")
            target = [info.position_endstop, 0.0, 0.0, 0.0]
            homing.manual_home(self, self.rail.get_endstops(), target, info.speed, True, True)
        else:
            self.get_last_move_time()
            self.time = self.submit(self.time, gcmd.get_float("MOVE"), 20.0, 100.0)
            self.queuing.note_mcu_movequeue_activity(self.time)
            self.get_last_move_time()
        toolhead.flush_step_generation()
        place = self.rail.get_steppers()[0].get_commanded_position()
        gcmd.respond_info(f"shuttle at {self.place:.3f} motor {place:.2f} flushed {self.flushes > 0}")

    def submit(self, time, place, speed, accel):
        way, accel_t, cruise_t, top = force_move.calc_move_time(place - self.place, speed, accel)
        self.append(self.trapq, time, accel_t, cruise_t, accel_t, self.place, 0, 0, way, 0, 0, 0, top, accel)
        self.place = place
        return time + accel_t + cruise_t + accel_t

    # an axis of G1

    def get_axis_gcode_id(self):
        return self.letter

    def get_trapq(self):
        return self.trapq

    def check_move(self, move, axis):
        low, high = self.rail.get_range()
        if not low <= move.end_pos[axis] <= high:
            raise move.move_error("Shuttle out of range")
        move.limit_speed(20.0 * move.move_d / abs(move.axes_d[axis]), move.accel)

    def calc_junction(self, before, move, axis):
        change = abs(move.axes_r[axis] - before.axes_r[axis])
        return (1.0 / change) ** 2 if change else move.max_cruise_v2

    def process_move(self, print_time, move, axis):
        share = move.axes_r[axis]
        self.append(
            self.trapq, print_time, move.accel_t, move.cruise_t, move.decel_t, move.start_pos[axis], 0, 0, 1, 0, 0,
            move.start_v * share, move.cruise_v * share, move.accel * share,
        )  # fmt: skip
        self.place = move.end_pos[axis]

    # the toolhead that homing sees

    def flush_step_generation(self):
        self.printer.lookup_object("toolhead").flush_step_generation()

    def get_position(self):
        return [self.place, 0.0, 0.0, 0.0]

    def set_position(self, newpos, homing_axes=""):
        self.flush_step_generation()
        self.place = newpos[0]
        self.rail.set_position([self.place, 0.0, 0.0])

    def get_last_move_time(self):
        toolhead = self.printer.lookup_object("toolhead")
        print_time = toolhead.get_last_move_time()
        if self.time > print_time:
            toolhead.dwell(self.time - print_time)
        else:
            self.time = print_time
        return self.time

    def dwell(self, delay):
        self.time += max(0.0, delay)

    def drip_move(self, newpos, speed, completion):
        start = self.get_last_move_time()
        end = self.submit(start, newpos[0], speed, 100.0)
        self.queuing.drip_update_time(start, end, completion)
        self.queuing.wipe_trapq(self.trapq)
        self.rail.set_position([self.place, 0.0, 0.0])
        self.get_last_move_time()

    def get_kinematics(self):
        return self

    @property
    def mcu(self):
        return self.printer.lookup_object("mcu")

    def get_steppers(self):
        return self.rail.get_steppers()

    def calc_position(self, stepper_positions):
        return [stepper_positions[self.rail.get_name()], 0.0, 0.0]


def load_config_prefix(config):
    return Shuttle(config)
