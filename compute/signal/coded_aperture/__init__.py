"""Readings of known shadow patterns: a weighted fit of the shift, started by correlation."""
