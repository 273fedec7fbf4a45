"""Exports of points, tracks and tool poses to the file formats of other programs."""
