"""Case interpolators: correction maps."""
