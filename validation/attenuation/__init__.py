"""Attenuation."""
