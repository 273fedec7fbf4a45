"""Beam holds."""
