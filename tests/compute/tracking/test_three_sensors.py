"""Three sensors: one marker is found; of two lit together none is, unless one is known before."""

import numpy as np
import pytest

from compute.measurement.measurements import Measurements
from compute.tracking.track_batch import TrackState
from tests.compute.tracking.moving_markers import Sensing, peaks_of, swinging
from tests.compute.tracking.test_prior_tracks import AT_REST, HZ, tracker

CLEAN = Sensing(missed=0.0, false_peaks=0.0, resolution_px=4.0)


@pytest.mark.parametrize(
    ("alone", "markers", "prior", "followed"),
    [(50, 1, False, 1), (0, 2, False, 0), (0, 2, True, 2), (20, 2, False, 2)],
    ids=["one", "two", "two prior tracks", "a second one after the first"],
)
def test_markers_of_three_sensors_that_are_followed(
    alone: int, markers: int, prior: bool, followed: int
) -> None:
    """The first ``alone`` exposures show one marker, the others all."""
    one, cameras = tracker(3)
    places = swinging(2, np.arange(50) / HZ, 150.0, np.random.default_rng(6))[:, :markers]
    if prior:
        one.add_prior_tracks(1, places[0], (places[1] - places[0]) * HZ, AT_REST)
    for frame, now in enumerate(places):
        rng = np.random.default_rng([2, frame])
        lit = now[:1] if frame < alone else now
        position, sigma, flags, _ = peaks_of(cameras, lit, CLEAN, rng)
        measurements = Measurements.of(position, sigma, flags)
        batch = one.step(1 + round(frame / HZ * 1e9), measurements, None)
    confirmed = batch.state != TrackState.TENTATIVE
    distance = np.linalg.norm(batch.position_mm[:, None] - places[-1], axis=2)
    assert confirmed.sum() == followed
    assert (distance[confirmed].min(axis=1, initial=np.inf) < 5.0).all()
