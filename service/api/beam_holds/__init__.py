"""Beam holds: a signal when a patient leaves the tolerance, as a resource."""
