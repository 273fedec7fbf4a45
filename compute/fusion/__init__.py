"""Fusion of several bars: readings at one time, and the errors of their clocks."""
