"""Tools: rigid bodies with markers, their calibration, and the frames that their poses are in."""
