"""Interpolators."""
