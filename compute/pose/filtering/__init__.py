"""Filtering: predicted and updated states of tracked tools, and association of their peaks."""
