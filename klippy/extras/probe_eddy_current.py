"""[probe_eddy_current NAME]: a coil above a metal bed as the probe (LDC1612)."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

from .eddy.calibrate import EddyCalibration
from .eddy.chip import Ldc1612
from .eddy.probe import Coil, EddyProbe
from .probing.stream import Sample


class EddyCurrentProbe:
    """Printer object 'probe_eddy_current NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.chip = Ldc1612(config)
        self.coil = Coil(config, self.chip)
        self.probe = EddyProbe(config, self.coil)
        self.printer.add_object("probe", self.probe)

    def register(self) -> None:
        self.chip.register()
        EddyCalibration(self.probe)
        header = ("time", "frequency", "z")
        self.chip.stream.register_dump("ldc1612/dump_ldc1612", self.chip.name, header, self._row)

    def _row(self, sample: Sample) -> tuple[float, float, float]:
        height = 999.9 if self.coil.curve is None else self.coil.height_mm(sample[1])
        return *self.chip.row(sample), round(height, 6)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self.probe.get_status(eventtime)


def load_config_prefix(config: ConfigWrapper) -> EddyCurrentProbe:
    probe = EddyCurrentProbe(config)
    probe.register()
    return probe
