"""Is a device still as good as it was? Quick checks, a watch on drift, and charts of both."""
