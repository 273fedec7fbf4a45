"""Tool calibration: tip by pivoting, axis by spinning, landmarks with a pointer."""
