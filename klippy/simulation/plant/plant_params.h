// The induction nozzle's parameters, each given once: X(name, unit, reference, strong, real, min, max, doc).
//
// This one table becomes `struct plant_values` (a field each), `enum plant_param_id` (PLANT_<name>) and the
// readable `plant_params[]`. Origins stand in brackets: [T1] [T5] Tables 1 and 5 of Oskolkov, Bezukladnikov and
// Trushnikov 2021, fitted; [text] the same paper's prose; [assumed] no source, an engineering assumption.
//
// Presets: `reference` is the fit (81 W into the metal, about 180 degC/s at full phase); `strong` a well-coupled
// coil (282 W into the metal), for judging speed and safety; `real` is `reference` with what a real machine adds,
// all of it absent from the other two. [bridge] [coil]: tables of test/data/bridge_circuit.csv (plant_bridge.c).
#ifndef FERRITE_SIM_PLANT_PARAMS_H
#define FERRITE_SIM_PLANT_PARAMS_H

// clang-format off
#define PLANT_PARAM_TABLE(X)                                                                                                   \
  /* --- nozzle, melt and fan: heat --------------------------------------------------------------------------------------- */ \
  X(ambient_c,            "degC",   20.0,     20.0,     20.0,     -40,  100,  "air around the nozzle [text]")                  \
  X(start_c,              "degC",   20.0,     20.0,     20.0,     -40,  900,  "temperature of everything at the start")        \
  X(mass_g,               "g",      0.9,      0.9,      0.9,      0.05, 20,   "steel heated by the coil [T5]")                 \
  X(mass_factor,          "",       1.0,      1.0,      1.0,      0.2,  5,    "scales mass_g: variations of one nozzle")       \
  X(cp_j_kgk,             "J/(kg K)", 460.0,    460.0,    460.0,    100,  2000, "specific heat of AISI 430 at 25 degC")        \
  X(cp_slope_per_k,       "1/K",    4.5e-4,   4.5e-4,   4.5e-4,   0,    5e-3, "relative rise of the specific heat with temperature") \
  X(loss_w_k,             "W/K",    7.16e-3,  7.16e-3,  7.16e-3,  0,    1,    "nozzle to air [T5]")                            \
  X(radiation_area_m2,    "m^2",    1.0e-4,   1.0e-4,   1.0e-4,   0,    1e-2, "emissivity times radiating area [T5]")          \
  X(link_w_k,             "W/K",    41.1e-3,  41.1e-3,  41.1e-3,  0,    2,    "nozzle to the second mass (thread, heat break) [T5]") \
  X(second_j_k,           "J/K",    0.572,    0.572,    0.572,    0.01, 100,  "heat capacity of the second mass [T5]")         \
  X(second_loss_w_k,      "W/K",    16.0e-3,  16.0e-3,  16.0e-3,  0,    2,    "second mass to air [T5]")                       \
  X(loss_factor,          "",       1.0,      1.0,      1.0,      0.2,  5,    "scales all four paths of heat loss")            \
  X(bore_tau_s,           "s",      0.049,    0.049,    0.0163,   1e-4, 1,    "bore behind skin, w^2/(2 alpha) of a 0.8 mm wall") \
  X(melt_ua_w_k,          "W/K",    27.6e-3,  27.6e-3,  27.6e-3,  0,    1,    "bore to melt [text: 440 degC at 40 mm/s]")      \
  X(melt_heat_mj_m3k,     "MJ/(m^3 K)", 2.1,      2.1,      2.1,      0.1,  10,   "volumetric heat capacity of the filament")  \
  X(melt_in_c,            "degC",   25.0,     25.0,     25.0,     -40,  300,  "filament temperature where it enters")          \
  X(flow_tau_s,           "s",      0.020,    0.020,    0.020,    0,    1,    "flow at the nozzle behind the motor (compliance) [assumed]") \
  X(flow_share,           "",       1.0,      1.0,      1.0,      0,    1,    "share of the fed filament that passes: grinding, runout") \
  X(hole_mm,              "mm",     0.4,      0.4,      0.4,      0,    2,    "effective diameter of the hole; 0: closed")     \
  X(drive_force_n,        "N",      0.0,      0.0,      0.0,      0,    1e3,  "force at which the extruder's drive slips; 0: never") \
  X(melt_force_n,         "N",      8.0,      8.0,      8.0,      0,    1e3,  "force against the filament at 0.4 mm, 5 mm^3/s, 210 degC [assumed]") \
  X(force_flow_exponent,  "",       0.4,      0.4,      0.4,      0.1,  2,    "that force over the flow [assumed]")            \
  X(force_hole_exponent,  "",       2.2,      2.2,      2.2,      0.5,  8,    "that force over 1/hole_mm [assumed]")           \
  X(force_arrhenius_k,    "K",      5000,     5000,     5000,     0,    3e4,  "that force over the bore's temperature [assumed]") \
  X(fan_w_k,              "W/K",    5e-3,     5e-3,     12e-3,    0,    1,    "added nozzle loss with the part fan at full speed [assumed]") \
  X(wall_k_w,             "K/W",    0.0,      0.0,      0.072,    0,    1,    "skin above the wall's mean, q w/3k: 6 K at 81 W [0.8 mm, k = 25 W/mK]") \
  X(wall_s,               "s",      0.098,    0.098,    0.098,    1e-3, 10,   "diffusion time of the wall, w^2/alpha [0.8 mm]") \
  X(tip_k_w,              "K/W",    0.0,      0.0,      3.1,      0,    50,   "coil zone to tip, by the heat into the melt: 11 K at 3.5 W over 2 mm") \
  X(tip_tau_s,            "s",      0.3,      0.3,      0.3,      1e-3, 10,   "lag of the tip [assumed]")                      \
  /* --- drive ------------------------------------------------------------------------------------------------------------ */ \
  X(heat_w,               "W",      81.3,     282.0,    81.3,     0,    2000, "into the metal at full phase and supply_nominal_v [text]") \
  X(efficiency_factor,    "",       1.0,      1.0,      1.0,      0,    5,    "scales heat_w: variations of the coupling")     \
  X(heat_exponent,        "",       1.5,      1.5,      1.5,      0.5,  3,    "heat goes with (sin(phi/2) Vdc)^this")          \
  X(electrical_base_w,    "W",      22.66,    30.0,     22.66,    0,    200,  "electrical power at small phase [text, 4 claims]") \
  X(electrical_swing_w,   "W",      306.25,   306.25,   306.25,   0,    3000, "added by sin^2(phi/2) [text, 4 claims]")        \
  X(supply_v,             "V",      24.0,     24.0,     24.3,     0,    100,  "bridge supply without load")                    \
  X(supply_nominal_v,     "V",      24.0,     24.0,     24.0,     1,    100,  "supply the drive figures were taken at")        \
  X(supply_ohm,           "ohm",    0.0,      0.0,      0.03,     0,    1,    "supply and cable resistance: sag under load")   \
  X(ripple_v,             "V",      0.0,      0.0,      0.12,     0,    20,   "amplitude of the supply's sine ripple")         \
  X(ripple_hz,            "Hz",     100.0,    100.0,    100.0,    0.1,  5e4,  "frequency of that ripple")                      \
  X(bus_uf,               "uF",     0.0,      0.0,      2200,     0,    1e5,  "bus capacitor behind supply_ohm and enable_pin; 0: the bus follows at once [assumed]") \
  X(vdc_gain,             "",       1.0,      1.0,      1.004,    0.5,  2,    "what the divider of vdc_pin reads of the bus voltage: 1 % resistors [assumed]") \
  X(vdc_noise_lsb,        "LSB",    0.0,      0.0,      1.0,      0,    100,  "noise at vdc_pin, rms [assumed]")               \
  X(switch_ohm,           "ohm",    0.0,      0.0,      0.02,     0,    1,    "two switches of the bridge in series with the tank: 10 mohm each [assumed]") \
  X(dead_time_ns,         "ns",     0.0,      0.0,      60.0,     0,    300,  "dead time of the legs: table of the circuit simulation [bridge]") \
  X(curie_c,              "degC",   665.0,    665.0,    665.0,    100,  1200, "Curie point of AISI 430")                       \
  X(curie_width_k,        "K",      15.0,     15.0,     15.0,     1,    200,  "width of the transition at the Curie point [assumed]") \
  X(curie_drop,           "",       0.0,      0.0,      0.0,      0,    1,    "share of the heating lost above it (0: as fitted)") \
  /* --- LCL tank and signal ---------------------------------------------------------------------------------------------- */ \
  X(signal_model,         "",       0.0,      0.0,      0.0,      0,    1,    "0 phasor of the LCL tank, 1 direct law of Table 1") \
  X(l1_uh,                "uH",     3.60,     3.60,     3.60,     0.1,  100,  "coil with nozzle at l1_reference_c, small current [T1]") \
  X(l1_slope_per_k,       "1/K",    1e-4,     1e-4,     1e-4,     0,    1e-2, "relative fall of L1 with temperature [T1]")     \
  X(l1_reference_c,       "degC",   390.0,    390.0,    390.0,    0,    800,  "temperature of resonance [T1]")                 \
  X(l1_saturation_a,      "A",      39.7,     39.7,     39.7,     1,    1000, "coil current that saturates the steel's skin [T1]") \
  X(l2_uh,                "uH",     7.138,    7.138,    7.138,    0.1,  100,  "series inductor of the tank [T1]")              \
  X(c1_uf,                "uF",     0.7351,   0.7351,   0.7351,   0.01, 10,   "tank capacitor [T1]")                           \
  X(c1_factor,            "",       1.0,      1.0,      1.0,      0.5,  2,    "scales c1_uf: drift (+0.1 % reads about -15 degC)") \
  X(r_ohm,                "ohm",    0.3878,   0.3878,   0.3878,   0.01, 10,   "series resistance of the tank [T1]")            \
  X(frequency_ppm,        "1e-6",   0.0,      0.0,      20.0,     -1e5, 1e5,  "bridge frequency off what the period says")     \
  X(tank_tau_us,          "us",     27.0,     27.0,     27.0,     0.1,  1000, "settling of the tank after a phase step")       \
  X(skew_ns,              "ns",     0.0,      0.0,      0.0,      -500, 500,  "sampling instant late against the bridge (1 ns: 1.1 degC)") \
  X(gain_units_deg,       "1/deg",  20.136,   20.136,   20.136,   -1e3, 1e3,  "signal units per degree of current phase [T1]")  \
  X(offset_units,         "",       313.9,    313.9,    313.9,    -1e4, 1e4,  "error at current phase 0 and power 0 [T1]")     \
  X(offset_decay,         "",       1.003,    1.003,    1.003,    0,    5,    "fall of that offset with power p: exp(-decay p) [T1]") \
  X(limiter_a,            "A",      0.02,     0.02,     0.02,     1e-6, 10,   "coil current below which the limiter's output falls [assumed]") \
  X(law_slope,            "1/degC", 0.801361, 0.801361, 0.801361, -10,  10,   "direct law: a in a T exp(-b p) + c + d p [T1]") \
  X(law_decay,            "",       1.058014, 1.058014, 1.058014, 0,    5,    "direct law: b")                                 \
  X(law_zero,             "",       1.397019, 1.397019, 1.397019, -1e3, 1e3,  "direct law: c")                                 \
  X(law_power,            "",       5.139702, 5.139702, 5.139702, -1e3, 1e3,  "direct law: d")                                 \
  X(empty_l1_uh,          "uH",     3.0,      3.0,      3.0,      0.1,  100,  "coil without a nozzle [assumed]")               \
  X(empty_r_ohm,          "ohm",    0.15,     0.15,     0.15,     0.01, 10,   "tank resistance without a nozzle [assumed]")    \
  X(r_rise_per_k,         "1/K",    0.0,      0.0,      3e-4,     0,    1e-3, "rise of the tank's resistance with the steel's, from about 250 degC; less where saturated [coil]") \
  X(saturation_table,     "",       0.0,      0.0,      1.0,      0,    1,    "1: effect of temperature on L1 over current by table, 0: by the fit [coil]") \
  X(l1_curve,             "",       0.0,      0.0,      0.01,     -0.1, 0.1,  "L1 off the straight line: -l1_curve (u^4 - 0.35 u^2), u = (T - 25)/640 [assumed]") \
  X(signal_error,         "",       0.0,      0.0,      0.3,      0,    100,  "error of this machine's signal, smooth over the drive, rms [assumed]") \
  X(machine_number,       "",       1.0,      1.0,      1.0,      0,    1e6,  "chooses the shape of that error")               \
  /* --- temperatures of the parts about the coil ------------------------------------------------------------------------- */ \
  X(board_c,              "degC",   25.0,     25.0,     35.0,     -40,  120,  "air at capacitor, choke, limiter and drivers; their values hold at 25 degC") \
  X(delay_ns_k,           "ns/K",   0.0,      0.0,      0.02,     -1,   1,    "delay of limiter and drivers with board_c [assumed]") \
  X(c1_ppm_k,             "1e-6/K", 0.0,      0.0,      -30.0,    -1e3, 1e3,  "C1 with its temperature: C0G +-30, film -250 [datasheets]") \
  X(cap_j_k,              "J/K",    0.0,      0.0,      3.0,      0,    1e3,  "heat capacity of C1; 0: it stays at board_c [assumed]") \
  X(cap_w_k,              "W/K",    0.06,     0.06,     0.06,     1e-3, 10,   "C1 to the air: 30 K at full drive [assumed]")   \
  X(cap_ohm,              "ohm",    1e-3,     1e-3,     1e-3,     0,    1,    "series resistance of C1 [assumed]")             \
  X(l2_ppm_k,             "1e-6/K", 0.0,      0.0,      100.0,    -1e3, 1e3,  "L2 with its temperature [assumed]")             \
  X(choke_j_k,            "J/K",    0.0,      0.0,      30.0,     0,    1e4,  "heat capacity of L2; 0: it stays at board_c [assumed]") \
  X(choke_w_k,            "W/K",    0.1,      0.1,      0.1,      1e-3, 10,   "L2 to the air: 30 K at full drive [assumed]")   \
  X(choke_ohm,            "ohm",    0.015,    0.015,    0.015,    0,    1,    "loss resistance of L2 [assumed]")               \
  X(coil_j_k,             "J/K",    0.0,      0.0,      4.0,      0,    1e3,  "heat capacity of the coil's copper; 0: no effect of its temperature [1 to 2 m of 2 mm wire]") \
  X(coil_w_k,             "W/K",    0.2,      0.2,      0.2,      1e-3, 10,   "coil to the air [assumed]")                     \
  X(coil_ohm,             "ohm",    0.15,     0.15,     0.15,     0,    1,    "copper's share of r_ohm, at 25 degC [assumed]") \
  X(coil_rise_per_k,      "1/K",    3.9e-3,   3.9e-3,   3.9e-3,   0,    0.1,  "relative rise of coil_ohm: copper")             \
  X(coil_expansion_per_k, "1/K",    17e-6,    17e-6,    17e-6,    0,    1e-3, "relative rise of L1 with the coil's temperature: copper") \
  X(coil_share,           "",       0.5,      0.5,      0.5,      0,    1,    "share of the nozzle's loss to the air that warms the coil [assumed]") \
  /* --- what moves ------------------------------------------------------------------------------------------------------- */ \
  X(cable_l1_nh,          "nH",     0.0,      0.0,      0.2,      -100, 100,  "cable between C1 and coil, head at the end of its travel; - at the other [assumed]") \
  X(cable_l2_nh,          "nH",     0.0,      0.0,      2.0,      -100, 100,  "cable beside L2, likewise [assumed]")           \
  X(move_ppm_um,          "1e-6/um", 20.0,     20.0,     20.0,     -1e3, 1e3,  "L1 with the nozzle's place in the coil: 10 um are 2 degC") \
  X(move_um,              "um",     0.0,      0.0,      1.0,      0,    1e3,  "nozzle swings in its coil: amplitude of a sine [assumed]") \
  X(move_hz,              "Hz",     23.0,     23.0,     23.0,     0.01, 5e3,  "its frequency [assumed: frame, 10 to 40 Hz]")   \
  X(move_step_um,         "um",     0.0,      0.0,      0.3,      0,    1e3,  "the same with the full steps of the motors: amplitude [assumed]") \
  X(move_step_mm,         "mm",     0.2,      0.2,      0.2,      1e-3, 10,   "way of a full step [assumed]")                  \
  X(move_random_um,       "um",     0.0,      0.0,      0.3,      0,    1e3,  "the same at random, rms [assumed]")             \
  X(move_random_hz,       "Hz",     40.0,     40.0,     40.0,     0.01, 5e3,  "its bandwidth [assumed]")                       \
  /* --- ADC -------------------------------------------------------------------------------------------------------------- */ \
  X(adc_zero,             "LSB",    256.0,    256.0,    256.0,    0,    4095, "code at error 0 [assumed]")                     \
  X(units_per_lsb,        "",       1.0,      1.0,      1.0,      0.01, 100,  "signal units an LSB is worth (6.4: 8 degC native, the paper's claim)") \
  X(noise_lsb,            "LSB",    1.0,      1.0,      1.0,      0,    1000, "Gaussian noise at the ADC, rms [assumed]")      \
  X(coloured_lsb,         "LSB",    0.0,      0.0,      0.2,      0,    1e3,  "coloured noise at the ADC, rms [assumed]")      \
  X(coloured_hz,          "Hz",     20.0,     20.0,     20.0,     1e-3, 2e3,  "its bandwidth [assumed]")                       \
  X(emi_lsb,              "LSB",    0.0,      0.0,      0.5,      0,    1e3,  "chopper drivers beating with the bridge: amplitude of a sine [assumed]") \
  X(emi_hz,               "Hz",     37.0,     37.0,     37.0,     1e-3, 3e3,  "the beat, 5 to 500 Hz [assumed]")               \
  X(emi_broad_lsb,        "LSB",    0.0,      0.0,      0.2,      0,    1e3,  "the same spread over emi_broad_hz about emi_hz, rms [assumed]") \
  X(emi_broad_hz,         "Hz",     100.0,    100.0,    100.0,    1e-3, 2e3,  "that spread [assumed]")                         \
  X(adc_max,              "LSB",    4095.0,   4095.0,   4095.0,   1,    65535, "highest code [text: 12 bit]")                  \
  /* --- faults: may be set while running --------------------------------------------------------------------------------- */ \
  X(fault,                "",       0.0,      0.0,      0.0,      0,    5,    "0 none, 1 no nozzle, 2 heating coil broken, 3 bridge stuck on, " \
                                                                     "4 signal stuck, 5 signal lost")                 \
  X(fault_set,            "",       0.0,      0.0,      0.0,      0,    1023, "more of them at a time: the sum of 2^number; " \
                                                                     "6 a leg of the bridge dead, 7 supply shorted by a leg, 8 sensing lead shorted, 9 signal held, with noise") \
  X(fault_phase_ticks,    "ticks",  22500.0,  22500.0,  22500.0,  0,    45000, "fault 3: the phase the bridge stays at")       \
  X(fault_code,           "LSB",    -1.0,     -1.0,     -1.0,     -1,   65535, "fault 4: the code; -1 keeps the last one") \
  X(fault_noise_lsb,      "LSB",    1.0,      1.0,      1.0,      0,    1000, "fault 9: noise of the held signal, rms")        \
  X(coil_short,           "",       0.0,      0.0,      0.0,      0,    0.9,  "share of the coil's turns that are shorted")    \
  X(sense_gain,           "",       1.0,      1.0,      1.0,      0,    10,   "gain of the signal amplifier about error 0")    \
  X(sense_offset_lsb,     "LSB",    0.0,      0.0,      0.0,      -4095, 4095, "added to the signal")                          \
  X(adc_set_bits,         "",       0.0,      0.0,      0.0,      0,    4095, "bits of the code that are always 1")            \
  X(adc_clear_bits,       "",       0.0,      0.0,      0.0,      0,    4095, "bits of the code that are always 0")            \
  X(reading_factor,       "",       1.0,      1.0,      1.0,      0.1,  10,   "the tank answers as at 25 degC plus this times what the skin is above it: a wrong calibration")
// clang-format on

#endif
