"""Rigid bodies: poses from readings, pivot calibration, registration, frames, monitoring."""
