"""Raw coil telemetry of an [induction_heater]: INDUCTION_DUMP to a file, induction/dump_samples to a client."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, TextIO

from gcode import GCodeCommand
from roles import Printer
from thermal.records import SampleBlock, TempEstimate

from ..heater import tuning as heater_tuning
from ..outputs import output_file

BATCH_S = 0.100  # rows go to clients together
ROWS_HELD_MAX = 4000
HEADER = ("time", "phase", "count", "raw_mean", "raw_min", "raw_max", "temperature", "latency")


class InductionDump:
    """Listens to the loop only while somebody wants rows."""

    def __init__(self, printer: Printer, heater: Any, folder: str) -> None:
        self.printer = printer
        self.heater = heater
        self._folder = Path(folder).expanduser()
        self._clients: dict[Any, dict[str, Any]] = {}  # with the template of each
        self._rows: list[tuple[Any, ...]] = []
        self._file: TextIO | None = None
        self._writer: Any = None
        self._from_s, self._until_s = 0.0, 0.0
        self._timer: Any = None

    def register(self) -> None:
        name = self.heater.section_name
        command = ("INDUCTION_DUMP", self.cmd_dump, "Write raw blocks to a CSV file")
        heater_tuning.register_commands(self.printer, self.heater, [command])
        hooks = self.printer.lookup_object("webhooks", None)
        if hooks is not None:
            hooks.register_mux_endpoint("induction/dump_samples", "heater", name, self._on_request)
        self.printer.register_event_handler("klippy:disconnect", self._close)

    # Rows

    def _on_block(self, block: SampleBlock, found: TempEstimate | None, now_s: float) -> None:
        temp_c = round(found.temp_c, 3) if found is not None else None
        centre_s = block.centre_s
        row = (
            round(centre_s, 6),
            block.phase_ticks,
            block.count,
            round(block.mean_raw, 4),
            block.min_raw,
            block.max_raw,
            temp_c,
            round(now_s - centre_s, 5),
        )
        if self._clients and len(self._rows) < ROWS_HELD_MAX:
            self._rows.append(row)
        if self._file is not None and block.time_s >= self._from_s:  # not the batch that was under way
            self._write(row, centre_s)

    def _listen(self) -> None:
        listeners = self.heater.loop.listeners
        wanted = bool(self._clients) or self._file is not None
        if wanted and self._on_block not in listeners:
            listeners.append(self._on_block)
        elif not wanted and self._on_block in listeners:
            listeners.remove(self._on_block)

    # Clients

    def _on_request(self, request: Any) -> None:
        template = request.get_dict("response_template", {})
        self._clients[request.get_client_connection()] = template
        request.send({"header": HEADER})
        self._listen()
        if self._timer is None:
            reactor = self.printer.get_reactor()
            self._timer = reactor.register_timer(self._on_timer, reactor.monotonic() + BATCH_S)

    def _on_timer(self, eventtime: float) -> float:
        rows, self._rows = self._rows, []
        self._clients = {c: template for c, template in self._clients.items() if not c.is_closed()}
        for client, template in self._clients.items():
            if rows:
                client.send({**template, "params": {"data": rows, "header": HEADER}})
        if self._clients:
            return eventtime + BATCH_S
        self._listen()
        reactor = self.printer.get_reactor()
        reactor.unregister_timer(self._timer)
        self._timer = None
        return float(reactor.NEVER)

    # File

    def cmd_dump(self, gcmd: GCodeCommand) -> None:
        if self._file is not None:
            raise gcmd.error("INDUCTION_DUMP is writing already")
        name = gcmd.get("FILE", f"induction-{self.heater.section_name}-dump.csv")
        duration_s = gcmd.get_float("DURATION", 2.0, above=0.0, maxval=3600.0)
        try:
            self._file = output_file.open_new(self._folder, name)
        except output_file.OutputError as e:
            raise gcmd.error(f"INDUCTION_DUMP: {e}") from None
        self._writer = csv.writer(self._file)
        self._from_s = self.heater.now_s()
        self._until_s = self._from_s + duration_s
        gcmd.respond_info(f"Writing {duration_s:.1f} s of raw blocks to {self._file.name}")
        self._write(HEADER, 0.0)
        self._listen()

    def _write(self, row: tuple[Any, ...], time_s: float) -> None:
        try:
            self._writer.writerow(row)
        except OSError as e:
            self._close(e)
            return
        if time_s >= self._until_s:
            self._close()

    def _close(self, problem: OSError | None = None) -> None:
        """The file is over, whether or not what is left of it can still be written."""
        stream, self._file = self._file, None
        if stream is None:
            return
        self._listen()
        try:
            stream.close()
        except OSError as e:
            problem = problem or e
        if problem is not None:
            self.printer.lookup_object("gcode").respond_info(
                f"INDUCTION_DUMP ended: {stream.name} cannot be written: {problem.strerror}"
            )
