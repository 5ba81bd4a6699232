"""What the sections of the TMC stepper drivers (tmc2130.py ...) share: registers, buses, currents, commands."""

from .driver import StepperDriver as TMCCommandHelper
from .surface import TMCtstepHelper

__all__ = ("TMCCommandHelper", "TMCtstepHelper")
