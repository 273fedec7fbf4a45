"""Case stop-and-focus: width and position of the stop, and focus."""
