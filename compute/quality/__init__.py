"""Quality checks: single-point and point-to-point accuracy tests, control charts."""
