"""Peak efficiency."""
