"""Radiometric calibrations of a device's sensors: dark and flat captures, versions, activation."""
