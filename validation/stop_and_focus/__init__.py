"""Stop and focus."""
