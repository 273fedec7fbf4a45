"""Tool calibration."""
