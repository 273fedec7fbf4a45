"""Skew effect."""
