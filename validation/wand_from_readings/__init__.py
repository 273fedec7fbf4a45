"""Case wand-from-readings: calibration from a waved wand without initial cameras."""
