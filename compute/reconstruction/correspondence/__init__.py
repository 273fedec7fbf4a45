"""Correspondence: which peaks of the sensors belong to one marker."""

from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.correspondence.intersections import (
    IntersectionPoints,
    SearchPart,
    intersection_points,
)
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.correspondence.settings import (
    FALSE_REJECTION,
    Correspondence,
    MatchSettings,
)

__all__ = [
    "FALSE_REJECTION",
    "Correspondence",
    "IntersectionPoints",
    "MatchSettings",
    "PredictedPoints",
    "SearchPart",
    "group_peaks",
    "intersection_points",
]
