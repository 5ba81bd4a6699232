"""What the sections of accelerometers share.

chip (chips.py) ◄── registers ── sensor.py ── query_..., every 0.1 s a status ──► firmware
                                    ▲                                                │
clients: files, tests, dump API ◄── batch of (time, x, y, z) ◄── bulk.py ◄── sensor_bulk_data
"""
