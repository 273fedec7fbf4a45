"""Calibration convergence."""
