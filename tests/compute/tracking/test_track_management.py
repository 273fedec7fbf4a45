"""The life of tracks: what is confirmed, which lost one a new one is, where a new one begins."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.tracking.motion_model import ImmStates, MotionModels
from compute.tracking.settings import TrackerSettings
from compute.tracking.state_initialisation import states_from_points
from compute.tracking.track_management import (
    PROBATION_EXPOSURES,
    expired,
    find_replaced_track,
    indistinguishable_tracks,
    match_lost_track,
    possibly_swapped,
    select_confirmed,
)
from compute.tracking.tracks import UNSUPPORTED_EXPOSURES, Tracks
from tests.compute.tracking.moving_markers import MIDDLE_MM, ring

Array = NDArray[np.float64]

SETTINGS = TrackerSettings(motion="acceleration")
MOTION = MotionModels.of(SETTINGS)
SENSORS = 4


def tracks_at(places_mm: list[list[float]], velocity_mm_s: list[list[float]]) -> Tracks:
    """Confirmed tracks with deviations of 1 mm and 10 mm/s."""
    count = len(places_mm)
    mean = np.zeros((count, 1, 9))
    mean[:, 0, :3], mean[:, 0, 3:6] = places_mm, velocity_mm_s
    covariance = np.diag([1.0] * 3 + [100.0] * 3 + [1e4] * 3)
    tracks = Tracks.create(
        ImmStates(
            mean,
            np.broadcast_to(covariance, (count, 1, 9, 9)).copy(),
            np.zeros((count, 1, 9, SENSORS)),
            np.ones((count, 1)),
        ),
        np.zeros((count, SENSORS, SENSORS)),
        mean[:, 0, :3],
        first=1,
        marker=None,
        time_ns=0,
        ambiguous_identity=np.zeros(count, np.bool_),
    )
    tracks.confirmed[:] = True
    return tracks


@pytest.mark.parametrize(
    ("hits", "supported_hits", "log_likelihood_ratio", "confirmed"),
    [(3, 2, 14.0, True), (2, 2, 50.0, False), (3, 1, 50.0, False), (3, 2, 13.0, False)],
)
def test_what_is_confirmed(
    hits: int, supported_hits: int, log_likelihood_ratio: float, *, confirmed: bool
) -> None:
    tracks = tracks_at([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    tracks.confirmed[0] = False
    tracks.hits[0], tracks.supported_hits[0], tracks.log_likelihood_ratio[0] = (
        hits,
        supported_hits,
        log_likelihood_ratio,
    )
    assert (len(select_confirmed(tracks, SETTINGS)) == 1) is confirmed


def test_a_lost_track_is_known_again_by_place_and_velocity() -> None:
    still = [0.0, 0.0, 0.0]
    tracks = tracks_at([[2.0, 0.0, 0.0], still, [60.0, 0.0, 0.0]], [still, still, still])
    assert match_lost_track(MOTION, tracks, 0, np.array([1, 2])) == (1, False)
    assert match_lost_track(MOTION, tracks, 0, np.array([2])) is None
    tracks.states.mean[1, 0, 3] = 200.0
    assert match_lost_track(MOTION, tracks, 0, np.array([1, 2])) is None
    tracks.states.mean[1, 0, 3] = 0.0
    tracks.states.mean[2, 0, 0] = 3.0
    assert match_lost_track(MOTION, tracks, 0, np.array([1, 2])) == (2, True)
    tracks.marker[:] = [5, 7, 5]
    tracks.states.mean[2, 0, 0] = 600.0
    assert match_lost_track(MOTION, tracks, 0, np.array([1, 2])) == (2, False)


def test_tracks_that_cannot_be_told_apart_are_named() -> None:
    still = [0.0, 0.0, 0.0]
    places = [still, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [90.0, 0.0, 0.0]]
    tracks = tracks_at(places, [still, still, [0.0, 300.0, 0.0], still])
    assert indistinguishable_tracks(MOTION, tracks, np.arange(4)).tolist() == [0, 1]


def test_a_track_at_a_ghost_gives_way() -> None:
    still = [0.0, 0.0, 0.0]
    tracks = tracks_at([still, still, still], [still, still, still])
    rows = np.array([0, 1])
    for _ in range(UNSUPPORTED_EXPOSURES):
        tracks.update_support(
            rows, np.array([3.0, 4.0]), np.array([3.0, 4.0]), np.array([4.0, 4.0])
        )
    peaks = np.array([[0, 1, -1, 2], [3, 3, 3, 3], [0, 1, 5, 6]], dtype=np.int32)
    assert find_replaced_track(peaks, 2, rows) == 0
    assert find_replaced_track(peaks, 2, np.array([1])) is None
    for _ in range(UNSUPPORTED_EXPOSURES):
        tracks.update_support(
            rows, np.array([3.0, 4.0]), np.array([3.0, 4.0]), np.array([3.0, 4.0])
        )
    assert tracks.unsupported[0] == UNSUPPORTED_EXPOSURES


def test_when_tracks_end() -> None:
    still = [0.0, 0.0, 0.0]
    tracks = tracks_at([still] * 4, [still] * 4)
    tracks.confirmed[1:] = False
    tracks.hits[:] = [0, 0, 1, 1]
    tracks.misses[:] = [9, 1, SETTINGS.confirm_misses, SETTINGS.confirm_misses + 1]
    assert expired(tracks, SETTINGS, 10**9).tolist() == [False, True, False, True]
    assert expired(tracks, SETTINGS, 10**9 + 1).all()


def test_doubt_shortens_a_track_s_life() -> None:
    """One of many ends when it is doubted early; any that is lost in doubt coasts for less."""
    still = [0.0, 0.0, 0.0]
    tracks = tracks_at([still] * 4, [still] * 4)
    tracks.unsupported[:] = [
        0,
        UNSUPPORTED_EXPOSURES,
        UNSUPPORTED_EXPOSURES,
        UNSUPPORTED_EXPOSURES - 1,
    ]
    tracks.remaining_probation[:] = [PROBATION_EXPOSURES, 1, 0, PROBATION_EXPOSURES]
    assert expired(tracks, SETTINGS, 0).tolist() == [False, True, False, False]
    half = round(0.5 * SETTINGS.coast_s * 1e9)
    assert expired(tracks, SETTINGS, half).tolist() == [False, True, True, False]


def test_what_four_sensors_see_proves_itself_and_what_is_hidden_is_not_doubted() -> None:
    still = [0.0, 0.0, 0.0]
    tracks = tracks_at([still] * 3, [still] * 3)
    tracks.remaining_probation[:] = 1
    rows, four = np.arange(3), np.array([4, 4, 4])
    tracks.update_support(rows, np.array([4, 3, 0]), np.array([4, 3, 0]), four)
    assert tracks.remaining_probation.tolist() == [0, 1, 1]
    assert tracks.unsupported.tolist() == [0, 1, 0]
    # A peak that may be shared says nothing.
    tracks.update_support(rows, np.array([3, 3, 3]), four, four)
    assert tracks.unsupported.tolist() == [0, 1, 0]


def test_tracks_beside_a_weak_one_are_doubted_with_it() -> None:
    reading = np.array([[100.0, 200.0, 300.0], [110.0, 215.0, 900.0], [110.0, 700.0, 900.0]])
    unsupported = np.array([True, False, False])
    confirmed = np.ones(3, dtype=np.bool_)
    assert possibly_swapped(reading, unsupported, confirmed, 4.0).tolist() == [True, True, False]
    assert possibly_swapped(reading, unsupported, unsupported, 4.0).tolist() == [True, False, False]


def test_a_new_track_knows_what_the_calibration_does_to_it() -> None:
    """Place and its covariance with the constant errors, beside weighed solutions of draws."""
    cameras = CameraStack.of(ring())
    deviation = np.tile([1.0, 1.0, 2e-4, 2e-4, 2e-4, 0.1, 0.1], SENSORS)
    model = MeasurementModel(cameras, np.diag(deviation**2))
    place, sigma = MIDDLE_MM[None] + [20.0, -30.0, 10.0], np.full((1, SENSORS), 0.1)
    states, bias = states_from_points(model, MOTION, SETTINGS, place, sigma)
    rng = np.random.default_rng(0)
    errors = rng.multivariate_normal(np.zeros(SENSORS), bias[0], 40_000)
    readings = errors + 0.1 * rng.standard_normal(errors.shape)
    weight = np.linalg.inv(bias[0] + 0.01 * np.eye(SENSORS))
    jacobian = model.predict(place).jacobian_px_per_mm[0]
    found = readings @ (np.linalg.inv(jacobian.T @ weight @ jacobian) @ jacobian.T @ weight).T
    whole = np.cov(np.concatenate([-found, errors], axis=1).T)
    scale = np.sqrt(np.diag(whole))
    apart = (whole[:3, :3] - states.covariance[0, 0, :3, :3]) / np.outer(scale[:3], scale[:3])
    assert np.abs(apart).max() < 0.03
    apart = (whole[:3, 3:] - states.bias_cross_covariance[0, 0, :3]) / np.outer(
        scale[:3], scale[3:]
    )
    assert np.abs(apart).max() < 0.03
