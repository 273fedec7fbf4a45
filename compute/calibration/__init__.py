"""Calibration: camera models with covariance from control points or moved targets."""
