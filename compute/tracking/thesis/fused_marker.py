"""FusedMarker: a marker in space, by its tracks along the sensors."""

import numpy as np
from numpy.typing import NDArray

from compute.tracking.thesis.finite_difference_kinematics import FiniteDifferenceKinematics
from compute.tracking.thesis.sensor_point import SensorPoint
from compute.tracking.thesis.settings import ThesisSettings

Array = NDArray[np.float64]


class FusedMarker:
    """The tracks of one marker along S sensors, and its last points.

    Args:
        identity: number, never used again.
        tracks: the number of its track along each sensor; -1: none, shape (S,).
        settings: of the method.
        time_ns: now.
        exposures_to_confirm: exposures in which the sensors must agree before it counts.
    """

    def __init__(
        self,
        identity: int,
        tracks: NDArray[np.int64],
        settings: ThesisSettings,
        time_ns: int,
        exposures_to_confirm: int = 0,
    ) -> None:
        self.identity = identity
        self.tracks = tracks
        self.kinematics = FiniteDifferenceKinematics(settings.acceleration_psd, settings.jerk_psd)
        self.seen_ns = time_ns
        self.exposures_to_confirm = exposures_to_confirm
        self.contradicted = np.zeros(len(tracks), dtype=np.int64)
        """Scans in a row in which each sensor's reading was left out as another target's."""
        self.inconsistent = 0
        """Scans in a row in which the sensors contradicted one another, nobody knows which."""

    def unbind(self, sensors: NDArray[np.bool_]) -> None:
        """Let go of the tracks along some sensors, (S,)."""
        self.tracks[sensors] = -1
        self.contradicted[sensors] = 0

    def keep_running(self, current_points: list[dict[int, SensorPoint]]) -> None:
        """Let go of tracks that have ended."""
        ended = [
            number >= 0 and number not in points
            for number, points in zip(self.tracks.tolist(), current_points, strict=True)
        ]
        self.unbind(np.array(ended))

    def points(self, current_points: list[dict[int, SensorPoint]]) -> list[SensorPoint | None]:
        """Return its track's point along each sensor."""
        return [
            points.get(number)
            for number, points in zip(self.tracks.tolist(), current_points, strict=True)
        ]
