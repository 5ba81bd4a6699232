"""[metrics]: the printer's figures for Prometheus, OpenMetrics text over HTTP on a local port.

Once a second the figures are copied on the reactor's thread; requests are served from the copy by a thread of their own
and cost the print nothing. Names and units follow https://prometheus.io/docs/practices/naming/.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from configfile import ConfigWrapper
from roles import Printer

PERIOD_S = 1.0
DEFAULT_PORT = 9101
LOCAL = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Figure:
    """One metric: its name and help, the label of its series, and whether it only rises."""

    name: str
    text: str
    label: str = ""
    rises: bool = False


@dataclass(slots=True)
class Series:
    """Values of one figure by label; "" without."""

    figure: Figure
    values: dict[str, float] = field(default_factory=dict)

    def add(self, label: str, value: Any) -> None:
        """Keep a number; what is not known is left out."""
        if value is not None and math.isfinite(value):
            self.values[label] = float(value)

    def metric(self) -> Metric:
        figure = self.figure
        family = CounterMetricFamily if figure.rises else GaugeMetricFamily
        metric = family(f"ferrite_{figure.name}", figure.text, labels=[figure.label] if figure.label else [])
        for label, value in self.values.items():
            metric.add_metric([label] if figure.label else [], value)
        return metric


HEATER = (
    (Figure("heater_temperature_celsius", "Displayed temperature", "heater"), "temperature"),
    (Figure("heater_target_celsius", "Target, 0 is off", "heater"), "target"),
    (Figure("heater_power_ratio", "Share of the greatest power", "heater"), "power"),
)
SENSOR = (Figure("sensor_temperature_celsius", "Temperature of a sensor", "sensor"), "temperature")
NOZZLE: tuple[tuple[Figure, Callable[[dict[str, Any]], Any]], ...] = (
    (Figure("nozzle_power_watts", "Heat into the nozzle", "nozzle"), lambda s: s["power_w"]),
    (Figure("nozzle_sigma_celsius", "Standard deviation of the estimate", "nozzle"), lambda s: s["sigma"]),
    (Figure("nozzle_drift_celsius", "Drift of the thermometer", "nozzle"), lambda s: s["drift"]),
    (Figure("nozzle_valid", "1 while the estimate is valid", "nozzle"), lambda s: s["valid"]),
    (Figure("nozzle_warning", "1 while a warning stands", "nozzle"), lambda s: bool(s["warning"])),
    (Figure("nozzle_fault", "1 after a fault", "nozzle"), lambda s: bool(s["fault"])),
    (
        Figure("nozzle_blocks_lost", "Blocks of samples that never arrived", "nozzle", rises=True),
        lambda s: s["blocks_lost"],
    ),
)
MCU = (
    (Figure("mcu_retransmitted_bytes", "Bytes sent again", "mcu", rises=True), "bytes_retransmit"),
    (Figure("mcu_invalid_bytes", "Bytes received that made no message", "mcu", rises=True), "bytes_invalid"),
    (Figure("mcu_task_seconds", "Mean time of a round of the board's tasks", "mcu"), "mcu_task_avg"),
)
FAN = (Figure("fan_speed_ratio", "Speed of a fan", "fan"), "speed")
LOOKAHEAD = Figure("lookahead_seconds", "Motion that is planned ahead of the board's clock")
STALLS = Figure("motion_stalls", "How often the queue of moves ran empty", rises=True)
PRINTING = Figure("print_state", "1 for the state of the print", "state")
SHUT_DOWN = Figure("shut_down", "1 after the printer shut down")
STATES = ("standby", "printing", "paused", "complete", "cancelled", "error")


class Snapshot(Collector):
    """The newest copy of the figures; exchanged whole, read by the serving threads."""

    def __init__(self) -> None:
        self.series: tuple[Series, ...] = ()

    def collect(self) -> Iterator[Metric]:
        yield from (one.metric() for one in self.series)


class Metrics:
    """Copies the figures once a second and serves them."""

    def __init__(self, printer: Printer, address: str, port: int, where: str) -> None:
        self.printer = printer
        self.address, self.port = address, port
        self.snapshot = Snapshot()
        self._where = where
        self._reactor = printer.get_reactor()
        self._server: Any = None
        self._timer: Any = None

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._open)
        self.printer.register_event_handler("klippy:ready", self._start)
        self.printer.register_event_handler("klippy:disconnect", self.close)

    def _open(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is not None:
            return
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self.snapshot)
        try:
            self._server, _ = start_http_server(self.port, self.address, registry)
        except OSError as e:
            raise self.printer.config_error(
                f"Section [metrics] ({self._where}): port {self.port} of {self.address} cannot be opened:"
                f" {e.strerror or e}. Choose another port."
            ) from None
        self.port = self._server.server_address[1]
        logging.info("Metrics are served on http://%s:%d/metrics", self.address, self.port)

    def _start(self) -> None:
        if self._server is not None:
            self._timer = self._reactor.register_timer(self._copy, self._reactor.NOW)

    def close(self) -> None:
        """No more is served."""
        if self._timer is not None:
            self._reactor.unregister_timer(self._timer)
            self._timer = None
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def _copy(self, eventtime: float) -> float:
        self.snapshot.series = tuple(self._read(eventtime))
        return eventtime + PERIOD_S

    def _read(self, eventtime: float) -> Iterable[Series]:
        heaters = self.printer.lookup_object("heaters", None)
        names = heaters.get_all_heaters() if heaters is not None else []
        for figure, key in HEATER:
            yield self._of(figure, key, names, eventtime)
        sensors = [name for name in heaters.available_sensors if name not in names] if heaters else []
        yield self._of(*SENSOR, sensors, eventtime)
        nozzles = [(n.split()[-1], o.get_status(eventtime)) for n, o in self._all("induction_heater")]
        for figure, value in NOZZLE:
            series = Series(figure)
            for name, status in nozzles:
                series.add(name, value(status))
            yield series
        boards = [(n, o.get_status(eventtime).get("last_stats", {})) for n, o in self._all("mcu")]
        for figure, key in MCU:
            series = Series(figure)
            for name, status in boards:
                series.add(name.removeprefix("mcu "), status.get(key))
            yield series
        fans = [name for kind in ("fan", "fan_generic", "heater_fan", "controller_fan", "temperature_fan")
                for name, _ in self._all(kind)]  # fmt: skip
        yield self._of(*FAN, fans, eventtime)
        yield from self._print(eventtime)

    def _all(self, module: str) -> list[tuple[str, Any]]:
        return self.printer.lookup_objects(module)

    def _of(self, figure: Figure, key: str, names: Iterable[str], eventtime: float) -> Series:
        series = Series(figure)
        for name in names:
            found = self.printer.lookup_object(name, None)
            if found is not None and hasattr(found, "get_status"):
                series.add(name, found.get_status(eventtime).get(key))
        return series

    def _print(self, eventtime: float) -> Iterable[Series]:
        status = self.printer.lookup_object("toolhead").get_status(eventtime)
        ahead, stalls = Series(LOOKAHEAD), Series(STALLS)
        ahead.add("", max(0.0, status["print_time"] - status["estimated_print_time"]))
        stalls.add("", status["stalls"])
        down = Series(SHUT_DOWN)
        down.add("", self.printer.is_shutdown())
        yield from (ahead, stalls, down)
        stats = self.printer.lookup_object("print_stats", None)
        if stats is not None:
            now, states = stats.get_status(eventtime)["state"], Series(PRINTING)
            for state in STATES:
                states.add(state, state == now)
            yield states


def load_config(config: ConfigWrapper) -> Metrics:
    address = config.get("address", LOCAL)
    port = config.getint("port", DEFAULT_PORT, minval=0, maxval=65535)
    metrics = Metrics(config.get_printer(), address, port, config.where())
    metrics.register()
    return metrics
