"""Raw coil telemetry of an [induction_heater]: INDUCTION_DUMP to a file, induction/dump_samples to a client."""

from __future__ import annotations

import csv
import importlib.util
import logging
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import util
from gcode import GCodeCommand
from roles import Printer
from thermal.records import SampleBlock, TempEstimate

from ..heater import tuning as heater_tuning
from ..outputs import output_file

BATCH_S = 0.100  # rows go to clients together
ROWS_HELD_MAX = 4000
PLOT = Path(__file__).resolve().parents[3] / "scripts" / "plot_induction.py"
PLOT_S = 120.0  # at most
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
        self._is_drawn = False  # when it is full
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
        self._is_drawn = bool(gcmd.get_int("PICTURE", 0))
        if self._is_drawn and importlib.util.find_spec("matplotlib") is None:
            raise gcmd.error(
                "INDUCTION_DUMP: a picture needs the Python package matplotlib. Run scripts/install.sh or `make setup`"
                " in the folder of the host, then restart it"
            )
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
            path = Path(self._file.name) if self._file is not None else None
            self._close()
            if path is not None and self._is_drawn:
                self._draw(path)

    def _draw(self, path: Path) -> None:
        """In a process of its own: a picture takes seconds."""
        reactor = self.printer.get_reactor()
        done = reactor.run_beside(partial(_plot, path))
        reactor.register_callback(lambda eventtime: self._say(str(done.wait())))

    def _say(self, text: str) -> None:
        self.printer.lookup_object("gcode").respond_info(text)

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
            self._say(f"INDUCTION_DUMP ended: {stream.name} cannot be written: {problem.strerror}")
            self._is_drawn = False


def _plot(path: Path) -> str:
    """On a thread of its own; what is said about it."""
    command = util.at_ordinary_priority([sys.executable, str(PLOT), str(path)])
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PLOT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"No picture of {path}: it took longer than {PLOT_S:.0f} s"
    if done.returncode:
        logging.warning("%s", done.stderr)
        return f"No picture of {path}: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}"
    return f"Picture: {path.with_suffix('.png')}"
