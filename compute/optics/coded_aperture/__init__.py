"""Masks instead of lenses: the coded window before a line sensor, and plates with Gray tracks."""
