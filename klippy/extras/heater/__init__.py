"""What all heaters share: control laws from options, ordinary and switched heaters, runs of calibrations.

No section: the sections are heaters.py, extruder.py, heater_bed.py and heater_generic.py.
"""
