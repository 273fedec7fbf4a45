"""Readings of coded shadows: a weighted fit of the shift, started by correlation."""
