"""Close peaks."""
