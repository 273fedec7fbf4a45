"""Which peaks of the sensors belong to one marker, when several are seen at once."""

from compute.reconstruction.correspondence.group import group_peaks
from compute.reconstruction.correspondence.match import match_peaks
from compute.reconstruction.correspondence.meeting import (
    MeetingPoints,
    Part,
    meeting_points,
)
from compute.reconstruction.correspondence.outside import PredictedPoints
from compute.reconstruction.correspondence.predictor import Predictor
from compute.reconstruction.correspondence.result import Correspondence
from compute.reconstruction.correspondence.settings import FALSE_REJECTION, MatchSettings

__all__ = [
    "FALSE_REJECTION",
    "Correspondence",
    "MatchSettings",
    "MeetingPoints",
    "Part",
    "PredictedPoints",
    "Predictor",
    "group_peaks",
    "match_peaks",
    "meeting_points",
]
