"""Section 6 2."""
