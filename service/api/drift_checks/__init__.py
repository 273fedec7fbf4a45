"""Drift checks: stationary markers are read again to test whether a calibration still holds."""
