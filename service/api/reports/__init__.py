"""Reports of calibrations: one HTML file with figures."""
