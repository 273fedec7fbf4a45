"""Signal chain."""
