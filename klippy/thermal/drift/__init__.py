"""Drift of the thermometer: what the witnesses say of it, and how the sensing law follows."""
