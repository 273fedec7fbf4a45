"""Registration by three markers: given, or measured on a running device."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.registration.three_marker_frame import three_marker_frame
from compute.pose.tool_calibration.digitising import (
    StationaryPoint,
)
from service.api.quality.point_tap import check_strobed
from service.api.tools.geometry_capture import MIN_FRAMES, stationary_marker
from service.api.tools.marker_tap import MarkerObservation, MarkerTap
from service.api.tools.registration_schema import NewThreeMarkers
from service.api.tools.registrations import NewRegistrationRecord, target_errors
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect
from service.problems.errors import NoObservation

Array = NDArray[np.float64]

_TOLD_TURN_RAD: Final = float(np.radians(0.5))
"""A frame whose turn is known no better is warned of: 1 mm is passed at some 100 mm."""


def of_markers(live: Pipeline, request: NewThreeMarkers) -> NewRegistrationRecord:
    """Return the frame of three markers, whose positions are given or measured now.

    Raises:
        CollinearPoints, DuplicatePoint, UndeterminedParameters: they make no frame.
        InvalidParameter: they are given twice, or not at all, or without a deviation.
        DeviceNotRunning, NoActiveCalibration, CalibrationSwitched, NoObservation, NotStationary,
            TooFewPoses: of markers that are looked at.
    """
    if (request.measured_mm is None) == (request.strobe_markers is None):
        raise InvalidParameter(
            "give measured_mm, the places of the three markers, or strobe_markers, the numbers of "
            "three strobed markers to be measured now; not both"
        )
    measured_with = None
    frames: list[int | None] = [None] * 3
    if request.measured_mm is not None:
        places, covariances = np.array(request.measured_mm, float), _given_covariances(request)
    else:
        still, measured_with = _looked_at(live, request)
        places = np.array([one.position_mm for one in still])
        covariances = np.array([one.covariance_mm2 for one in still])
        frames = [one.poses for one in still]
    found = three_marker_frame(places, covariances)
    assert found.covariance is not None
    result = {
        "matrix": found.matrix.tolist(),
        "covariance": found.covariance.tolist(),
        "markers": [
            {
                "name": f"M{number + 1}",
                "measured_mm": places[number].tolist(),
                "covariance_mm2": covariances[number].tolist(),
                "frames": frames[number],
            }
            for number in range(3)
        ],
        "targets": target_errors(request.targets, found),
        "warnings": _warnings(found.covariance),
    }
    asked = request.model_dump(mode="json", exclude={"note"})
    return NewRegistrationRecord(result, asked, request.reference_id, measured_with)


def _given_covariances(request: NewThreeMarkers) -> Array:
    if request.measured_covariance_mm2 is not None:
        if request.measured_sigma_mm is not None:
            raise InvalidParameter(
                f"measured_sigma_mm is {request.measured_sigma_mm:g}, and measured_covariance_mm2 "
                "is given as well; give one of the two",
                measured_sigma_mm=request.measured_sigma_mm,
            )
        covariances = np.array(request.measured_covariance_mm2, float)
        for number, one in enumerate(covariances):
            if not np.allclose(one, one.T, rtol=1e-6) or np.linalg.eigvalsh(one)[0] <= 0.0:
                raise InvalidParameter(
                    f"the covariance of M{number + 1} is {one.tolist()}; it must be symmetric and "
                    "positive"
                )
        return covariances
    if request.measured_sigma_mm is None:
        raise InvalidParameter(
            "three markers leave nothing over that tells how well they are known; give "
            "measured_sigma_mm, the standard deviation of a coordinate, or measured_covariance_mm2"
        )
    return np.broadcast_to(np.eye(3) * request.measured_sigma_mm**2, (3, 3, 3))


def _looked_at(
    live: Pipeline, request: NewThreeMarkers
) -> tuple[list[StationaryPoint], tuple[str | None, str | None]]:
    """Return the markers' measured positions with the active calibration and table."""
    numbers = request.strobe_markers
    assert numbers is not None
    if request.measured_sigma_mm is not None or request.measured_covariance_mm2 is not None:
        raise InvalidParameter(
            "measured_sigma_mm and measured_covariance_mm2 are of given places; of strobed markers "
            "the deviations are measured: leave them out"
        )
    if len(set(numbers)) < 3:
        raise InvalidParameter(f"strobe_markers is {list(numbers)}; M1, M2 and M3 are three")
    session = live.session(request.device_id)
    check_strobed(request.device_id, numbers, session.description.markers)
    tap = MarkerTap(numbers, request.reference_id)
    collect(live, session, tap, request.duration_s, tap.ended)
    used = tap.calibration_used(request.device_id, "the markers were measured; do it again")
    counts = [len(tap.observations[number]) for number in numbers]
    if min(counts) < MIN_FRAMES:
        listed = ", ".join(f"{one}: {count}" for one, count in zip(numbers, counts, strict=True))
        without = ""
        if tap.without_reference:
            without = (
                f'; in {tap.without_reference} more the reference "{request.reference_id}" had no '
                f"pose to use ({tap.reason})"
            )
        raise NoObservation(
            f"in {request.duration_s:g} s the markers were seen in so many frames: {listed}; each "
            f"must be in at least {MIN_FRAMES}{without}",
            frames=min(counts),
        )
    return [_still(tap.observations[number]) for number in numbers], used


def _still(observations: list[MarkerObservation]) -> StationaryPoint:
    times = np.array([one.time_ns for one in observations], np.int64)
    places = [one.relative() for one in observations]
    return stationary_marker(
        times, np.array([one for one, _ in places]), np.array([one for _, one in places])
    )


def _warnings(covariance: Array) -> list[str]:
    values, ways = np.linalg.eigh(covariance[:3, :3])
    turn = float(np.sqrt(max(values[-1], 0.0)))
    if turn <= _TOLD_TURN_RAD:
        return []
    way = ", ".join(f"{one:.2f}" for one in ways[:, -1])
    told = (
        f"the turn about ({way}) is known to {np.degrees(turn):.2g} degrees, which is "
        f"{100.0 * turn:.2g} mm at 100 mm from the markers; place them further apart"
    )
    return [told]
