"""Temperature to power, power to bridge phases: the control laws, the actuator, and the loop of one nozzle.

`control_api` is what all laws share: `pid` (PID and watermark), `two_period`, `predictive`. `loop` strings sensing and
control together for one induction nozzle.
"""
