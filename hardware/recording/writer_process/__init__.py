"""Writer process."""
