"""Options of Config_Reference.md and fields of Status_Reference.md in Klipper's documentation.

The newest names may be missing.

A word with + stands for a group of options. Numbered options stand with their first number. An indented line goes on.
"""

_GROUPS = """
SPI spi_speed spi_bus spi_software_sclk_pin spi_software_mosi_pin spi_software_miso_pin
I2C i2c_address i2c_mcu i2c_bus i2c_software_scl_pin i2c_software_sda_pin i2c_speed
MOTOR step_pin dir_pin enable_pin microsteps rotation_distance
PROBING x_offset y_offset z_offset speed lift_speed samples sample_retract_dist samples_result samples_tolerance
  samples_tolerance_retries
TRAVEL speed horizontal_move_z
SENSOR sensor_type sensor_pin min_temp max_temp
CONTROL control pid_Kp pid_Ki pid_Kd max_delta
FAN pin max_power shutdown_speed cycle_time hardware_pwm kick_start_time off_below tachometer_pin tachometer_ppr
  tachometer_poll_interval enable_pin
COLOURS initial_RED initial_GREEN initial_BLUE initial_WHITE
WAVE driver_MSLUT0 driver_W0 driver_X1 driver_START_SIN driver_START_SIN90
CURRENT run_current hold_current interpolate stealthchop_threshold
CHOPPER driver_TBL driver_TOFF driver_HEND driver_HSTRT driver_IHOLDDELAY driver_TPOWERDOWN
STEALTH driver_MULTISTEP_FILT driver_PWM_AUTOGRAD driver_PWM_AUTOSCALE driver_PWM_LIM driver_PWM_REG driver_PWM_FREQ
  driver_PWM_GRAD driver_PWM_OFS
HIGH_SPEED driver_FD3 driver_TPFD driver_CHM driver_VHIGHFS driver_VHIGHCHM driver_DISS2G driver_DISS2VS
  driver_FREEWHEEL
COOLSTEP driver_SEMIN driver_SEUP driver_SEMAX driver_SEDN driver_SEIMIN driver_SFILT driver_SGT
RUNOUT pause_on_runout runout_gcode insert_gcode event_delay pause_delay
"""

_OPTIONS = """
mcu serial baud canbus_uuid canbus_interface restart_method
printer kinematics max_velocity max_accel minimum_cruise_ratio square_corner_velocity max_accel_to_decel
  max_z_velocity max_z_accel minimum_z_position delta_radius print_radius min_angle print_width slow_ratio
  shoulder_radius shoulder_height
stepper_x +MOTOR full_steps_per_rotation gear_ratio step_pulse_duration endstop_pin position_min position_endstop
  position_max homing_speed homing_retract_dist homing_retract_speed second_homing_speed homing_positive_dir
stepper arm_length arm_x_length angle upper_arm_length lower_arm_length anchor_x anchor_y anchor_z
stepper_z1 +MOTOR endstop_pin
extruder +MOTOR full_steps_per_rotation gear_ratio nozzle_diameter filament_diameter max_extrude_cross_section
  instantaneous_corner_velocity max_extrude_only_distance max_extrude_only_velocity max_extrude_only_accel
  pressure_advance pressure_advance_smooth_time heater_pin max_power +SENSOR pullup_resistor inline_resistor
  smooth_time +CONTROL pwm_cycle_time min_extrude_temp
extruder1 shared_heater
heater_bed heater_pin +SENSOR control
bed_mesh +TRAVEL mesh_radius mesh_origin mesh_min mesh_max probe_count round_probe_count fade_start fade_end
  fade_target split_delta_z move_check_distance mesh_pps algorithm bicubic_tension zero_reference_position
  faulty_region_1_min faulty_region_1_max adaptive_margin scan_overshoot
bed_tilt x_adjust y_adjust z_adjust points +TRAVEL
bed_screws screw1 screw1_name screw1_fine_adjust +TRAVEL probe_height probe_speed
screws_tilt_adjust screw1 screw1_name +TRAVEL screw_thread
z_tilt z_positions points +TRAVEL retries retry_tolerance
quad_gantry_level gantry_corners points +TRAVEL max_adjust retries retry_tolerance
z_thermal_adjust temp_coeff smooth_time z_adjust_off_above max_z_adjustment +SENSOR gcode_id
delta_calibrate radius +TRAVEL
safe_z_home home_xy_position speed z_hop z_hop_speed move_to_previous
homing_override gcode axes set_position_x set_position_y set_position_z
endstop_phase endstop_accuracy trigger_phase endstop_align_zero
gcode_macro gcode variable_NAME rename_existing description
delayed_gcode gcode initial_duration
save_variables filename
idle_timeout gcode timeout
virtual_sdcard path on_error_gcode
force_move enable_force_move
pause_resume recover_velocity
firmware_retraction retract_length retract_speed unretract_extra_length unretract_speed
gcode_arcs resolution
respond default_type default_prefix
input_shaper shaper_freq_x shaper_freq_y shaper_freq_z shaper_type shaper_type_x shaper_type_y shaper_type_z
  damping_ratio_x damping_ratio_y damping_ratio_z
adxl345 cs_pin +SPI axes_map rate
lis2dw cs_pin +SPI +I2C axes_map
lis3dh cs_pin +SPI +I2C axes_map
bmi160 cs_pin +SPI +I2C axes_map
icm20948 +I2C axes_map
mpu9250 +I2C axes_map
resonance_tester probe_points accel_chip accel_chip_x accel_chip_y max_smoothing move_speed min_freq max_freq
  accel_per_hz hz_per_sec sweeping_accel sweeping_period
board_pins mcu aliases aliases_NAME
duplicate_pin_override pins
probe pin deactivate_on_each_sample +PROBING activate_gcode deactivate_gcode
bltouch sensor_pin control_pin pin_move_time stow_on_each_sample probe_with_touch_mode pin_up_reports_not_triggered
  pin_up_touch_mode_reports_triggered set_output_mode +PROBING
axis_twist_compensation +TRAVEL calibrate_start_x calibrate_end_x calibrate_y calibrate_start_y calibrate_end_y
  calibrate_x
dual_carriage axis safe_distance +MOTOR endstop_pin position_endstop position_min position_max primary_carriage
carriage axis endstop_pin position_endstop position_min position_max
extra_carriage primary_carriage endstop_pin
extruder_stepper extruder +MOTOR
manual_stepper +MOTOR velocity accel endstop_pin position_min position_max
verify_heater max_error check_gain_time hysteresis heating_gain
homing_heaters steppers heaters
thermistor temperature1 resistance1 beta
adc_temperature temperature1 voltage1 resistance1
heater_generic gcode_id heater_pin max_power +SENSOR smooth_time +CONTROL pwm_cycle_time
temperature_sensor +SENSOR gcode_id tc_type tc_use_50Hz_filter tc_averaging_count rtd_nominal_r rtd_reference_r
  rtd_num_of_wires rtd_use_50Hz_filter htu21d_hold_master htu21d_resolution htu21d_report_time lm75_report_time
  sensor_mcu sensor_temperature1 sensor_adc1 sensor_temperature2 sensor_adc2 sensor_path serial_no ds18_report_time
  sensor_list combination_method maximum_deviation
temperature_probe +SENSOR smooth_time gcode_id speed horizontal_move_z resting_z calibration_position
  calibration_bed_temp calibration_extruder_temp extruder_heating_z max_validation_temp
fan +FAN
heater_fan +FAN heater heater_temp fan_speed
controller_fan +FAN fan_speed idle_timeout idle_speed heater stepper
temperature_fan +FAN +SENSOR +CONTROL pid_deriv_time target_temp max_speed min_speed gcode_id
fan_generic +FAN
led red_pin green_pin blue_pin white_pin cycle_time hardware_pwm +COLOURS
neopixel pin chain_count color_order +COLOURS
dotstar data_pin clock_pin chain_count initial_RED initial_GREEN initial_BLUE
pca9533 +I2C +COLOURS
pca9632 +I2C color_order +COLOURS
servo pin maximum_servo_angle minimum_pulse_width maximum_pulse_width initial_angle initial_pulse_width
gcode_button pin analog_range analog_pullup_resistor press_gcode release_gcode debounce_delay
output_pin pin pwm value shutdown_value maximum_mcu_duration cycle_time hardware_pwm scale
pwm_tool pin maximum_mcu_duration value shutdown_value cycle_time hardware_pwm scale
pwm_cycle_time pin value shutdown_value cycle_time scale
static_pwm_clock pin frequency
static_digital_output pins
multi_pin pins
tmc2130 cs_pin +SPI chain_position chain_length +CURRENT sense_resistor coolstep_threshold high_velocity_threshold
  +WAVE +CHOPPER driver_PWM_AUTOSCALE driver_PWM_FREQ driver_PWM_GRAD driver_PWM_AMPL driver_FREEWHEEL driver_VHIGHFS
  driver_VHIGHCHM +COOLSTEP diag0_pin diag1_pin
tmc2208 uart_pin tx_pin select_pins +CURRENT sense_resistor +CHOPPER +STEALTH driver_FREEWHEEL
tmc2209 uart_pin tx_pin select_pins uart_address +CURRENT sense_resistor coolstep_threshold +CHOPPER +STEALTH
  driver_FREEWHEEL driver_SGTHRS driver_SEMIN driver_SEUP driver_SEMAX driver_SEDN driver_SEIMIN diag_pin
tmc2660 cs_pin +SPI interpolate run_current sense_resistor idle_current_percent driver_TBL driver_RNDTF driver_HDEC
  driver_CHM driver_HEND driver_HSTRT driver_TOFF +COOLSTEP driver_SLPH driver_SLPL driver_DISS2G driver_TS2G
tmc2240 cs_pin +SPI uart_pin uart_address chain_position chain_length +CURRENT rref coolstep_threshold
  high_velocity_threshold +WAVE driver_OFFSET_SIN90 +CHOPPER +STEALTH +HIGH_SPEED +COOLSTEP driver_IRUNDELAY
  driver_SG4_ANGLE_OFFSET driver_SG4_THRS driver_SLOPE_CONTROL diag0_pin diag1_pin
tmc5160 cs_pin +SPI chain_position chain_length +CURRENT sense_resistor coolstep_threshold high_velocity_threshold
  +WAVE +CHOPPER +STEALTH +HIGH_SPEED +COOLSTEP driver_DRVSTRENGTH driver_BBMCLKS driver_BBMTIME driver_FILT_ISENSE
  diag0_pin diag1_pin
ad5206 enable_pin +SPI channel_1 scale
mcp4451 +I2C wiper_0 scale
mcp4728 +I2C channel_a scale
mcp4018 +I2C wiper scale
display_template param_NAME text
filament_switch_sensor +RUNOUT switch_pin debounce_delay
filament_motion_sensor detection_length extruder switch_pin +RUNOUT
hall_filament_width_sensor adc1 adc2 cal_dia1 cal_dia2 raw_dia1 raw_dia2 default_nominal_filament_diameter
  max_difference measurement_delay enable enable_flow_compensation measurement_interval logging min_diameter
  max_diameter use_current_dia_while_delay +RUNOUT
tsl1401cl_filament_width_sensor pin default_nominal_filament_diameter max_difference measurement_delay
smart_effector pin control_pin probe_accel recovery_time +PROBING activate_gcode deactivate_gcode
  deactivate_on_each_sample
sx1509 +I2C
load_cell sensor_type counts_per_gram reference_tare_counts sensor_orientation sclk_pin dout_pin gain sample_rate cs_pin
  +SPI data_ready_pin pga_bypass input_mux vref adc_channel clock_freq pwm_clock enable_global_chop global_chop_delay
load_cell_probe sensor_type counts_per_gram reference_tare_counts sensor_orientation force_safety_limit trigger_force
  drift_filter_cutoff_frequency drift_filter_delay buzz_filter_cutoff_frequency buzz_filter_delay
  notch_filter_frequencies notch_filter_quality tare_time interpolate_enable interpolate_lift_dist z_offset speed
  samples sample_retract_dist lift_speed samples_result samples_tolerance samples_tolerance_retries activate_gcode
  deactivate_gcode
probe_eddy_current sensor_type frequency intb_pin max_sensor_hz descend_z +I2C x_offset y_offset speed lift_speed
  samples sample_retract_dist samples_result samples_tolerance samples_tolerance_retries tap_threshold tap_z_offset
angle sensor_type sample_period stepper cs_pin +SPI
palette2 serial baud feedrate_splice feedrate_normal auto_load_speed auto_cancel_variation
replicape revision enable_pin host_mcu standstill_power_down stepper_x_microstep_mode stepper_x_current
  stepper_x_chopper_off_time_high stepper_x_chopper_hysteresis_high stepper_x_chopper_blank_time_high
samd_sercom sercom tx_pin rx_pin clk_pin
adc_scaled vref_pin vssa_pin smooth_time
ads1x1x chip pga adc_voltage +I2C
"""

_FIELDS = """
angle temperature
bed_mesh profile_name mesh_min mesh_max probed_matrix mesh_matrix profiles
bed_screws is_active state current_screw accepted_screws
canbus_stats rx_error tx_error tx_retries bus_state
configfile settings config save_config_pending save_config_pending_items warnings
display_status progress message
endstop_phase last_home
exclude_object objects excluded_objects current_object
extruder_stepper pressure_advance smooth_time motion_queue
fan speed rpm
filament_switch_sensor enabled filament_detected
filament_motion_sensor enabled filament_detected
hall_filament_width_sensor enabled filament_detected is_active Diameter Raw
firmware_retraction retract_length retract_speed unretract_extra_length unretract_speed
gcode commands
gcode_button state
gcode_move gcode_position position homing_origin speed speed_factor extrude_factor absolute_coordinates
  absolute_extrude axis_map
extruder temperature target power can_extrude
heaters available_heaters available_sensors available_monitors
idle_timeout state printing_time
led color_data
load_cell is_calibrated counts_per_gram reference_tare_counts tare_counts force_g min_force_g max_force_g
load_cell_probe is_calibrated counts_per_gram reference_tare_counts tare_counts force_g min_force_g max_force_g name
  last_query last_z_result last_probe_position endstop_tare_counts last_trigger_time
manual_probe is_active z_position z_position_lower z_position_upper
manual_stepper position enabled
mcu mcu_version mcu_build_versions mcu_constants last_stats
motion_report live_position live_velocity live_extruder_velocity
output_pin value
palette2 ping remaining_load_length is_splicing
pause_resume is_paused
print_stats filename total_duration print_duration filament_used state message total_layer current_layer
probe name last_query last_z_result last_probe_position
pwm_cycle_time value
quad_gantry_level applied
query_endstops last_query
screws_tilt_adjust error max_deviation results
servo value
skew_correction current_profile_name
stepper_enable steppers
system_stats sysload cputime memavail
bme280 temperature humidity pressure gas
temperature_fan temperature target
temperature_sensor temperature measured_min_temp measured_max_temp
tmc2209 mcu_phase_offset phase_offset_position drv_status temperature run_current hold_current
toolhead position extruder homed_axes axis_minimum axis_maximum cone_start_z max_velocity max_accel
  minimum_cruise_ratio square_corner_velocity stalls extra_axes
dual_carriage carriage_0 carriage_1 carriages
virtual_sdcard is_active progress file_path file_position file_size
webhooks state state_message
z_thermal_adjust enabled temperature measured_min_temp measured_max_temp current_z_adjust z_adjust_ref_temperature
z_tilt applied
"""


def _rows(text: str, groups: dict[str, list[str]]) -> dict[str, list[str]]:
    """First word of each line -> the others, groups written out."""
    found = {}
    for line in text.strip().replace("\n  ", " ").splitlines():
        name, *words = line.split()
        found[name] = [part for word in words for part in groups.get(word.removeprefix("+"), [word])]
    return found


OPTIONS = _rows(_OPTIONS, _rows(_GROUPS, {}))
FIELDS = _rows(_FIELDS, {})
