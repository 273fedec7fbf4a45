"""Devices: source, driver, state, and the pointer to the active calibration."""
