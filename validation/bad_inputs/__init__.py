"""Case bad-inputs: what a calibration refuses or remarks, and that it refuses nothing sound."""
