"""A marker that leaves the volume of a correction table stays tracked, and its state is said."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.measurement.measurements import Measurements
from compute.tracking.track_batch import TrackFlag, TrackState
from compute.tracking.tracker import Tracker
from service.pipeline.frame_batch import track_members
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, ring

Array = NDArray[np.float64]

SIGMA_PX = 0.05
STEP_S = 0.01
HALF_MM = 150.0


def field(points_mm: Array) -> Array:
    """What the cameras lack: a parabola and a wave along x, shape (N, 4) [px]."""
    away = (points_mm[:, 0] - MIDDLE_MM[0]) / 300.0
    return np.stack([away**2, -(away**2), np.sin(away), np.cos(away)], axis=1)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_marker_that_leaves_the_table_is_tracked_without_a_covariance(direction: float) -> None:
    models = ring()
    cameras = CameraStack.of(models)
    rng = np.random.default_rng(11)
    known = MIDDLE_MM + rng.uniform(-HALF_MM, HALF_MM, (150, 3))
    readings = cameras.project(known) - field(known)
    readings += SIGMA_PX * rng.standard_normal(readings.shape)
    measured = MappingMeasurements(known, readings, np.full(readings.shape, SIGMA_PX))
    table = build_table(models, "", measured).table
    one = Tracker(cameras, corrections=table, pixels=(PIXELS,) * 4)
    # Out of the table, and back.
    path = 450.0 * np.sin(np.linspace(0.0, np.pi, 160))
    places = MIDDLE_MM + direction * path[:, None] * [1.0, 0.0, 0.0]
    identities, unknown, errors = set(), [], []
    for frame, place in enumerate(places):
        reading = (cameras.project(place[None]) - field(place[None]))[0]
        reading += SIGMA_PX * rng.standard_normal(4)
        peaks = Measurements.of(
            reading[:, None], np.full((4, 1), SIGMA_PX), np.zeros((4, 1), np.int32)
        )
        batch = one.step(1 + round(frame * STEP_S * 1e9), peaks, None)
        if frame < 20:
            continue
        assert batch.state.tolist() == [TrackState.CONFIRMED], frame
        identities.add(int(batch.identity[0]))
        beyond = bool(batch.flags[0] & TrackFlag.NO_COVARIANCE)
        assert beyond == np.isnan(batch.covariance[0, :6, :6]).all()
        assert beyond == (not table.grid.contains(batch.position_mm)[0])
        (members,) = track_members(batch, slice(0, 1))
        assert (members["covariance_mm2"] is None) == beyond
        assert (members["velocity_covariance_mm2_s2"] is None) == beyond
        assert ("no-covariance" in members["flags"]) == beyond
        unknown.append(beyond)
        errors.append(np.linalg.norm(batch.position_mm[0] - place))
    assert len(identities) == 1
    assert any(unknown)
    assert not unknown[0]
    assert not unknown[-1]
    # Beyond the table it is off by more than noise, and not by more than the field itself.
    assert max(errors) < 30.0
