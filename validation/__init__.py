"""Published tables and tests as cases: the reference figures and ours, side by side."""
