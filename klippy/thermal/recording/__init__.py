"""A run of one nozzle as a file: what reached the host, what was decided, and the same decided again.

loop ─► recorder (every input and output) ─► stored (frames, a file) ─► rerun (the same loop, on any version)
"""
