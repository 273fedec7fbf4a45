"""From observations of control points to camera models with covariance."""
