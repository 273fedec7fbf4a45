"""The thesis's signal chain from a scan to positions, every step optional."""
