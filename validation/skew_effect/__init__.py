"""Case skew-effect: distortion by skew rays."""
