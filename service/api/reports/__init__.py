"""Reports: what an engineer looks for in a calibration, as one HTML file."""
