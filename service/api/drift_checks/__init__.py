"""Drift checks: is a calibration still good? Still markers are read again, and history is kept."""
