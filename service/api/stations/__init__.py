"""REST resource /api/v1/stations."""
