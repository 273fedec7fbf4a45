"""Calibrations: made from control points, immutable, activated and retired."""
