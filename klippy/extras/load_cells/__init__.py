"""What [load_cell] and [load_cell_probe] share.

chip (chips.py) ─► samples (probing/stream.py) ─► force (cell.py) ─► status, commands, API
                                              └─► trigger on the board, contact by a fit (probe.py, contact.py)
"""
