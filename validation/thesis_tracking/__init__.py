"""The thesis's own tracking, chapter 6: one-dimensional, probabilistic, and the 8-state model."""
