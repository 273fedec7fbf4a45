"""Assessment of a calibration: cross-validation and diagnosis."""
