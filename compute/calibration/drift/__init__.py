"""Drift of a calibrated device: detection from stationary markers, and update."""
