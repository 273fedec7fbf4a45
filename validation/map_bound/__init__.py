"""Case map-bound: correction map against the noise bound."""
