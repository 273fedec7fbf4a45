"""Correction tables: kept with their provenance, exchanged as HDF5, used with their calibration."""
