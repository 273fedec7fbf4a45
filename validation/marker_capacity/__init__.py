"""Marker capacity."""
