"""The parts of [induction_heater]: its options, its MCU, its commands. The section is extras/induction_heater.py."""
