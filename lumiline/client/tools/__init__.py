"""Tools, their calibration, and points measured with them."""
