"""Case random-rigs: calibration of rigs of all kinds, judged on points that it never saw."""
