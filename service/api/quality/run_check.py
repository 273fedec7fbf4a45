"""Runs a quality check on a running device's points of some seconds."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from compute.quality.accuracy import PointToPoint, SinglePoint, point_to_point, single_point
from service.api.quality.point_tap import PointTap, check_strobed
from service.api.quality.schema import NewPointToPoint, NewSinglePoint
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect

_GAPS: Final = 2.5
"""Positions of a marker are interpolated over one of its exposures that is missing, not more."""


@dataclass(frozen=True)
class CheckMeasurement:
    """Result of a quality check, with the calibration and table that it was measured with."""

    calibration_id: str
    table_id: str | None
    result: SinglePoint | PointToPoint
    passed: bool | None
    points: int
    left_out: int
    temperature_c: float | None


def measure(
    live: Pipeline, device_id: str, asked: NewSinglePoint | NewPointToPoint
) -> CheckMeasurement:
    """Measure for as long as was asked.

    Raises:
        DeviceNotRunning: the device does not run, or ends meanwhile.
        NoActiveCalibration: there are no points without one.
        CalibrationSwitched: another one came into force meanwhile.
        InvalidParameter: the device has no such markers.
        TooFewPoints: the markers were hardly seen.
    """
    session = live.session(device_id)
    wanted = _markers(asked)
    _check_markers(device_id, wanted, session.description.markers)
    tap = PointTap(wanted, 1 if isinstance(asked, NewSinglePoint) else 2)
    collect(live, session, tap, asked.duration_s, tap.ended)
    during = "it was measured; check again"
    calibration_id, table_id = tap.calibration_used(device_id, during)
    result = _result(tap, asked)
    errors = result.scatter if isinstance(result, SinglePoint) else result.errors
    worst = errors.percentile_95
    if isinstance(result, SinglePoint) and result.bias is not None:
        worst += result.bias  # at most: the errors' directions are not looked at
    link = live.status(device_id).link
    return CheckMeasurement(
        calibration_id,
        table_id,
        result,
        None if asked.tolerance_mm is None else worst <= asked.tolerance_mm,
        errors.count,
        tap.left_out,
        None if link is None else link.temperature_c,
    )


def _markers(asked: NewSinglePoint | NewPointToPoint) -> tuple[int, ...] | None:
    if isinstance(asked, NewPointToPoint):
        return asked.markers
    return None if asked.marker is None else (asked.marker,)


def _check_markers(device_id: str, wanted: tuple[int, ...] | None, markers: int) -> None:
    if wanted is None and markers:
        raise InvalidParameter(
            f'device "{device_id}" strobes {markers} markers, numbers 0 to {markers - 1}; say '
            "what is measured"
        )
    check_strobed(device_id, wanted or (), markers)


def _result(tap: PointTap, asked: NewSinglePoint | NewPointToPoint) -> SinglePoint | PointToPoint:
    tracks = tap.tracks()
    if isinstance(asked, NewSinglePoint):
        reference = asked.reference_position_mm
        (track,) = tracks
        return single_point(
            track.position_mm,
            track.covariance_mm2,
            track.time_s,
            None if reference is None else np.array(reference),
        )
    first, second = tracks
    gap = float(np.median(np.diff(first.time_s))) if len(first.time_s) > 1 else np.inf
    return point_to_point(
        first, second, asked.reference_mm, asked.reference_sigma_mm, max_gap_s=_GAPS * gap
    )
