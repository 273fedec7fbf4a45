"""Case labels: mislabelled control points."""
