"""[heater_generic NAME]: a heater that is neither nozzle nor bed."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper


def load_config_prefix(config: ConfigWrapper) -> Any:
    heaters = config.get_printer().load_object(config, "heaters")
    return heaters.setup_heater(config)
