"""From raw line scans to sub-pixel peak positions with their standard deviations."""
