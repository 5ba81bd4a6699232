"""One file per kinematics; `[printer] kinematics: NAME` loads kinematics/NAME.py."""
