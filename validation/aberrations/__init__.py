"""Aberrations."""
