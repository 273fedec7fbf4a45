"""From readings of several sensors to 3D points with covariance."""
