"""Calibration without known coordinates: a wand, a rigid body or a frame at unknown places."""
