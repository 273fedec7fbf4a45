"""Correspondence and triangulation: from measurements to points with covariance."""
