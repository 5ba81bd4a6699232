"""Modules of the config sections: `[name ...]` is made by `extras/name.py`."""
