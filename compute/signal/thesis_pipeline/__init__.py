"""The thesis's chain from a line to positions, every step an option; made to be looked at."""
