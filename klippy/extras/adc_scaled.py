"""[adc_scaled NAME]: analog pins NAME:PIN of a board that measures its own reference and ground.

    value = (reading - vssa) / (vref - vssa)

Both are smoothed over smooth_time. The board checks the limits of the reading, the host those of the value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper

from .adcs.host_pin import HostAdcPin
from .query_adc import register_adc

REPORT_TIME_S, SAMPLE_TIME_S, SAMPLE_COUNT = 0.300, 0.001, 8
SPAN_MIN = 0.1  # of full scale, between vssa and vref: less is a broken line


class Level:
    """One of the two monitored lines, smoothed."""

    def __init__(self, config: ConfigWrapper, option: str, smooth_time_s: float) -> None:
        description = config.get(option)
        pins = config.get_printer().lookup_object("pins")
        self.chip_name = pins.parse_pin(description)["chip_name"]
        self.adc = pins.setup_pin("adc", description)
        self.adc.setup_adc_sample(SAMPLE_TIME_S, SAMPLE_COUNT)
        self.adc.setup_adc_callback(REPORT_TIME_S, self._on_adc)
        register_adc(config, f"{config.get_name()}:{option.removesuffix('_pin')}", self.adc)
        self.value: float | None = None
        self._weight = REPORT_TIME_S / max(smooth_time_s, REPORT_TIME_S)

    def _on_adc(self, read_time: float, value: float) -> None:
        last = value if self.value is None else self.value
        self.value = last + (value - last) * self._weight


class ScaledPin(HostAdcPin):
    """A pin of the board, scaled."""

    def __init__(self, chip: ScaledChip, pin: str) -> None:
        super().__init__(chip.printer, f"{chip.name}:{pin}", chip.vref.adc.get_mcu())
        self._chip = chip
        self._adc = chip.printer.lookup_object("pins").setup_pin("adc", f"{chip.vref.chip_name}:{pin}")

    def get_full_scale(self) -> float:
        return float(self._adc.get_full_scale())

    def setup_adc_sample(
        self, sample_time: float, sample_count: int, minval: float = 0.0, maxval: float = 1.0,
        range_check_count: int = 0,
    ) -> None:  # fmt: skip
        for check in (super().setup_adc_sample, self._adc.setup_adc_sample):
            check(
                sample_time, sample_count, minval=minval, maxval=maxval, range_check_count=range_check_count
            )

    def setup_adc_callback(self, report_time: float, callback: Callable[[float, float], None]) -> None:
        super().setup_adc_callback(report_time, callback)
        self._adc.setup_adc_callback(report_time, self._on_adc)

    def _on_adc(self, read_time: float, value: float) -> None:
        vref, vssa = self._chip.vref.value, self._chip.vssa.value
        if vref is None or vssa is None:
            return  # the first readings of the other two lines are still to come
        if vref - vssa < SPAN_MIN:
            self.printer.invoke_shutdown(
                f"Section 'adc_scaled {self._chip.name}': vref_pin reads {vref:.3f} and vssa_pin {vssa:.3f}."
                " Expected are about 1 and 0: check both options."
            )
            return
        self.take(read_time, min(1.0, max(0.0, (value - vssa) / (vref - vssa))))


class ScaledChip:
    """The chip NAME."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split()[-1]
        smooth_time_s = config.getfloat("smooth_time", 2.0, above=0.0)
        self.vref = Level(config, "vref_pin", smooth_time_s)
        self.vssa = Level(config, "vssa_pin", smooth_time_s)
        if self.vref.chip_name != self.vssa.chip_name:
            raise config.error(
                f"Section '{config.get_name()}': vref_pin and vssa_pin must be on the same board."
            )
        self._pins = self.printer.lookup_object("pins")
        self._pins.register_chip(self.name, self)

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> ScaledPin:
        """Called by pins for NAME:PIN."""
        if pin_type != "adc":
            raise self._pins.error(f"{self.name}:{pin_params['pin']} is an analog input only.")
        return ScaledPin(self, pin_params["pin"])


def load_config_prefix(config: ConfigWrapper) -> ScaledChip:
    return ScaledChip(config)
