"""Trackers of chapter 6 of the thesis: window, probabilistic and 8-state, for comparison."""
