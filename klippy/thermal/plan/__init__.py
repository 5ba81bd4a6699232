"""The nozzle temperature along the path: what is requested, deposited, how it welds, what the nozzle follows.

`planner` is the C planner for Python; `deposit`, `weld`, `set_points`, `layer_time` explain its parts.
"""
