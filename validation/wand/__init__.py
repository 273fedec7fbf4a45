"""Case wand: calibration from a waved wand, beside a start from the truth."""
