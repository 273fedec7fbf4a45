"""Pose estimation: fits of a tool's pose to the readings of one instant."""
