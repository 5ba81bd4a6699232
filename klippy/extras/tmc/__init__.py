"""What the sections of the TMC stepper drivers (tmc2130.py ...) share: registers, buses, currents, commands."""

from .surface import TMCtstepHelper

__all__ = ("TMCtstepHelper",)
