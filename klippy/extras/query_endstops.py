"""QUERY_ENDSTOPS, M119 and the endpoint query_endstops/status: the state of every endstop now."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class QueryEndstops:
    """Printer object 'query_endstops'."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.endstops: list[tuple[Any, str]] = []
        self.last_state: list[tuple[str, int]] = []

    def register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "QUERY_ENDSTOPS", self.cmd_QUERY_ENDSTOPS, desc="Report on the status of each endstop"
        )
        gcode.register_command("M119", self.cmd_QUERY_ENDSTOPS)
        webhooks = self.printer.lookup_object("webhooks", None)
        if webhooks is not None:
            webhooks.register_endpoint("query_endstops/status", self._handle_web_request)

    def register_endstop(self, mcu_endstop: Any, name: str) -> None:
        self.endstops.append((mcu_endstop, name))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"last_query": dict(self.last_state)}

    def _query(self) -> dict[str, str]:
        """Ask every MCU (after the queued moves); text by endstop name."""
        print_time = self.printer.lookup_object("toolhead").get_last_move_time()
        self.last_state = [(name, endstop.query_endstop(print_time)) for endstop, name in self.endstops]
        return {name: "TRIGGERED" if state else "open" for name, state in self.last_state}

    def _handle_web_request(self, web_request: Any) -> None:
        with self.printer.lookup_object("gcode").get_mutex():
            web_request.send(self._query())

    def cmd_QUERY_ENDSTOPS(self, gcmd: GCodeCommand) -> None:
        """QUERY_ENDSTOPS: 'x:open y:TRIGGERED …'."""
        gcmd.respond_raw(" ".join(f"{name}:{state}" for name, state in self._query().items()))


def load_config(config: ConfigWrapper) -> QueryEndstops:
    query = QueryEndstops(config.get_printer())
    query.register_commands()
    return query
