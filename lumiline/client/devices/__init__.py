"""Devices, their calibrations, and points from readings."""
