"""Magnetic angle sensors: the chips' registers (chips.py), what a turn of the motor says of their error (table.py)."""
