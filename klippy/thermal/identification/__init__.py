"""Runs that identify a heater or its sensor, and the fits of their recordings.

The runs (`sweep`, `step_test`, `relay`, each a `run.Run`) decide and record. The fits (`fit_*`) are offline code: numpy
and scipy.
"""
