"""Fit of one sensor at a time: initial cameras, least squares, distortion, robust loss."""
