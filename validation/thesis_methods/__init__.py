"""Calibration as the thesis publishes it: iterative DLT, stepwise eleven-parameter bundle."""
