"""All points where peaks meet: markers are among them, in one exposure or part by part."""

from math import inf

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence import intersections
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.correspondence.intersections import SearchPart, intersection_points
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from tests.compute.tracking.moving_markers import PIXELS, Sensing, bar, peaks_of, swinging

Array = NDArray[np.float64]

MARKERS = 9


def scene(sensors: int, seed: int) -> tuple[CameraStack, Array, Array, Array, NDArray[np.int32]]:
    cameras = CameraStack.of(bar(sensors))
    rng = np.random.default_rng([sensors, seed])
    places = swinging(MARKERS, np.zeros(1), 0.0, rng)[0]
    position, sigma, _, owner = peaks_of(cameras, places, Sensing(missed=0.1), rng)
    return cameras, places, position, sigma, owner


def met(
    cameras: CameraStack, position: Array, sigma: Array, part: SearchPart
) -> tuple[Array, float]:
    def solve(readings: Array, deviations: Array) -> PointBatch:
        return reconstruct(cameras, readings, deviations)

    model = MeasurementModel(cameras, pixels=(PIXELS,) * len(cameras))
    peaks = Measurements.of(position, sigma)
    settings = MatchSettings(detection_probability=0.9)
    found, following = intersection_points(solve, model, peaks, part, settings)
    there = found.choice >= 0
    sensor = np.broadcast_to(np.arange(len(cameras)), found.choice.shape)
    assert (position[sensor[there], found.choice[there]] == found.position_px[there]).all()
    assert np.isfinite(found.log_ratio).all()
    return found.position_mm, following


def seen_by(owner: NDArray[np.int32]) -> NDArray[np.intp]:
    return np.array([(owner == marker).any(axis=1).sum() for marker in range(MARKERS)])


@pytest.mark.parametrize("sensors", [4, 6])
def test_every_marker_that_all_saw_is_among_the_points(sensors: int) -> None:
    for seed in range(3):
        cameras, places, position, sigma, owner = scene(sensors, seed)
        found, following = met(cameras, position, sigma, SearchPart())
        assert following == -inf
        whole = seen_by(owner) == sensors
        assert whole.any()
        apart = np.linalg.norm(found[:, None] - places[whole], axis=2)
        assert (apart.min(axis=0) < 2.0).all()
        assert len(np.unique(found, axis=0)) == len(found)


def test_parts_make_up_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for less than a third of the combinations, parts have the points of the whole."""
    cameras, _, position, sigma, _ = scene(4, 5)
    whole, _ = met(cameras, position, sigma, SearchPart())
    monkeypatch.setattr(intersections, "MAX_TRIPLES", 2 * 9 * 9)
    parts, first = [], -inf
    for _ in range(8):
        found, first = met(cameras, position, sigma, SearchPart(0, first))
        parts.append(found)
        if first == -inf:
            break
    assert 2 < len(parts) < 8
    together = np.unique(np.concatenate(parts).round(6), axis=0)
    assert np.array_equal(together, np.unique(whole.round(6), axis=0))


def test_fewer_than_four_sensors_have_none() -> None:
    cameras, _, position, sigma, _ = scene(4, 1)
    position[1] = np.nan
    found, following = met(cameras, position, sigma, SearchPart())
    assert (len(found), following) == (0, -inf)
