"""From a recorded run to the plant that would have given it: recording ─► signal (law to tank) ─► fit ─► report."""
