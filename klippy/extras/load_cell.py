"""[load_cell], [load_cell NAME]: a scale."""

from __future__ import annotations

from configfile import ConfigWrapper

from .load_cells.cell import LoadCell


def load_config(config: ConfigWrapper) -> LoadCell:
    cell = LoadCell(config)
    cell.register(config.get_name() == "load_cell")
    return cell


load_config_prefix = load_config
