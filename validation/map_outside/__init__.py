"""Case map-outside: covariances of points beyond the measurements of a correction table."""
