"""The thesis's chain from a scan to positions, every step an option; made to be looked at."""
