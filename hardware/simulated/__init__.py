"""Simulated devices: stripe images of moving markers with detector noise."""
