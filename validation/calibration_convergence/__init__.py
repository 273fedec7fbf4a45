"""Case calibration-convergence."""
