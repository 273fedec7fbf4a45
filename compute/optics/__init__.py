"""Optics: from the light of markers to the counts of a line sensor."""
