"""Guided capture of control points: the readings of a marker held at each target in turn."""
