"""[probe_eddy_current NAME]: the frequency of a coil above a metal bed.

chip (chip.py) ─► frequency ─► corrected for the coil's temperature (drift.py) ─► height (curve.py) ─► probe.py, tap.py
"""
