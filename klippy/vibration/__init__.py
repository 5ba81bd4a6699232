"""Pure computing on vibration: input shapers, spectra, the choice of a shaper. No printer, no clock, no port."""
