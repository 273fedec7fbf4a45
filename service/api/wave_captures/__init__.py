"""Capture of a waved wand or rigid body, for self-calibration: poses, coverage, what is missing."""
