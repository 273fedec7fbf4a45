"""Marker in space, fused from its tracks along the sensors."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.triangulation import chi2_limit
from validation.thesis_tracking.finite_difference_kinematics import FiniteDifferenceKinematics
from validation.thesis_tracking.sensor_point import SensorPoint
from validation.thesis_tracking.settings import MIN_SENSORS, ThesisSettings

Array = NDArray[np.float64]

GATE_EXCLUSION_PROBABILITY: Final = 1e-5
"""Chance that a marker's own point lies outside its gate."""
SHARED_PX: Final = 4.0
"""A point that is two tracks' lies anywhere between two targets that are this near."""


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


def track_readings(points: list[SensorPoint | None], deviation: Array) -> tuple[Array, Array]:
    """Return readings and standard deviations of a marker's tracks, (S,); NaN: none."""
    readings, sigma = np.full((2, len(points)), np.nan)
    seen = sum(one is not None and one.peak >= 0 for one in points)
    for sensor, one in enumerate(points):
        if one is None or (one.peak < 0 and seen >= MIN_SENSORS):
            continue
        readings[sensor] = one.position_px
        sigma[sensor] = deviation_of(one, deviation[sensor])
    return readings, sigma


def predicted_positions(markers: list[FusedMarker], time_ns: int) -> tuple[Array, Array]:
    """Return predicted positions (M, 3) [mm] and their covariances (M, 3, 3) of markers."""
    states = [one.kinematics.at(time_ns) for one in markers]
    return (
        np.stack([mean[:3] for mean, _ in states]),
        np.stack([covariance[:3, :3] for _, covariance in states]),
    )


def nearest_marker(
    lost: list[FusedMarker], position_mm: Array, covariance_mm2: Array, time_ns: int
) -> FusedMarker | None:
    """Return the lost marker that a point is nearest to, within its gate."""
    best, least = None, chi2_limit(3, GATE_EXCLUSION_PROBABILITY)
    for marker in lost:
        mean, covariance = marker.kinematics.at(time_ns)
        off = position_mm - mean[:3]
        far = float(off @ np.linalg.solve(covariance[:3, :3] + covariance_mm2, off))
        if far <= least:
            best, least = marker, far
    return best


def deviation_of(point: SensorPoint, deviation_px: Array) -> float:
    """Return a point's standard deviation, given those of the scan's points, (K,)."""
    if point.peak < 0:
        return point.deviation_px
    own = float(deviation_px[point.peak])
    return float(np.hypot(own, SHARED_PX / np.sqrt(12.0))) if point.shared else own
