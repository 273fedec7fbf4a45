"""Table 1 1."""
