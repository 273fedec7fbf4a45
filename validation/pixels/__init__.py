"""Case pixels: uneven and bad pixels, slopes and coma, with and without a calibration."""
