"""canbus_stats NAME: error counters of a board on a CAN bus; made for every [mcu] section with a canbus_uuid."""

from __future__ import annotations

import logging
from typing import Any

from configfile import ConfigWrapper

PERIOD_S = 1.0
BUS_STATES = {0: "active", 1: "warn", 2: "passive", 3: "off"}
FORMAT = "canbus_status rx_error=%u tx_error=%u tx_retries=%u canbus_bus_state=%u"


class CanbusStats:
    """Printer object 'canbus_stats NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split(maxsplit=1)[1]
        self._mcu: Any = None
        self._query: Any = None
        self._timer: Any = None
        self._status: dict[str, Any] = {
            "rx_error": None, "tx_error": None, "tx_retries": None, "bus_state": None,
        }  # fmt: skip
        self.printer.register_event_handler("klippy:connect", self._find_board)
        self.printer.register_event_handler("klippy:disconnect", self._stop)

    def _find_board(self) -> None:
        self._mcu = self.printer.lookup_object("mcu" if self.name == "mcu" else f"mcu {self.name}")
        if self._mcu.is_fileoutput() or self._mcu.try_lookup_command("get_canbus_status") is None:
            return
        self._query = self._mcu.lookup_query_command("get_canbus_status", FORMAT)
        reactor = self.printer.get_reactor()
        self._timer = reactor.register_timer(self._ask, reactor.NOW)

    def _stop(self) -> None:
        if self._timer is not None:
            self.printer.get_reactor().unregister_timer(self._timer)
            self._timer = None

    def _ask(self, eventtime: float) -> float:
        if self.printer.is_shutdown():
            return float(self.printer.get_reactor().NEVER)
        try:
            answer = self._query.send()
        except self._mcu.error as e:  # a bus that fails stops the printer elsewhere
            logging.info("canbus_stats %s: %s", self.name, e)
            return float(self.printer.get_reactor().NEVER)
        state = answer["canbus_bus_state"]
        self._status = {
            "rx_error": answer["rx_error"],
            "tx_error": answer["tx_error"],
            "tx_retries": answer["tx_retries"],
            "bus_state": BUS_STATES.get(state, str(state)),
        }
        return float(self.printer.get_reactor().monotonic() + PERIOD_S)

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """For the log."""
        if self._status["bus_state"] is None:
            return False, ""
        s = self._status
        return False, (
            f"canstat_{self.name}: bus_state={s['bus_state']} rx_error={s['rx_error']} tx_error={s['tx_error']} "
            f"tx_retries={s['tx_retries']}"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status


def load_config_prefix(config: ConfigWrapper) -> CanbusStats:
    return CanbusStats(config)
