"""Fusion of several bars to one device: their peaks at one time, and their clocks' errors."""
